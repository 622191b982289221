"""Which pixels of an image match which of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

from semdb.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPixels:
    """Which pixel of an image matches which of a keyframe: ``[n, 2]`` each, those that the pose rests on."""

    keyframe_id: int
    query_xy: FloatArray
    keyframe_xy: FloatArray
