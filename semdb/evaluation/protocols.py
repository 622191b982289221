"""Which frames of a recording are asked about: the split into keyframes and queries."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

from semdb.errors import UsageError
from semdb.types import FloatArray

PAPER = "paper"
SPLIT = "split"
PROTOCOLS = (PAPER, SPLIT)


class PosedEntry(Protocol):
    """What the split needs to know of a frame of a recording."""

    @property
    def index(self) -> int: ...

    @property
    def world_from_camera(self) -> FloatArray | None: ...


Entry = TypeVar("Entry", bound=PosedEntry)


def evenly_spaced(total: int, count: int) -> list[int]:
    """`count` different positions of ``range(total)``, the first and the last among them; all if there are fewer.

    One position is the middle one. Raises UsageError for a count below 1.
    """
    if count < 1:
        raise UsageError(f"--max-queries {count}: at least one query is needed")
    if count >= total:
        return list(range(total))
    if count == 1:
        return [total // 2]
    # integers, rounding half up: neighbours are at least one apart before rounding, so they stay different
    return [(2 * i * (total - 1) + count - 1) // (2 * (count - 1)) for i in range(count)]


def split_paper(
    entries: Sequence[Entry], keyframes: Iterable[PosedEntry], max_queries: int | None = None
) -> list[Entry]:
    """The queries of protocol `paper`: the frames with a pose that are not keyframes, in order of the recording.

    With `max_queries` exactly that many of them, evenly spaced, or all where there are fewer. Raises UsageError
    when `max_queries` is below 1, or when every frame with a pose is a keyframe.
    """
    taken = {keyframe.index for keyframe in keyframes}
    queries = [entry for entry in entries if entry.index not in taken and entry.world_from_camera is not None]
    if not queries:
        raise UsageError("no frame is left for queries: every frame with a pose is a keyframe; use fewer --keyframes")
    if max_queries is None:
        return queries
    return [queries[position] for position in evenly_spaced(len(queries), max_queries)]
