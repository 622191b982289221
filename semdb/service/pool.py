"""Work in threads, of which there are only so many, and a queue, which is only so long."""

from __future__ import annotations

import asyncio
import contextvars
import threading
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from semdb.service.problems import Problem, busy

T = TypeVar("T")
_FIRST_GUESS_S = 0.2


class Pool:
    """`threads` at once and `queue` that wait; more is refused with 429 and when to come again."""

    def __init__(self, name: str, threads: int, queue: int) -> None:
        self.name, self.threads, self.queue = name, threads, queue
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix=f"semdb-{name}")
        self._turn = threading.Lock()
        self._inside = 0
        self._usual_s = _FIRST_GUESS_S

    @property
    def inside(self) -> int:
        """How many run or wait."""
        return self._inside

    async def run(self, work: Callable[[], T], gone: Callable[[], Awaitable[Any]] | None = None) -> T:
        """The result of `work`. What still waits when `gone` returns, or this is cancelled, is never begun.

        Raises Problem 429 where the queue is full, 499 where the client went away.
        """
        with self._turn:
            if self._inside >= self.threads + self.queue:
                raise busy(f"all places for {self.name} are taken", self._usual_s * self._inside / self.threads)
            self._inside += 1
        context = contextvars.copy_context()
        try:
            future: Future[T] = self._executor.submit(context.run, self._timed, work)
        except RuntimeError:
            self._left(None)
            raise Problem(503, "the service is stopping", headers={"Retry-After": "2"}) from None
        future.add_done_callback(self._left)
        waiting = asyncio.wrap_future(future)
        if gone is None:
            return await waiting
        watching = asyncio.ensure_future(gone())
        try:
            await asyncio.wait({waiting, watching}, return_when=asyncio.FIRST_COMPLETED)
            if not waiting.done():
                waiting.cancel()
                raise Problem(499, "the client went away")
            return await waiting
        finally:
            watching.cancel()
            waiting.cancel()

    def _timed(self, work: Callable[[], T]) -> T:
        started = time.perf_counter()
        try:
            return work()
        finally:
            self._usual_s += 0.1 * (time.perf_counter() - started - self._usual_s)

    def _left(self, _: object) -> None:
        with self._turn:
            self._inside -= 1

    def close(self) -> None:
        """Begins nothing more, and waits for what runs."""
        self._executor.shutdown(wait=True, cancel_futures=True)
