"""Poses at other times than those of the frames: whether they fit the images better when a clock is moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semdb.geometry import pose_from, quat_wxyz_from_rotation, rotation_from_quat_wxyz, slerp_wxyz
from semdb.recordings.check.motion import errors
from semdb.recordings.check.pairs import Pair
from semdb.types import FloatArray, Int64Array

FARTHEST_S, STEP_S = 1.0, 0.04
FINEST_S = 0.0025
LONGEST_GAP_S = 0.5  # between the frames that a pose is interpolated from
LEAST_PAIRS = 4


def shifted_errors(pairs: Sequence[Pair], poses: FloatArray, times_ns: Int64Array) -> tuple[float, FloatArray] | None:
    """The shift in seconds at which poses fit best, and the errors ``[pairs]`` there.

    A pose at a frame's time plus the shift is taken, interpolated between those of frames; NaN beyond them. None where
    frames are too far apart.
    """
    if len(times_ns) < 8 or float(np.median(np.diff(times_ns))) * 1e-9 > LONGEST_GAP_S:
        return None
    quats = np.stack([quat_wxyz_from_rotation(pose[:3, :3]) for pose in poses])
    known: dict[float, FloatArray] = {}

    def tried(shift_s: float) -> float:
        if shift_s not in known:
            known[shift_s] = _errors_at(pairs, poses, quats, times_ns, shift_s)
        found = known[shift_s]
        return float(np.nanmedian(found)) if np.isfinite(found).sum() >= LEAST_PAIRS else np.inf

    grid = np.arange(-FARTHEST_S, FARTHEST_S + 1e-9, STEP_S).tolist()
    best, step = min(grid, key=tried), STEP_S
    while step > FINEST_S:
        step /= 2
        best = min((best - step, best, best + step), key=tried)
    return None if not np.isfinite(tried(best)) else (best, known[best])


def reversed_errors(pairs: Sequence[Pair], poses: FloatArray, times_ns: Int64Array) -> FloatArray:
    """The errors ``[pairs]`` if the poses ran backwards through the times; NaN where none is near."""
    quats = np.stack([quat_wxyz_from_rotation(pose[:3, :3]) for pose in poses])
    mirrored = int(times_ns[0]) + int(times_ns[-1])
    moved, found = poses.copy(), np.full(len(pairs), np.nan)
    for number, pair in enumerate(pairs):
        ends = [poses_at(poses, quats, times_ns, mirrored - int(times_ns[i])) for i in (pair.first, pair.second)]
        if ends[0] is not None and ends[1] is not None:
            moved[pair.first], moved[pair.second] = ends[0], ends[1]
            found[number] = errors([pair], moved)[0]
    return found


def _errors_at(
    pairs: Sequence[Pair], poses: FloatArray, quats: FloatArray, times_ns: Int64Array, shift_s: float
) -> FloatArray:
    found = np.full(len(pairs), np.nan)
    moved = poses.copy()
    for number, pair in enumerate(pairs):
        when = [int(times_ns[i]) + round(shift_s * 1e9) for i in (pair.first, pair.second)]
        ends = [poses_at(poses, quats, times_ns, time_ns) for time_ns in when]
        if ends[0] is None or ends[1] is None:
            continue
        moved[pair.first], moved[pair.second] = ends[0], ends[1]
        found[number] = errors([pair], moved)[0]
    return found


def poses_at(poses: FloatArray, quats: FloatArray, times_ns: Int64Array, time_ns: int) -> FloatArray | None:
    """The pose ``[4, 4]`` at a time between those of frames; None outside, or where they are too far apart."""
    after = int(np.searchsorted(times_ns, time_ns))
    if after < len(times_ns) and times_ns[after] == time_ns:
        return np.asarray(poses[after])
    if after == 0 or after == len(times_ns):
        return None
    before, gap = after - 1, int(times_ns[after] - times_ns[after - 1])
    if gap * 1e-9 > LONGEST_GAP_S:
        return None
    share = (time_ns - int(times_ns[before])) / gap
    turn = rotation_from_quat_wxyz(slerp_wxyz(quats[before], quats[after], share))
    return pose_from(turn, (1 - share) * poses[before][:3, 3] + share * poses[after][:3, 3])
