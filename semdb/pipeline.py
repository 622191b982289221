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
    done in turn. The first error that a stage raises ends all: items behind it are dropped, those that a stage
    is busy with are finished, and the error is raised here. Leaving the iterator early does the same.
    """
    stop = threading.Event()
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
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()


def _enter(
    item: Any, stages: Sequence[Stage], pools: Sequence[ThreadPoolExecutor], stop: threading.Event
) -> Future[Any]:
    """Hands `item` to all stages; each waits for the one before. Returns the last one's future."""
    before: Future[Any] = Future()
    before.set_result(item)
    for stage, pool in zip(stages, pools, strict=True):
        before = pool.submit(_step, stage.work, before, stop)
    return before


def _step(work: Callable[[Any], Any], before: Future[Any], stop: threading.Event) -> Any:
    value = before.result()
    if stop.is_set():
        raise CancelledError
    try:
        return work(value)
    except BaseException:
        stop.set()
        raise
