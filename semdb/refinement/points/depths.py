"""The depth of a keypoint along its own ray, from all keyframes that see its point.

One unknown per keypoint. Its pixel defines the ray, since that is what a query's patch is aligned with; how far along
it lies say the depth measured in its own image, the pixels in the others and the depths measured there. Depths have the
sensor's noise, which grows with the distance squared; pixels in another keyframe have the noise that is left between
the two when they are laid on each other. A point that nobody measured is triangulated that way.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semdb.compiled import kernel
from semdb.localization.bundle_kernels import depth_sigma
from semdb.refinement.points.options import DepthOptions
from semdb.types import FloatArray, Int64Array, IntArray

CAUCHY = 4.0  # (2 sigma)^2: where the loss leaves the parabola
ITERATIONS = 12
AGREES = 9.0  # (3 sigma)^2 of an observation
NEAREST_M, FARTHEST_M = 0.1, 50.0


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Keypoints to be placed and what other keyframes say of them; those of keypoint i are ``start[i]:start[i + 1]``.

    Pose ``which[k]`` takes the camera frame of the keypoint to that of the keyframe that observation k is from.
    """

    ray: FloatArray  # [n, 2] normalised
    depth: FloatArray  # [n] measured in the keypoint's own image, NaN where it is not
    start: Int64Array  # [n + 1]
    which: IntArray  # [k]
    rotation: FloatArray  # [p, 3, 3]
    translation: FloatArray  # [p, 3]
    noise: FloatArray  # [p] of `seen`
    seen: FloatArray  # [k, 2] normalised
    seen_depth: FloatArray  # [k] NaN where it is not measured


@dataclass(frozen=True, slots=True, eq=False)
class Depths:
    """`depth` ``[n]`` metres, NaN where none is found; `sigma` ``[n]`` metres; `agreeing` ``[n]`` other keyframes."""

    depth: FloatArray
    sigma: FloatArray
    agreeing: Int64Array


def solve_depths(observations: Observations, options: DepthOptions) -> Depths:
    """The most likely depth of each keypoint under a Cauchy loss."""
    count = len(observations.ray)
    depth, sigma, agreeing = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count, np.int64)
    _solve(
        observations.ray, observations.depth, observations.start, observations.which, observations.rotation,
        observations.translation, observations.seen, observations.seen_depth, observations.noise, options.most_relative,
        float(np.cos(np.radians(options.least_parallax_deg))), depth, sigma, agreeing,
    )  # fmt: skip
    if not options.fuse:
        depth[np.isfinite(observations.depth)] = np.nan
    return Depths(depth, sigma, agreeing)


@kernel
def _other(z: float, ray: Any, rotation: Any, translation: Any, out: Any) -> None:
    """The point at depth `z` in another camera: out[0:3]; how it moves with z: out[3:6]."""
    for i in range(3):
        out[3 + i] = rotation[i, 0] * ray[0] + rotation[i, 1] * ray[1] + rotation[i, 2]
        out[i] = out[3 + i] * z + translation[i]


@kernel
def _add(
    z: float, k: int, ray: Any, which: Any, rotation: Any, translation: Any, seen: Any, seen_depth: Any, noise: Any,
    point: Any, sums: Any,
) -> None:  # fmt: skip
    """Adds observation k at depth `z` to the cost, gradient and curvature in `sums`, with its own chi2 in sums[3]."""
    _other(z, ray, rotation[which[k]], translation[which[k]], point)
    if point[2] < 0.05:
        sums[0] += 100.0
        sums[3] = 1e9
        return
    inverse = 1.0 / point[2]
    x, y = point[0] * inverse, point[1] * inverse
    rx, ry = (x - seen[k, 0]) / noise[which[k]], (y - seen[k, 1]) / noise[which[k]]
    jx, jy = (
        (point[3] - x * point[5]) * inverse / noise[which[k]],
        (point[4] - y * point[5]) * inverse / noise[which[k]],
    )
    chi2 = rx * rx + ry * ry
    weight = 1.0 / (1.0 + chi2 / CAUCHY)
    sums[0] += CAUCHY * np.log1p(chi2 / CAUCHY)
    sums[1] += weight * (rx * jx + ry * jy)
    sums[2] += weight * (jx * jx + jy * jy)
    sums[3] = chi2
    if not np.isnan(seen_depth[k]):
        # the pose between the two is as uncertain along the ray as across it
        spread = np.hypot(depth_sigma(seen_depth[k]), noise[which[k]] * point[2])
        r, j = (point[2] - seen_depth[k]) / spread, point[5] / spread
        weight = 1.0 / (1.0 + r * r / CAUCHY)
        sums[0] += CAUCHY * np.log1p(r * r / CAUCHY)
        sums[1] += weight * r * j
        sums[2] += weight * j * j
        sums[3] += r * r


@kernel
def _evaluate(
    z: float, own: float, first: int, last: int, ray: Any, which: Any, rotation: Any, translation: Any, seen: Any,
    seen_depth: Any, noise: Any, point: Any, sums: Any,
) -> int:  # fmt: skip
    """Fills `sums` (cost, gradient, curvature) at depth `z`; returns how many other keyframes agree."""
    sums[:] = 0.0
    agreeing = 0
    for k in range(first, last):
        _add(z, k, ray, which, rotation, translation, seen, seen_depth, noise, point, sums)
        if sums[3] < AGREES:
            agreeing += 1
    if not np.isnan(own):
        spread = depth_sigma(own)
        r = (z - own) / spread
        weight = 1.0 / (1.0 + r * r / CAUCHY)
        sums[0] += CAUCHY * np.log1p(r * r / CAUCHY)
        sums[1] += weight * r / spread
        sums[2] += weight / (spread * spread)
    return agreeing


@kernel
def _guess(
    k: int, ray: Any, which: Any, rotation: Any, translation: Any, seen: Any, seen_depth: Any, point: Any
) -> float:
    """Depth at which another keyframe alone would put the point: by its measured depth, else where the rays meet."""
    _other(
        0.0, ray, rotation[which[k]], translation[which[k]], point
    )  # point[3:6] is the ray's direction in the other camera
    if not np.isnan(seen_depth[k]) and point[5] > 0.2:
        measured: float = (seen_depth[k] - point[2]) / point[5]
        return measured
    # least squares of direction * z + translation against the other ray: cross((x, y, 1), d z + t) = 0
    x, y = seen[k, 0], seen[k, 1]
    a0, a1, a2 = y * point[5] - point[4], point[3] - x * point[5], x * point[4] - y * point[3]
    b0, b1, b2 = y * point[2] - point[1], point[0] - x * point[2], x * point[1] - y * point[0]
    length = a0 * a0 + a1 * a1 + a2 * a2
    if length < 1e-12:
        return np.nan
    met: float = -(a0 * b0 + a1 * b1 + a2 * b2) / length
    return met


@kernel
def _apart(z: float, k: int, ray: Any, which: Any, rotation: Any, translation: Any, point: Any) -> float:
    """Cosine of the angle between the two rays to the point."""
    _other(z, ray, rotation[which[k]], translation[which[k]], point)
    product, one, two = 0.0, 0.0, 0.0
    for i in range(3):
        direction = point[3 + i]  # of the own ray, in the other camera
        product += direction * point[i]
        one += direction * direction
        two += point[i] * point[i]
    cosine: float = product / np.sqrt(one * two)
    return cosine


@kernel
def _descend(
    z: float, own: float, first: int, last: int, ray: Any, which: Any, rotation: Any, translation: Any, seen: Any,
    seen_depth: Any, noise: Any, point: Any, sums: Any,
) -> float:  # fmt: skip
    """The depth of least cost near `z`, by Gauss-Newton with steps halved until the cost falls."""
    tried = np.empty(4)
    _evaluate(z, own, first, last, ray, which, rotation, translation, seen, seen_depth, noise, point, sums)
    for _ in range(ITERATIONS):
        step = min(max(-sums[1] / max(sums[2], 1e-12), -0.3 * z), 0.3 * z)
        fallen = False
        for _ in range(6):
            _evaluate(
                z + step, own, first, last, ray, which, rotation, translation, seen, seen_depth, noise, point, tried
            )
            if tried[0] <= sums[0]:
                fallen = True
                break
            step *= 0.5
        if not fallen:
            break
        z += step
        sums[:] = tried
        if abs(step) < 1e-6 * z:
            break
    return z


@kernel
def _placed(
    z: float, first: int, last: int, ray: Any, which: Any, rotation: Any, translation: Any, seen: Any,
    seen_depth: Any, noise: Any, cosine: float, point: Any, sums: Any,
) -> bool:  # fmt: skip
    """Whether one that agrees measured the point, or sees it from far enough aside."""
    for k in range(first, last):
        _add(z, k, ray, which, rotation, translation, seen, seen_depth, noise, point, sums)
        if sums[3] < AGREES and (
            not np.isnan(seen_depth[k]) or _apart(z, k, ray, which, rotation, translation, point) < cosine
        ):
            return True
    return False


@kernel
def _solve(
    rays: Any, owns: Any, start: Any, which: Any, rotation: Any, translation: Any, seen: Any, seen_depth: Any,
    noise: Any, most_relative: float, cosine: float, depth: Any, sigma: Any, agreeing: Any,
) -> None:  # fmt: skip
    point, sums = np.empty(6), np.empty(4)
    for n in range(len(rays)):
        first, last, ray, own = start[n], start[n + 1], rays[n], owns[n]
        best, z = np.inf, np.nan
        for k in range(first - 1, last):
            guess = own if k < first else _guess(k, ray, which, rotation, translation, seen, seen_depth, point)
            if guess > NEAREST_M and guess < FARTHEST_M:
                _evaluate(
                    guess, own, first, last, ray, which, rotation, translation, seen, seen_depth, noise, point, sums
                )
                if sums[0] < best:
                    best, z = sums[0], guess
        if np.isnan(z):
            continue
        z = _descend(z, own, first, last, ray, which, rotation, translation, seen, seen_depth, noise, point, sums)
        spread = 1.0 / np.sqrt(max(sums[2], 1e-12))
        found = _evaluate(z, own, first, last, ray, which, rotation, translation, seen, seen_depth, noise, point, sums)
        if found == 0 or not z > NEAREST_M:
            continue
        if np.isnan(own):
            if spread > most_relative * z or not _placed(
                z, first, last, ray, which, rotation, translation, seen, seen_depth, noise, cosine, point, sums
            ):
                continue
        elif abs(z - own) > 3.0 * depth_sigma(own):
            continue  # what was measured here and what the others say are two things
        depth[n], sigma[n], agreeing[n] = z, spread, found
