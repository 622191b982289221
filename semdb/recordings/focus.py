"""What whoever opens a recording wants beside it: only some of its frames, and to hear how far the work has come.

Whoever asks where one image was taken wants the camera, and perhaps masks and pose, of one frame in a recording of
perhaps a hundred thousand: others are then neither looked at nor checked. Whoever opens all of it waits for a look at
each file. Both wishes are of the context and no arguments, because few readers have to know of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

from semdb.errors import RecordingError

FEW = 1000  # files, which are looked at in less than a second
ENOUGH = 20  # frames of which one should be readable, where any will do


class NotAmongFramesError(RecordingError):
    """The recording can be read, but has no usable frame of those that are wanted."""


@dataclass(frozen=True, slots=True)
class Focus:
    """`names` are the last parts of the paths of wanted images; None where any frame will do."""

    names: frozenset[str] | None


_focus: ContextVar[Focus | None] = ContextVar("focus", default=None)


_watcher: ContextVar[Callable[[int, int], None] | None] = ContextVar("watcher", default=None)
_Item = TypeVar("_Item")


@contextmanager
def watched(progress: Callable[[int, int], None] | None) -> Iterator[None]:
    """Within, `progress` hears of how many files of a recording, of how many, have been looked at when it is opened."""
    token = _watcher.set(progress)
    try:
        yield
    finally:
        _watcher.reset(token)


def told(items: Sequence[_Item], done: int, total: int) -> Iterator[_Item]:
    """`items`, while whoever watches hears of them after `done` of `total`; of few files there is no news."""
    progress = _watcher.get() if total > FEW else None
    for number, item in enumerate(items, start=done + 1):
        yield item
        if progress is not None and (number % 64 == 0 or number == total):
            progress(number, total)


@contextmanager
def only_images(names: Collection[str] | None) -> Iterator[None]:
    """Within, recordings are opened with frames of the images `names` alone, or with a few where that is None."""
    token = _focus.set(Focus(None if names is None else frozenset(names)))
    try:
        yield
    finally:
        _focus.reset(token)


def in_focus() -> bool:
    """Whether only some frames are wanted."""
    return _focus.get() is not None


def is_wanted(name: str, found: int) -> bool:
    """Whether the frame of the image `name` is wanted, where `found` have been found before."""
    focus = _focus.get()
    if focus is None:
        return True
    if focus.names is None:
        return found < ENOUGH
    return name.rpartition("/")[2] in focus.names
