"""Recorded poses of a recording beside those that its images and depth give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.evaluation.trajectory_errors import TrajectoryErrors, rigid_alignment, trajectory_errors
from semdb.geometry import pose_error
from semdb.trajectory.recording import RecordedTrajectory, times_of
from semdb.types import FloatArray

LEAST = 3  # frames with both


@dataclass(frozen=True, slots=True, eq=False)
class PoseComparison:
    """How far recorded poses are from estimated ones, after the one rigid motion that lays these on those.

    `frames` have both; `errors` are None below three of them. `rotation_deg` is the median of what orientations differ
    by then, `scale` the factor by which the recorded path is larger. `worst_frame` (its index) differs most. `sigma_m`
    is what the estimated positions are sure to (median standard deviation).
    """

    frames: int
    estimated: int
    pieces: int
    errors: TrajectoryErrors | None = None
    rotation_deg: float = float("nan")
    scale: float = float("nan")
    worst_frame: int = -1
    sigma_m: float = float("nan")


def compare_poses(found: RecordedTrajectory) -> PoseComparison:
    """Compares the recorded poses of the frames of `found` with those that were estimated, in the largest piece."""
    trajectory = found.trajectory
    both = [
        (frame.position, frame.world_from_camera, recorded, frame.covariance)
        for frame in trajectory.used
        if (recorded := found.entries[frame.position].world_from_camera) is not None
        and frame.world_from_camera is not None
    ]
    estimated, pieces = len(trajectory.used), len(trajectory.pieces)
    if len(both) < LEAST:
        return PoseComparison(len(both), estimated, pieces)
    positions = [row[0] for row in both]
    ours, theirs = np.stack([row[1] for row in both]), np.stack([row[2] for row in both])
    errors = trajectory_errors(ours, theirs, times_of(found.entries)[0][positions])
    laid = rigid_alignment(ours[:, :3, 3], theirs[:, :3, 3]) @ ours
    off = np.linalg.norm(laid[:, :3, 3] - theirs[:, :3, 3], axis=1)
    # the orientation that lies best on the recorded one is not that of the positions where these hardly move
    turned = _mean_rotation(theirs[:, :3, :3] @ np.swapaxes(ours[:, :3, :3], 1, 2))
    differ = [pose_error(_rotated(turned, a), _rotated(np.eye(3), b))[1] for a, b in zip(ours, theirs, strict=True)]
    sigmas = [float(np.sqrt(np.trace(row[3][:3, :3]))) for row in both if row[3] is not None]
    return PoseComparison(
        frames=len(both),
        estimated=estimated,
        pieces=pieces,
        errors=errors,
        rotation_deg=float(np.median(differ)),
        scale=_scale(ours[:, :3, 3], theirs[:, :3, 3]),
        worst_frame=found.entries[positions[int(off.argmax())]].index,
        sigma_m=float(np.median(sigmas)) if sigmas else float("nan"),
    )


def _rotated(rotation: FloatArray, pose: FloatArray) -> FloatArray:
    turned = np.eye(4)
    turned[:3, :3] = rotation @ pose[:3, :3]
    return turned


def _mean_rotation(rotations: FloatArray) -> FloatArray:
    """The rotation ``[3, 3]`` nearest to all of ``[n, 3, 3]`` (chordal mean)."""
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt, np.float64)


def _scale(ours: FloatArray, theirs: FloatArray) -> float:
    """How many times as far apart the second positions ``[n, 3]`` are, least squares; NaN where all are one place."""
    motion = rigid_alignment(ours, theirs)
    a = (ours - ours.mean(axis=0)) @ motion[:3, :3].T
    b = theirs - theirs.mean(axis=0)
    square = float((a * a).sum())
    return float((a * b).sum()) / square if square > 1e-9 else float("nan")
