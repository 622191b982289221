"""Poses from which the whole of a query looks like what a keyframe saw, where keypoints find none.

Images of plain things have few keypoints, and none that a keyframe turned aside has too. But where walls, doors and
floors are light and dark is there from anywhere: what a keyframe saw, with its depth, is correlated with the image from
poses about that of the keyframe (as in coarse registration of range images with intensities), and the best are climbed.
It says where to look and nothing more: what is found is judged by what is predicted from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from semdb.geometry import pose_error
from semdb.localization.predicted_view import PlacedView, SmallView
from semdb.types import Float32Array, FloatArray, Tolerance

SPARSE = 4  # of the points, in the first look
MOST_MOVES = 8  # of one length


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """About each keyframe."""

    every: int = 4  # pixels of the small image from one point to the next
    blurs: tuple[float, float] = (2.5, 1.5)  # pixels, of both: the second once poses were climbed with the first
    turns_deg: tuple[float, ...] = (-45, -36, -27, -18, -9, 0, 9, 18, 27, 36, 45)  # to the side
    steps_m: tuple[float, ...] = (-0.5, 0, 0.5)  # ahead and aside
    climbed: int = 8  # poses, from steps of
    climb_m: float = 0.25
    climb_deg: float = 5.0
    halvings: int = 4
    kept: int = 4
    same: Tolerance = field(default_factory=lambda: Tolerance(0.2, 6.0))
    least: float = 0.5  # correlation


def search_views(query: SmallView, keyframes: Sequence[PlacedView], options: SearchOptions) -> list[FloatArray]:
    """Poses ``[4, 4]`` from which `query` correlates with one of `keyframes`, the best first, no two the same."""
    from semdb.localization.view_search_kernels import correlations

    coarse, fine = options.blurs
    grey, around = _blurred(query.grey, coarse), _around(options)
    starts: list[tuple[float, FloatArray, PlacedView]] = []
    for keyframe in keyframes:
        points = _points(keyframe, coarse, options)
        if points is None:
            continue
        poses = keyframe.world_from_camera @ around
        found = np.empty(len(poses))
        correlations(*points, SPARSE, grey, query.intrinsics, poses, found)
        order = np.argsort(-found, kind="stable")[: options.kept]
        starts += [(float(found[k]), poses[k], keyframe) for k in order]
    rounds = (coarse, options.climb_m, options.climb_deg), (fine, options.climb_m / 4, options.climb_deg / 4)
    for blur, metres, degrees in rounds:
        grey = _blurred(query.grey, blur)
        ends = []
        for _, pose, keyframe in _distinct(starts, options.climbed, options.same):
            points = _points(keyframe, blur, options)
            if points is not None:
                ends.append(
                    (*_climbed(pose, points, grey, query.intrinsics, metres, degrees, options.halvings), keyframe)
                )
        starts = ends
    return [pose for score, pose, _ in _distinct(starts, options.kept, options.same) if score >= options.least]


def _distinct(
    found: Sequence[tuple[float, FloatArray, PlacedView]], count: int, same: Tolerance
) -> list[tuple[float, FloatArray, PlacedView]]:
    """The best `count`, the best first, no two of one pose."""
    kept: list[tuple[float, FloatArray, PlacedView]] = []
    for one in sorted(found, key=lambda one: -one[0]):
        if len(kept) == count:
            break
        if not any(is_same(one[1], other[1], same) for other in kept):
            kept.append(one)
    return kept


def _blurred(grey: Float32Array, blur: float) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), blur), np.float32)


def _points(keyframe: PlacedView, blur: float, options: SearchOptions) -> tuple[FloatArray, Float32Array] | None:
    """World points ``[n, 3]`` and grey values of a keyframe; None of one that has hardly a depth."""
    view, depth = keyframe.view, keyframe.view.depth
    if depth is None:
        return None
    grey, half = _blurred(view.grey, blur), options.every // 2
    v, u = np.mgrid[half : depth.shape[0] : options.every, half : depth.shape[1] : options.every]
    z = depth[v, u].astype(np.float64)
    known = z > 0
    fx, fy, cx, cy = view.intrinsics
    local = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)[known]
    pose = keyframe.world_from_camera
    return local @ pose[:3, :3].T + pose[:3, 3], grey[v, u][known]


def _around(options: SearchOptions) -> FloatArray:
    """Poses ``[k, 4, 4]`` about a camera."""
    found = []
    for turn in np.radians(options.turns_deg):
        for aside in options.steps_m:
            for ahead in options.steps_m:
                pose = np.eye(4)
                pose[:3, :3] = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
                pose[:3, 3] = aside, 0, ahead
                found.append(pose)
    return np.array(found)


def _climbed(
    pose: FloatArray,
    points: tuple[FloatArray, Float32Array],
    grey: Float32Array,
    lens: FloatArray,
    metres: float,
    degrees: float,
    halvings: int,
) -> tuple[float, FloatArray]:
    """The pose near `pose` of greatest correlation, along one of six directions at a time."""
    from semdb.localization.view_search_kernels import correlations

    found, best = np.empty(12), np.empty(1)
    correlations(*points, 1, grey, lens, pose[None], best)
    score = float(best[0])
    for half in range(halvings):
        moves = _directions(metres / 2**half, np.radians(degrees) / 2**half)
        for _ in range(MOST_MOVES):
            poses = pose @ moves
            correlations(*points, 1, grey, lens, poses, found)
            k = int(np.argmax(found))
            if found[k] <= score:
                break
            score, pose = float(found[k]), poses[k]
    return score, pose


def _directions(metres: float, radians: float) -> FloatArray:
    """Small moves ``[12, 4, 4]`` of a camera, to both sides along and about its axes."""
    found = np.tile(np.eye(4), (12, 1, 1))
    for axis in range(3):
        for k, sign in enumerate((1.0, -1.0)):
            found[2 * axis + k, axis, 3] = sign * metres
            turn = np.zeros(3)
            turn[axis] = sign * radians
            found[6 + 2 * axis + k, :3, :3] = cv2.Rodrigues(turn)[0]
    return found


def is_same(pose: FloatArray, other: FloatArray, tolerance: Tolerance) -> bool:
    """Whether two poses ``[4, 4]`` are nearer to each other than `tolerance`."""
    metres, degrees = pose_error(pose, other)
    return metres < tolerance.metres and degrees < tolerance.degrees
