"""A query's edges laid on those of keyframes: a pose from colour alone where keypoints are few, or lie.

Edges in space are looked for across their course in the image, as in model-based tracking (Harris and Stennett, RAPID,
BMVC 1990; Drummond and Cipolla, PAMI 24(7), 2002), from far to near, on several keyframes at once. Grey values
themselves, laid on each other, do not tell the pose of a plain place: what a lamp and a lens make of a floor is more
than what is on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semdb.geometry import pose_error
from semdb.localization.edges import ImageEdges, PlacedEdges
from semdb.localization.surface_alignment import LONGEST_STEP, SAME_DEG, SAME_M, moved, scatter_of
from semdb.types import FloatArray

STILL, STILL_COARSE = 2e-4, 2e-3  # metres and radians together
COVER_ACROSS = 160  # pixels of the image in which it is told what is hidden
COARSE_COVER = 2  # every other point will do in coarse rounds,
FINE = 2  # which take fewer points than every second
COVER_EVERY = 3  # steps, of fine rounds
NEAR_PX = 4  # an edge of the query is explained that far from where one is expected
LEAST_CLEAR = 50  # pixels of the query's edges, fewer say nothing


@dataclass(frozen=True, slots=True)
class EdgeRound:
    """Some steps: every `every`-th edge point, `radius_px` far, gradients that differ by an angle of cosine `turn`."""

    radius_px: float
    turn: float
    sigma_px: float
    steps: int
    every: int


@dataclass(frozen=True, slots=True)
class EdgeOptions:
    """`coarse` rounds tell starts apart, `fine` ones finish the best."""

    starts: int = 3  # keyframes from whose poses it is looked for, beside the pose of the keypoints
    keyframes: int = 4  # on which it is laid
    finished: int = 3  # poses that the fine rounds are spent on
    far_less: float = 0.25  # hit after coarse rounds: a pose of which so much less is left
    coarse: tuple[EdgeRound, ...] = (EdgeRound(40, 0.7, 6, 5, 8), EdgeRound(20, 0.8, 4, 5, 5))
    fine: tuple[EdgeRound, ...] = (EdgeRound(10, 0.85, 2, 6, 2), EdgeRound(5, 0.9, 1.5, 6, 1))


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """A pose, and how edges agree with it.

    `information` ``[6, 6]`` is of translation (m, world) and rotation (rad, left perturbation in the world), as if
    every point were independent; `scatter` ``[6, 6]`` the covariance that keyframes show which disagree.
    """

    world_from_camera: FloatArray
    information: FloatArray
    scatter: FloatArray
    seen: int  # edge points of keyframes that should be seen
    hit: float  # share of them that are
    explained: float  # share of the query's clear edges that are expected where they are


Near = Callable[[FloatArray], Sequence[PlacedEdges]]  # edges of the keyframes near a pose, nearest first


def search_edges(query: ImageEdges, starts: Sequence[FloatArray], near: Near, options: EdgeOptions) -> list[EdgeFit]:
    """Poses at which the query's edges lie well on those of keyframes, from any of `starts` ``[4, 4]``, best first.

    No two are the same; at most `finished` of the options. One on which far fewer edges lie than on the best after
    coarse rounds stays where these left it, and is measured as the others are.
    """
    coarse = _distinct([fit_edges(query, near(start), start, options.coarse) for start in starts])
    fine = []
    for found in coarse[: options.finished]:
        pose, far = found.world_from_camera, found.hit < coarse[0].hit - options.far_less
        if far:
            fine.append(measure_edges(query, near(pose), pose, options.fine[-1]))
        else:
            fine.append(fit_edges(query, near(pose), pose, options.fine))
    return _distinct(fine)


def fit_edges(
    query: ImageEdges, keyframes: Sequence[PlacedEdges], start: FloatArray, rounds: Sequence[EdgeRound]
) -> EdgeFit | None:
    """The pose near `start` ``[4, 4]`` (world_from_camera) at which the query's edges lie on those of `keyframes`.

    None where nothing is seen of them.
    """
    pose, last = start, rounds[-1]
    for now in rounds:
        nearest = _cover(query, keyframes, pose, 1 if now.every <= FINE else COARSE_COVER)
        for count in range(now.steps):
            if count and count % COVER_EVERY == 0 and now.every <= FINE:
                nearest = _cover(query, keyframes, pose)
            matrix, gradient, _ = _linearise(query, keyframes, pose, now, nearest)
            matrix, gradient = matrix.sum(axis=0), gradient.sum(axis=0)
            damping = 1e-3 * np.diag(np.diag(matrix)) + 1e-6 * np.eye(6)
            step = -np.linalg.solve(matrix + damping, gradient)
            size = float(np.linalg.norm(step))
            pose = moved(pose, step * min(1.0, LONGEST_STEP / max(size, 1e-12)))
            if size < (STILL if now.every <= FINE else STILL_COARSE):
                break
    return measure_edges(query, keyframes, pose, last)


def measure_edges(
    query: ImageEdges, keyframes: Sequence[PlacedEdges], pose: FloatArray, at: EdgeRound
) -> EdgeFit | None:
    """How edges agree with a pose as it is; None where nothing is seen of them."""
    from semdb.localization.edge_kernels import HIT, SEEN

    if not keyframes or not np.isfinite(pose).all():
        return None
    marked = np.zeros(query.strength.shape, np.uint8)
    nearest = _cover(query, keyframes, pose)
    matrices, gradients, counts = _linearise(query, keyframes, pose, at, nearest, marked)
    total = counts.sum(axis=0)
    if not total[SEEN]:
        return None
    return EdgeFit(
        world_from_camera=pose,
        information=matrices.sum(axis=0),
        scatter=scatter_of(matrices, gradients),
        seen=int(total[SEEN]),
        hit=float(total[HIT] / total[SEEN]),
        explained=_explained(query, marked, nearest),
    )


def _distinct(fits: Sequence[EdgeFit | None]) -> list[EdgeFit]:
    """The best of those that are one pose, best first."""
    kept: list[EdgeFit] = []
    for fit in sorted((fit for fit in fits if fit is not None), key=lambda fit: -fit.hit):
        errors = [pose_error(fit.world_from_camera, other.world_from_camera) for other in kept]
        if all(distance > SAME_M or angle > SAME_DEG for distance, angle in errors):
            kept.append(fit)
    return kept


def _cover(query: ImageEdges, keyframes: Sequence[PlacedEdges], pose: FloatArray, every: int = 1) -> FloatArray:
    """Depth ``[h, w]``, of a small image, of the nearest that keyframes show there; infinite where that is unknown."""
    from semdb.localization.edge_kernels import cover

    height, width = query.strength.shape
    shrink = _shrink(query)
    nearest = np.full((max(round(height * shrink), 1), max(round(width * shrink), 1)), np.inf)
    fx, fy, cx, cy = query.intrinsics
    small = np.array([fx * shrink, fy * shrink, (cx + 0.5) * shrink - 0.5, (cy + 0.5) * shrink - 0.5])
    for keyframe in keyframes:
        cover(keyframe.edges.cover, every, small, pose, nearest)
    return nearest


def _shrink(query: ImageEdges) -> float:
    width: int = query.strength.shape[1]
    return min(1.0, COVER_ACROSS / width)


def _linearise(
    query: ImageEdges,
    keyframes: Sequence[PlacedEdges],
    pose: FloatArray,
    now: EdgeRound,
    nearest: FloatArray,
    marked: np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal equations ``[k, 6, 6]``, ``[k, 6]`` and counts ``[k, COUNTS]`` of each keyframe."""
    from semdb.localization.edge_kernels import COUNTS, match_edges

    count = len(keyframes)
    matrices, gradients, counts = np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros((count, COUNTS))
    marks = np.zeros((0, 0), np.uint8) if marked is None else marked
    for k, keyframe in enumerate(keyframes):
        match_edges(
            keyframe.edges.points, keyframe.edges.tangents, now.every,
            query.strength, query.offset, query.along_x, query.along_y, query.intrinsics, pose,
            nearest, _shrink(query), now.radius_px, now.turn, now.sigma_px,
            matrices[k], gradients[k], counts[k], marks,
        )  # fmt: skip
    upper = np.triu(matrices, 1)
    return np.triu(matrices) + upper.transpose(0, 2, 1), gradients, counts


def _explained(
    query: ImageEdges, marked: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], nearest: FloatArray
) -> float:
    """Of the query's clear edges that lie where keyframes show something, the share near one that is expected."""
    height, width = query.strength.shape
    shown = cv2.resize(np.isfinite(nearest).astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    side = 2 * NEAR_PX + 1
    expected = cv2.dilate(marked, np.ones((side, side), np.uint8)) > 0
    clear = query.clear & shown
    count = int(np.count_nonzero(clear))
    return float(np.count_nonzero(clear & expected) / count) if count >= LEAST_CLEAR else 0.0
