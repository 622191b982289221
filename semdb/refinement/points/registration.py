"""Two keyframes laid on each other by the points that both see: their recorded poses are off by centimetres.

What one keyframe knows of another's points is only as good as the pose between the two. Corrected poses for the whole
map were tried, and bend it: a map is a frame that others use, so its poses stay. Between two keyframes, and for their
points alone, the pose may be corrected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose, pose_from, so3_exp
from semdb.geometry.sensor import depth_noise
from semdb.localization.bundle import CAUCHY_SQUARED, NORMAL_MEDIAN
from semdb.refinement.points.options import RegistrationOptions
from semdb.types import FloatArray

ITERATIONS = 8
EVIDENCE_ROUNDS = 20
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
    sensor's noise; where neither does, the two rays have to meet. Gauss-Newton with a Cauchy loss; the recorded pose is
    a prior.
    """
    sigma = options.pixel_sigma_px / focal
    if len(first.xy) < options.least_points:
        return Registration(second_from_first, _unregistered(first, second, sigma, options))
    pose = second_from_first if start is None else start
    spread = np.array([options.pose_m, options.pose_rad])
    pose, shift, data = _fit(first, second, second_from_first, pose, spread, sigma)
    spread = _evident_spread(data, shift, spread, np.array([options.least_m, options.least_rad]))
    pose, _, _ = _fit(first, second, second_from_first, pose, spread, sigma)
    _, _, seen = _system(first, second, pose, sigma)
    return Registration(pose, max(sigma, float(np.median(np.abs(seen))) * NORMAL_MEDIAN * sigma))


def _fit(
    first: Sightings, second: Sightings, recorded: FloatArray, pose: FloatArray, spread: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The pose under a prior of `spread` (m, rad) about `recorded`, its shift ``[6]``, the data's information."""
    information = np.repeat(1 / spread**2, 3)
    shift, data = _shift(recorded, pose), np.zeros((6, 6))
    for _ in range(ITERATIONS):
        jacobian, residual, _ = _system(first, second, pose, sigma)
        weight = 1 / (1 + (residual * residual).sum(axis=1) / CAUCHY_SQUARED)
        weighted = jacobian * weight[:, None, None]
        data = np.einsum("nij,nik->jk", weighted, jacobian)
        gradient = np.einsum("nij,ni->j", weighted, residual) + information * shift
        step = -np.linalg.solve(data + np.diag(information), gradient)
        pose = pose_from(so3_exp(step[3:]), step[:3]) @ pose
        shift = shift + step
        if np.abs(step[:3]).max() < LEAST_M and np.abs(step[3:]).max() < LEAST_RAD:
            break
    return pose, shift, data


def _evident_spread(data: FloatArray, shift: FloatArray, greatest: FloatArray, least: FloatArray) -> FloatArray:
    """How far off the recorded pose is (m, rad), as the points show it: MacKay's evidence approximation (1992).

    Where poses are exact, none of the freedom is left that noise would use along what points hardly determine.
    """
    spread = greatest
    pull = data @ shift + np.repeat(1 / greatest**2, 3) * shift
    for _ in range(EVIDENCE_ROUNDS):
        information = np.repeat(1 / spread**2, 3)
        inverse = np.linalg.inv(data + np.diag(information))
        mean, determined = inverse @ pull, 1 - np.diag(inverse) * information
        found = np.sqrt((mean**2).reshape(2, 3).sum(axis=1) / np.maximum(determined.reshape(2, 3).sum(axis=1), 1e-6))
        spread = np.clip(found, least, greatest)
    return spread


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


def _system(
    first: Sightings, second: Sightings, pose: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Jacobian ``[r, 3, 6]`` by a step (metres, radians) of the second camera, residuals ``[r, 3]`` in sigmas.

    One row is (x, y, 0) of a point in an image, (distance from the epipolar line, 0, 0), or (0, 0, depth). Also those
    of the residuals that are of pixels, ``[q]``.
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
    neither = ~np.isfinite(first.depth) & ~np.isfinite(second.depth)
    rows.append(_ray_rows(first.xy[neither], second.xy[neither], pose, sigma))
    pixels = np.concatenate([rows[0][1][:, :2].ravel(), rows[1][1][:, :2].ravel(), rows[2][1][:, 0]])
    rows.append((jacobian, residual))
    return np.concatenate([row[0] for row in rows]), np.concatenate([row[1] for row in rows]), pixels


def _ray_rows(one: FloatArray, two: FloatArray, pose: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Distance of each of `two` ``[n, 2]`` from the epipolar line of its partner, and how a step changes it.

    The line is l = t x R x1; with a step (d, w) its product with x2 grows by d . (R x1 x x2) + w . (l x x2) to first
    order. Its length changes too: without that, a shorter step between the cameras would seem to fit better.
    """
    turned = np.column_stack([one, np.ones(len(one))]) @ pose[:3, :3].T
    other = np.column_stack([two, np.ones(len(two))])
    line = np.cross(np.broadcast_to(pose[:3, 3], turned.shape), turned)
    length = np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-9)[:, None]
    jacobian, residual = np.zeros((len(one), 3, 6)), np.zeros((len(one), 3))
    distance = (line * other).sum(axis=1)[:, None] / length
    flat = line * [1.0, 1.0, 0.0] / length
    jacobian[:, 0, :3] = np.cross(turned, other - distance * flat) / (length * sigma)
    jacobian[:, 0, 3:] = np.cross(line, other - distance * flat) / (length * sigma)
    residual[:, 0] = distance[:, 0] / sigma
    return jacobian, residual


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
