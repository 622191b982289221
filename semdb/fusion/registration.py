"""Two keyframes laid on each other by the points that both see: their recorded poses are off by centimetres.

What one keyframe knows of another's points is only as good as the pose between the two. Corrected poses for the whole
map were tried, and bend it: a map is a frame that others use, so its poses stay. Between two keyframes, and for their
points alone, the pose may be corrected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.fusion.options import RegistrationOptions
from semdb.geometry import invert_pose, pose_from, so3_exp
from semdb.localization.bundle import CAUCHY_SQUARED, NORMAL_MEDIAN
from semdb.types import FloatArray

ITERATIONS = 8
LEAST_M, LEAST_RAD = 1e-5, 1e-6  # a smaller step is none


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Points that two keyframes see, in one of them: normalised `xy` ``[m, 2]``, `depth` ``[m]`` metres or NaN."""

    xy: FloatArray
    depth: FloatArray

    @property
    def points(self) -> FloatArray:
        """Camera frame ``[m, 3]``, NaN without depth."""
        return np.column_stack([self.xy * self.depth[:, None], self.depth])


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """`second_from_first` ``[4, 4]`` and how far, in normalised coordinates, points fall off in it (one sigma)."""

    second_from_first: FloatArray
    noise: float


def register(
    first: Sightings,
    second: Sightings,
    second_from_first: FloatArray,
    focal: float,
    options: RegistrationOptions,
    start: FloatArray | None = None,
) -> Registration:
    """The pose between two keyframes that fits what both see; `second_from_first` is the recorded one.

    The search begins there, or at `start`.

    Points with depth in one are projected into the other, both ways; where both know a depth it is compared, with the
    sensor's noise. Gauss-Newton with a Cauchy loss; the recorded pose is a prior.
    """
    sigma = options.pixel_sigma_px / focal
    known = np.isfinite(first.depth) | np.isfinite(second.depth)
    if known.sum() < options.least_points:
        return Registration(second_from_first, _unregistered(first, second, sigma, options))
    pose = second_from_first if start is None else start
    information = np.repeat(1 / np.array([options.pose_m, options.pose_rad]) ** 2, 3)
    shift = _shift(second_from_first, pose)
    for _ in range(ITERATIONS):
        jacobian, residual = _system(first, second, pose, sigma)
        weight = 1 / (1 + (residual * residual).sum(axis=1) / CAUCHY_SQUARED)
        weighted = jacobian * weight[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, jacobian) + np.diag(information)
        step = -np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, residual) + information * shift)
        pose = pose_from(so3_exp(step[3:]), step[:3]) @ pose
        shift = shift + step
        if np.abs(step[:3]).max() < LEAST_M and np.abs(step[3:]).max() < LEAST_RAD:
            break
    _, residual = _system(first, second, pose, sigma)
    seen = np.abs(residual[residual[:, 2] == 0, :2])  # rows of pixels, not of depths
    return Registration(pose, max(sigma, float(np.median(seen)) * NORMAL_MEDIAN * sigma))


def _shift(recorded: FloatArray, pose: FloatArray) -> FloatArray:
    """How far ``[6]`` (metres, radians) `pose` is from `recorded`, to first order."""
    moved = pose @ invert_pose(recorded)
    skewed = (moved[:3, :3] - moved[:3, :3].T) / 2
    return np.array([*moved[:3, 3], skewed[2, 1], skewed[0, 2], skewed[1, 0]])


def _unregistered(first: Sightings, second: Sightings, sigma: float, options: RegistrationOptions) -> float:
    """Noise where too little is seen by both to correct the pose: what its standard deviations move points by."""
    depth = np.concatenate([first.depth, second.depth])
    near = float(np.nanmedian(depth)) if np.isfinite(depth).any() else 1.0
    return float(np.sqrt(sigma**2 + (options.pose_m / near) ** 2 + options.pose_rad**2))


def _system(first: Sightings, second: Sightings, pose: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Jacobian ``[r, 3, 6]`` by a step (metres, radians) of the second camera, and residuals ``[r, 3]`` in sigmas.

    One row is (x, y, 0) of a point in an image, or (0, 0, depth).
    """
    moved = first.points @ pose[:3, :3].T + pose[:3, 3]
    forth = np.isfinite(moved).all(axis=1) & (moved[:, 2] > 0.05)
    there = second.points
    back = invert_pose(pose)
    returned = there @ back[:3, :3].T + back[:3, 3]
    fro = np.isfinite(returned).all(axis=1) & (returned[:, 2] > 0.05)
    by_step = _by_step(moved[forth])  # of points in the second camera's frame
    rows = [_image_rows(moved[forth], by_step, second.xy[forth], sigma)]
    by_back = -np.einsum("ij,njk->nik", back[:3, :3], _by_step(there[fro]))
    rows.append(_image_rows(returned[fro], by_back, first.xy[fro], sigma))
    both = forth & np.isfinite(second.depth)
    spread = np.hypot(depth_noise(moved[both, 2]), depth_noise(second.depth[both]))
    jacobian, residual = np.zeros((int(both.sum()), 3, 6)), np.zeros((int(both.sum()), 3))
    jacobian[:, 2] = _by_step(moved[both])[:, 2] / spread[:, None]
    residual[:, 2] = (moved[both, 2] - second.depth[both]) / spread
    rows.append((jacobian, residual))
    return np.concatenate([row[0] for row in rows]), np.concatenate([row[1] for row in rows])


def _by_step(points: FloatArray) -> FloatArray:
    """How ``[n, 3, 6]`` camera-frame points move with a step (t, w): by t + w x p."""
    jacobian = np.zeros((len(points), 3, 6))
    jacobian[:, :, :3] = np.eye(3)
    x, y, z = points.T
    jacobian[:, 0, 4], jacobian[:, 0, 5] = z, -y
    jacobian[:, 1, 3], jacobian[:, 1, 5] = -z, x
    jacobian[:, 2, 3], jacobian[:, 2, 4] = y, -x
    return jacobian


def _image_rows(
    points: FloatArray, by_step: FloatArray, seen: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray]:
    x, y, z = points.T
    residual = np.zeros((len(points), 3))
    residual[:, :2] = (points[:, :2] / z[:, None] - seen) / sigma
    project = np.zeros((len(points), 3, 3))
    project[:, 0, 0], project[:, 1, 1] = 1 / z, 1 / z
    project[:, 0, 2], project[:, 1, 2] = -x / z**2, -y / z**2
    return project @ by_step / sigma, residual


def depth_noise(depth: FloatArray) -> FloatArray:
    """Standard deviation in metres ``[n]`` of measured depths ``[n]`` (`bundle_kernels.depth_sigma`)."""
    from semdb.localization.bundle_kernels import depth_sigma

    return np.asarray(depth_sigma(depth), np.float64)  # type: ignore[arg-type]  # compiled: takes arrays too
