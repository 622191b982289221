"""Saying which keyframes are damaged, and how: each once, and not without end."""

from __future__ import annotations

import logging
from collections.abc import Callable

from semdb.errors import CodecError
from semdb.events import event

MOST_SAID = 10
_REMEMBERED = 1000  # lines, of processes that live long


def once(say: Callable[[str], None]) -> Callable[[str], None]:
    """`say`, but for lines that were said already."""
    said: set[str] = set()

    def new(line: str) -> None:
        if line not in said and len(said) < _REMEMBERED:
            said.add(line)
            say(line)

    return new


def telling(say: Callable[[str], None] | None) -> Callable[[str], None]:
    """`say`, or where there is none to hear it an event of the level warning."""
    if say is not None:
        return say

    def new(line: str) -> None:
        event("remark", level=logging.WARNING, message=line)

    return new


class LeftOut:
    """Takes what reading functions hand to `bad`. Safe to share between threads."""

    def __init__(self, say: Callable[[str], None] | None = None) -> None:
        """`say` takes lines for people; without it they are events of the level warning."""
        self._say = say
        self._known: dict[int, str] = {}

    def __call__(self, keyframe_id: int, error: CodecError) -> None:
        if self._known.get(keyframe_id) == str(error):
            return
        self._known[keyframe_id] = str(error)
        if self._say is None:
            event("left_out", level=logging.WARNING, keyframe=keyframe_id, error=str(error))
        elif len(self._known) <= MOST_SAID:
            self._say(
                f"what is damaged of keyframe {keyframe_id} is left out: {error} "
                f"(semdb delete keyframes {keyframe_id} removes it)"
            )
        elif len(self._known) == MOST_SAID + 1:
            self._say(f"of more keyframes something is damaged and left out; the first {MOST_SAID} are named above")
