"""Parts of one piece of work side by side: compiled kernels leave the interpreter to other threads meanwhile.

The one pool of threads for all: local features, matching, the index. Work that runs on it must not wait for more work
on it, so `each` is not called from within `each`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST = 4  # a query has few keyframes


def cores() -> int:
    """Processors that this process may use, at most `MOST`."""
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, MOST)


def each(work: Callable[[Item], Result], items: Sequence[Item], threads: int) -> list[Result]:
    """``[work(item) for item in items]`` on up to `threads` threads, the calling one among them.

    Results are those of one thread. The first error of an item is raised.
    """
    if threads < 2 or len(items) < 2:
        return [work(item) for item in items]
    others = [_pool(threads - 1).submit(work, item) for item in items[1:]]
    return [work(items[0]), *(other.result() for other in others)]


def ahead(items: Iterator[Item]) -> Iterator[Item]:
    """The same items, each worked out while the one before it is used; by one thread, which is not of the pool."""
    nothing = object()
    with ThreadPoolExecutor(1, thread_name_prefix="semdb-ahead") as other:
        coming = other.submit(next, items, nothing)
        while (item := coming.result()) is not nothing:
            coming = other.submit(next, items, nothing)
            yield item  # type: ignore[misc]


@lru_cache(maxsize=MOST)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="semdb")


if hasattr(os, "register_at_fork"):  # a forked process has the pool, but none of its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
