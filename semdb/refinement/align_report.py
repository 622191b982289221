"""What came of bringing recordings into the frame of another map, keyframe by keyframe."""

from __future__ import annotations

import math
from dataclasses import dataclass

from semdb.types import FloatArray


@dataclass(frozen=True, slots=True)
class AlignedKeyframe:
    """One keyframe: what localizing it in the map gave, and whether that agrees with the others.

    `off_m` and `off_deg`: how far that is from its new pose (NaN where it was not localized); `shift_m` and
    `shift_deg`: how far its new pose is from the one it has; `bend_m` and `bend_deg`: from where one motion of the
    whole recording would put it (NaN where nothing convinced).
    """

    keyframe: int
    recording: str
    frame_index: int
    verdict: str
    agrees: bool
    inliers: int
    off_m: float = math.nan
    off_deg: float = math.nan
    shift_m: float = math.nan
    shift_deg: float = math.nan
    bend_m: float = math.nan
    bend_deg: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class AlignReport:
    """What came of it. `reason` says why nothing is changed, empty where it convinces.

    `near` keyframes should see the same as a keyframe of the map, `near_same` of them agree and look the same.
    `map_from_recording` ``[4, 4]`` moves the recording's world into the map's. `operation` is 0 where nothing was
    written: a dry run, or it did not convince.
    """

    recordings: tuple[str, ...]
    from_map: str
    map: str
    reason: str
    localized: int
    agreeing: int
    rival: int
    near: int
    near_same: int
    map_from_recording: FloatArray | None
    keyframes: tuple[AlignedKeyframe, ...]
    operation: int = 0
    map_shift_m: float = 0.0  # the farthest that a keyframe of the map moved, with a free map

    @property
    def convinced(self) -> bool:
        return not self.reason
