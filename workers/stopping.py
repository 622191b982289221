"""Whether the worker is to stop: one byte that all its processes share, for signals reach only the first of them."""

from __future__ import annotations

import mmap

_flag = mmap.mmap(-1, 1)  # anonymous and shared: made before the worker forks


def is_set() -> bool:
    """Whether `request` was called, in this process or the one that it was forked from."""
    return _flag[0] != 0


def request() -> None:
    """Asks all processes of this worker to stop after what they are at. Takes no lock: a signal handler may call it."""
    _flag[0] = 1


def clear() -> None:
    """Takes the request back: a worker starts."""
    _flag[0] = 0
