"""Work in stages that overlap, each with threads of its own, on items that go through them in order."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Stage:
    """One step: `work` takes what the step before returned. It is called in up to `threads` threads at a time."""

    name: str
    work: Callable[[Any], Any]
    threads: int = 1


def overlapped(items: Iterable[Any], stages: Sequence[Stage], window: int) -> Iterator[Any]:
    """What the last of `stages` makes of each of `items`, in their order.

    At most `window` items are under way, so memory does not grow with their number. A stage with one thread works
    on the items in their order, whatever the times of the others: a stage that writes does so as if everything were
    done in turn. The first error that a stage raises ends all and is raised here: stages finish what they are busy
    with, everything else that is under way is dropped. Leaving the iterator early does the same.
    """
    stop = _Stop()
    under_way: deque[Future[Any]] = deque()
    with ExitStack() as stack:
        pools = [
            stack.enter_context(ThreadPoolExecutor(stage.threads, thread_name_prefix=f"semdb-{stage.name}"))
            for stage in stages
        ]

        def end() -> None:
            stop.set()
            for pool in pools:
                pool.shutdown(wait=False, cancel_futures=True)

        stack.callback(end)
        for item in items:
            under_way.append(_enter(item, stages, pools, stop))
            while len(under_way) >= window or (under_way and under_way[0].done()):
                yield stop.result(under_way.popleft())
        while under_way:
            yield stop.result(under_way.popleft())


class _Stop:
    """Whether all is to end, and the error that it ends with."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._errors: list[BaseException] = []

    def set(self, error: BaseException | None = None) -> None:
        if error is not None:
            self._errors.append(error)
        self._event.set()

    def is_set(self) -> bool:
        return self._event.is_set()

    def result(self, future: Future[Any]) -> Any:
        """What an item became. Raises the first error of any item, also where this one was only dropped for it."""
        try:
            return future.result()
        except CancelledError:
            if self._errors:
                raise self._errors[0] from None
            raise


def _enter(item: Any, stages: Sequence[Stage], pools: Sequence[ThreadPoolExecutor], stop: _Stop) -> Future[Any]:
    """Hands `item` to all stages; each waits for the one before. Returns the last one's future."""
    before: Future[Any] = Future()
    before.set_result(item)
    for stage, pool in zip(stages, pools, strict=True):
        before = pool.submit(_step, stage.work, before, stop)
    return before


def _step(work: Callable[[Any], Any], before: Future[Any], stop: _Stop) -> Any:
    value = before.result()
    if stop.is_set():
        raise CancelledError
    try:
        return work(value)
    except BaseException as error:
        stop.set(error)
        raise
