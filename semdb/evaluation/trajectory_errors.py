"""How far an estimated trajectory is from the true one, as TUM's benchmark measures it.

Absolute trajectory error: positions after the one rigid motion that lays them best on the true ones. Relative pose
error: the motion over a second against the true one. (Sturm, Engelhard, Endres, Burgard, Cremers: A benchmark for the
evaluation of RGB-D SLAM systems, IROS 2012.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.geometry import pose_error
from semdb.geometry.stacks import invert_poses
from semdb.types import FloatArray


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Metres and degrees; relative ones are None where no two frames are a second apart."""

    frames: int
    rmse_m: float
    median_m: float
    max_m: float
    relative_rmse_m: float | None
    relative_median_m: float | None
    relative_rmse_deg: float | None
    relative_median_deg: float | None


def rigid_alignment(positions: FloatArray, reference: FloatArray) -> FloatArray:
    """The pose ``[4, 4]`` that lays `positions` ``[n, 3]`` on `reference` ``[n, 3]``, least squares without scale.

    Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 13(4), 1991.
    """
    middle, target = positions.mean(axis=0), reference.mean(axis=0)
    u, _, vt = np.linalg.svd((reference - target).T @ (positions - middle))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    pose = np.eye(4)
    pose[:3, :3] = u @ sign @ vt
    pose[:3, 3] = target - pose[:3, :3] @ middle
    return pose


def trajectory_errors(
    estimated: FloatArray, true: FloatArray, times_s: FloatArray, span_s: float = 1.0
) -> TrajectoryErrors:
    """Errors of `estimated` against `true` poses ``[n, 4, 4]`` at ascending `times_s` ``[n]``.

    Relative errors are over `span_s`, between each frame and the one nearest to that much later (at most half of it
    off). Raises ValueError for fewer than three frames.
    """
    if len(estimated) < 3:
        raise ValueError("errors of a trajectory need three frames")
    positions = estimated[:, :3, 3]
    motion = rigid_alignment(positions, true[:, :3, 3])
    off = np.linalg.norm(positions @ motion[:3, :3].T + motion[:3, 3] - true[:, :3, 3], axis=1)
    metres, degrees = _relative(estimated, true, times_s, span_s)
    known = len(metres) > 0
    return TrajectoryErrors(
        frames=len(estimated),
        rmse_m=_rms(off),
        median_m=float(np.median(off)),
        max_m=float(off.max()),
        relative_rmse_m=_rms(metres) if known else None,
        relative_median_m=float(np.median(metres)) if known else None,
        relative_rmse_deg=_rms(degrees) if known else None,
        relative_median_deg=float(np.median(degrees)) if known else None,
    )


def _relative(
    estimated: FloatArray, true: FloatArray, times_s: FloatArray, span_s: float
) -> tuple[FloatArray, FloatArray]:
    first = np.arange(len(times_s))
    later = np.searchsorted(times_s, times_s + span_s)
    before = np.maximum(later - 1, 0)
    later = np.minimum(later, len(times_s) - 1)
    nearer = np.abs(times_s[before] - times_s - span_s) < np.abs(times_s[later] - times_s - span_s)
    second = np.where(nearer, before, later)
    good = (np.abs(times_s[second] - times_s - span_s) <= span_s / 2) & (second > first)
    first, second = first[good], second[good]
    ours = invert_poses(estimated[first]) @ estimated[second]
    theirs = invert_poses(true[first]) @ true[second]
    errors = np.array([pose_error(a, b) for a, b in zip(ours, theirs, strict=True)]).reshape(-1, 2)
    return errors[:, 0], errors[:, 1]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))
