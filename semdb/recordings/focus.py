"""Which frames of a recording somebody wants, where that is not all: others are then neither looked at nor checked.

Whoever asks where one image was taken wants the camera, and perhaps masks and pose, of one frame in a recording of
perhaps a hundred thousand. The wish is of the context and not an argument, because only readers that would look at
files frame by frame have to know of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from semdb.errors import RecordingError

ENOUGH = 20  # frames of which one should be readable, where any will do


class NotAmongFramesError(RecordingError):
    """The recording can be read, but has no usable frame of those that are wanted."""


@dataclass(frozen=True, slots=True)
class Focus:
    """`names` are the last parts of the paths of wanted images; None where any frame will do."""

    names: frozenset[str] | None


_focus: ContextVar[Focus | None] = ContextVar("focus", default=None)


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
