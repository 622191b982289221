"""A query's depth laid on the surfaces of keyframes: a pose where keypoints are few, or lie.

Point to plane (Chen and Medioni, ICRA 1991) with projective association, and grey values beside (Kerl, Sturm and
Cremers, IROS 2013), coarse to fine, on several keyframes at once. What the surfaces leave free - along a bare wall,
about the axis of a column - shows in the information matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.geometry import pose_error, so3_exp, transform_points
from semdb.localization.surfaces import Surfaces
from semdb.types import FloatArray

LONGEST_STEP = 0.1  # metres and radians together
STILL = 2e-5
SAME_M, SAME_DEG = 0.03, 1.5  # poses nearer than this are one


@dataclass(frozen=True, slots=True)
class Round:
    """Some steps on one level: what is further than `gate_m` off is left out, `floor_m` adds to the sensor's noise.

    Every `every`-th point is taken.
    """

    level: int
    gate_m: float
    floor_m: float
    steps: int
    every: int = 1


@dataclass(frozen=True, slots=True)
class SurfaceOptions:
    """`coarse` rounds tell starts apart, `fine` ones finish the best."""

    starts: int = 3  # keyframes from whose poses it is looked for, beside the pose of the keypoints
    keyframes: int = 4  # on which it is laid
    finished: int = 3  # poses that the fine rounds are spent on
    grey_sigma: float = 12.0  # of 255
    followed: int = 3  # poses that go on after the first coarse round
    far_less: float = 0.2  # of the score after coarse rounds: a pose that lies so much worse than the best is left
    coarse: tuple[Round, ...] = (Round(1, 0.30, 0.02, 8, 5), Round(1, 0.15, 0.01, 8, 5))
    fine: tuple[Round, ...] = (Round(0, 0.06, 0.004, 8, 7), Round(0, 0.06, 0.004, 2, 2))


# every point, for those who have a place for it in time: the frames of a trajectory
THOROUGH = SurfaceOptions(
    starts=5,
    followed=6,
    far_less=9.0,
    coarse=(Round(1, 0.30, 0.02, 8), Round(1, 0.15, 0.01, 8)),
    fine=(Round(0, 0.06, 0.004, 6),),
)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSurfaces:
    """Surfaces of a keyframe in the world: points and normals ``[n, 3]`` of each level."""

    keyframe_id: int
    world_from_camera: FloatArray
    surfaces: Surfaces
    points: tuple[FloatArray, ...]
    normals: tuple[FloatArray, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """A pose, and how the surfaces agree with it; shares are of the points that the query has a depth for.

    `information` ``[6, 6]`` is of translation (m, world) and rotation (rad, left perturbation in the world), as if
    every point were independent; `scatter` ``[6, 6]`` the covariance that keyframes show which disagree.
    """

    world_from_camera: FloatArray
    information: FloatArray
    scatter: FloatArray
    seen: int
    near: float  # lie where the query measured them
    alike: float  # look as they do in the query
    occluded: float  # the query measured something before them
    through: float  # it looked through them
    correlation: float  # of grey values, over all keyframes
    detail: float  # the same of what is left of them without the light

    @property
    def score(self) -> float:
        """For telling starts apart: geometry and looks together, less what contradicts."""
        return self.near + self.alike - 2 * self.through


def place(keyframe_id: int, surfaces: Surfaces, world_from_camera: FloatArray) -> PlacedSurfaces:
    """`surfaces` of a keyframe moved to the world."""
    turn = world_from_camera[:3, :3].T
    return PlacedSurfaces(
        keyframe_id,
        world_from_camera,
        surfaces,
        tuple(transform_points(world_from_camera, level.points) for level in surfaces),
        tuple(np.ascontiguousarray(level.normals @ turn) for level in surfaces),
    )


def fit_surfaces(
    query: Surfaces,
    keyframes: Sequence[PlacedSurfaces],
    start: FloatArray,
    rounds: Sequence[Round],
    options: SurfaceOptions,
) -> SurfaceFit | None:
    """The pose near `start` ``[4, 4]`` (world_from_camera) at which the query's surfaces lie on those of `keyframes`.

    None where nothing overlaps.
    """
    pose = start
    last = rounds[-1]
    tones = np.tile([1.0, 0.0], (len(keyframes), 1))  # gain and bias of each keyframe's grey values
    level = -1
    for now in rounds:
        if now.level != level:  # else they are known from the last step
            tones = _tones(_linearise(query, keyframes, pose, now, tones, options, use_grey=False)[2], tones)
        level = now.level
        for _ in range(now.steps):
            matrix, gradient, counts = _linearise(query, keyframes, pose, now, tones, options, use_grey=True)
            damping = 1e-6 * float(np.trace(matrix)) / 6 + 1e-6
            step = -np.linalg.solve(matrix + damping * np.eye(6), gradient)
            size = float(np.linalg.norm(step))
            pose = moved(pose, step * min(1.0, LONGEST_STEP / max(size, 1e-12)))
            tones = _tones(counts, tones)
            if size < STILL:
                break
    single = [
        _linearise(query, [keyframe], pose, last, tones[k : k + 1], options, use_grey=True)
        for k, keyframe in enumerate(keyframes)
    ]
    matrices, gradients, counts = (
        (np.stack(part) for part in zip(*single, strict=True)) if single else [np.zeros(0)] * 3
    )
    # as if every point had been taken
    return _fit(pose, last.every * matrices, last.every * gradients, counts[:, 0]) if single else None


def distinct(fits: Sequence[SurfaceFit]) -> list[list[SurfaceFit]]:
    """`fits` in groups of one pose each, best score first in each and among them."""
    groups: list[list[SurfaceFit]] = []
    for fit in sorted(fits, key=lambda fit: -fit.score):
        for group in groups:
            distance, angle = pose_error(fit.world_from_camera, group[0].world_from_camera)
            if distance < SAME_M and angle < SAME_DEG:
                group.append(fit)
                break
        else:
            groups.append([fit])
    return groups


def _linearise(
    query: Surfaces,
    keyframes: Sequence[PlacedSurfaces],
    pose: FloatArray,
    now: Round,
    tones: FloatArray,
    options: SurfaceOptions,
    *,
    use_grey: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal equations ``[6, 6]``, ``[6]`` and what was counted ``[k, COUNTS]`` of each keyframe."""
    from semdb.localization.surface_kernels import COUNTS, accumulate

    matrix, gradient, counts = np.zeros((6, 6)), np.zeros(6), np.zeros((len(keyframes), COUNTS))
    level = min(now.level, len(query) - 1)
    target = query[level]
    for k, keyframe in enumerate(keyframes):
        at = min(level, len(keyframe.surfaces) - 1)
        source = keyframe.surfaces[at]
        accumulate(
            keyframe.points[at], keyframe.normals[at], source.point_grey, source.point_detail,
            source.point_variance, now.floor_m**2, now.every, target.depth, target.grey, target.detail, target.variance,
            target.intrinsics, pose,
            now.gate_m, tones[k, 0], tones[k, 1], options.grey_sigma**2, use_grey, matrix, gradient, counts[k],
        )  # fmt: skip
    return np.triu(matrix) + np.triu(matrix, 1).T, gradient, counts


def _grey_sums(counts: FloatArray) -> FloatArray:
    """Weight, k, q, kk, qk and qq ``[6, n]`` of what was counted of each keyframe."""
    from semdb.localization.surface_kernels import DETAIL_FIRST, GREY_FIRST

    return counts[:, GREY_FIRST:DETAIL_FIRST].T


def _tones(counts: FloatArray, known: FloatArray) -> FloatArray:
    """Gain and bias ``[k, 2]`` from a keyframe's grey values to the query's; `known` where few are seen."""
    weight, k, q, kk, qk, _ = _grey_sums(counts)
    safe = np.maximum(weight, 1.0)
    variance, covariance = kk / safe - (k / safe) ** 2, qk / safe - k * q / safe**2
    gain = np.clip(covariance / np.maximum(variance, 1e-6), 0.5, 2.0)
    return np.where((weight > 50)[:, None], np.column_stack([gain, (q - gain * k) / safe]), known)


def _fit(pose: FloatArray, matrices: FloatArray, gradients: FloatArray, counts: FloatArray) -> SurfaceFit | None:
    from semdb.localization.surface_kernels import ALIKE, DETAIL_FIRST, NEAR, OCCLUDED, SEEN, THROUGH

    total = counts.sum(axis=0)
    seen = int(total[SEEN])
    if not seen or not np.isfinite(pose).all():
        return None
    return SurfaceFit(
        world_from_camera=pose,
        information=matrices.sum(axis=0),
        scatter=scatter_of(matrices, gradients),
        seen=seen,
        near=float(total[NEAR] / seen),
        alike=float(total[ALIKE] / seen),
        occluded=float(total[OCCLUDED] / seen),
        through=float(total[THROUGH] / seen),
        correlation=_correlation(counts),
        detail=float(total[DETAIL_FIRST + 1] / np.sqrt(max(total[DETAIL_FIRST] * total[DETAIL_FIRST + 2], 1e-9))),
    )


def scatter_of(matrices: FloatArray, gradients: FloatArray) -> FloatArray:
    """Covariance ``[6, 6]`` of the pose from how it moves without each of the keyframes in turn (the jackknife).

    Keyframes' recorded poses are off by more than the noise of thousands of points. Efron, The jackknife, the bootstrap
    and other resampling plans, SIAM 1982.
    """
    held = np.flatnonzero(np.trace(matrices, axis1=1, axis2=2) > 0)
    count = len(held)
    if count < 2:
        return np.zeros((6, 6))
    whole, pull = matrices.sum(axis=0), gradients.sum(axis=0)
    keep = 1e-3 * np.diag(np.diag(whole)) + 1e-9 * np.eye(6)  # what one keyframe alone holds does not run away
    steps = np.stack([-np.linalg.solve(whole - matrices[k] + keep, pull - gradients[k]) for k in held])
    steps -= steps.mean(axis=0)
    return np.asarray((count - 1) / count * steps.T @ steps)


def _correlation(counts: FloatArray) -> float:
    """Of the grey values of all keyframes with the query's, each about its own mean."""
    sums = _grey_sums(counts)
    weight, k, q, kk, qk, qq = sums[:, sums[0] > 50]
    own, theirs = (kk - k * k / weight).sum(), (qq - q * q / weight).sum()
    both = (qk - q * k / weight).sum()
    return float(both / np.sqrt(max(float(own * theirs), 1e-9)))


def moved(pose: FloatArray, step: npt.NDArray[np.floating[Any]]) -> FloatArray:
    """`pose` after a step ``[6]`` in the world: translation, and a rotation (left perturbation) about the camera."""
    result = pose.copy()
    result[:3, :3] = so3_exp(step[3:]) @ pose[:3, :3]
    result[:3, 3] += step[:3]
    return result
