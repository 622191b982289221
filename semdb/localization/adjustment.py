"""Equation (5) of the paper for one query: observations in, adjusted images out, and what they say of each pair."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semdb.geometry import invert_pose, transform_points
from semdb.localization.alignment import Alignment
from semdb.localization.bundle import BundleProblem, BundleResult, adjust, pixel_sigma
from semdb.localization.pairs import NEAREST_M, Pairs
from semdb.localization.pose_options import PoseOptions
from semdb.localization.views import KeyframeView, View
from semdb.types import BoolArray, Float32Array, FloatArray, IntArray


def in_front(points: FloatArray) -> FloatArray:
    """Normalised coordinates ``[n, 2]`` of camera-frame points, NaN where they are not in front of the camera."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(points[:, 2:] > NEAREST_M, points[:, :2] / points[:, 2:], np.nan)


def project_adjusted(query: View, keyframes: Sequence[KeyframeView], adjusted: BundleResult) -> list[FloatArray]:
    """Where the query sees each keyframe's points, ``[n, 2]`` pixels from the centre, NaN behind it.

    All images stand and turn as `adjusted` found; the points are those measured in the keyframes.
    """
    return [
        _projected(query, adjusted, slot, keyframe.view.points, keyframe.view.image_row)
        for slot, keyframe in enumerate(keyframes, start=1)
    ]


def _projected(
    query: View, adjusted: BundleResult, slot: int, points: Float32Array, image_row: FloatArray
) -> FloatArray:
    """As `project_adjusted`, of `points` ``[n, 3]`` that image `slot` sees in these rows ``[n]``."""
    local = points.astype(np.float64)
    local -= _crossed(adjusted.turn[slot] * image_row[:, None], local)
    world = transform_points(invert_pose(adjusted.image_from_world[slot]), local)
    seen = transform_points(adjusted.camera_from_world, world)
    # the row that sees a point, to first order where it would be without a turn
    row = np.clip(in_front(seen)[:, 1:] * query.focal / query.camera.height, -0.5, 0.5)
    return in_front(seen + _crossed(adjusted.turn[0] * row, seen)) * query.focal


def _crossed(one: FloatArray, two: FloatArray) -> FloatArray:
    """The cross products of rows ``[n, 3]``: to the bit `numpy.cross`, in a third of its time."""
    (a, b, c), (x, y, z) = one.T, two.T
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=1)


def bundle_adjust(
    query: View,
    keyframes: Sequence[KeyframeView],
    pairs: Pairs,
    points: FloatArray,
    camera_from_world: FloatArray,
    options: PoseOptions,
    alignment: Alignment | None = None,
    start: BundleResult | None = None,
) -> BundleResult:
    """Equation (5) over the agreeing pairs, whose `points` ``[n, 3]`` are a first guess in the world.

    Pairs of one query keypoint with several keyframes are one point, but for those that `alignment` found: each of
    these is the point of its keyframe's keypoint. Without an alignment the result is a rough one, from which the next
    may `start`.
    Raises numpy.linalg.LinAlgError where the pairs do not determine the pose.
    """
    aligned = np.zeros(len(pairs), np.bool_) if alignment is None else alignment.found
    point_key = np.where(aligned, len(query) + np.arange(len(pairs)), pairs.query)
    _, first, point_index = np.unique(point_key, return_index=True, return_inverse=True)
    counts = np.bincount(point_index).astype(np.float64)
    guess = np.stack([np.bincount(point_index, points[:, axis]) / counts for axis in range(3)], axis=1)
    seen = [_observations(query, pairs.query[first], aligned[first], options, with_depth=options.use_query_depth)]
    if alignment is not None:
        seen[0][:, :2] = alignment.xy[first]
    owner, image = [np.arange(len(first))], [np.zeros(len(first), np.int32)]
    for slot, keyframe in enumerate(keyframes):
        here = np.flatnonzero(pairs.slot == slot)
        seen.append(_observations(keyframe.view, pairs.keypoint[here], aligned[here], options, with_depth=True))
        owner.append(point_index[here])
        image.append(np.full(len(here), slot + 1, np.int32))
    observed, point = np.concatenate(seen), np.concatenate(owner).astype(np.int32)
    order = np.argsort(point, kind="stable")
    observed = observed[order]
    problem = BundleProblem(
        points=guess,
        observed_point=point[order],
        observed_image=np.concatenate(image)[order],
        xy=observed[:, :2],
        sigma=observed[:, 2],
        depth=observed[:, 3],
        rows=observed[:, 4],
        keyframe_from_world=np.stack([keyframe.camera_from_world for keyframe in keyframes]),
        looser=observed[:, 5],
        keyframe_sigma=_pose_sigmas(keyframes),
    )
    return adjust(
        problem, camera_from_world, options.motion, rough=alignment is None, start=start, evident=options.evident
    )


def _pose_sigmas(keyframes: Sequence[KeyframeView]) -> FloatArray | None:
    """Standard deviations ``[c, 2]`` of place and turn, NaN where they are not known; None where none are."""
    if all(keyframe.pose_sigma is None for keyframe in keyframes):
        return None
    return np.array([keyframe.pose_sigma or (np.nan, np.nan) for keyframe in keyframes])


def _observations(
    view: View, rows: IntArray, aligned: BoolArray, options: PoseOptions, *, with_depth: bool
) -> FloatArray:
    """(x, y, sigma, depth, row of the image, factor of the depth's noise) ``[n, 6]`` of keypoints `rows`."""
    sigma = pixel_sigma(view.size[rows], view.focal, options.pixel_sigma_px)
    sigma = np.where(aligned, options.aligned_sigma_px / view.focal, sigma)
    depth = view.points[rows, 2].astype(np.float64) if with_depth else np.full(len(rows), np.nan)
    looser = np.ones(len(rows)) if view.looser is None else view.looser[rows]
    return np.column_stack([view.xy[rows], sigma, depth, view.image_row[rows], looser])


def projected_error_px(query: View, pairs: Pairs, projected: Sequence[FloatArray]) -> FloatArray:
    """Distance ``[n]`` in pixels between the query's keypoints and where their pairs are `projected`, as above."""
    error = np.empty(len(pairs))
    for slot, there in enumerate(projected):
        here = pairs.slot == slot
        offset = there[pairs.keypoint[here]] - query.xy[pairs.query[here]] * query.focal
        error[here] = np.hypot(offset[:, 0], offset[:, 1])
    return np.where(np.isfinite(error), error, np.inf)


def pairs_error_px(query: View, keyframes: Sequence[KeyframeView], pairs: Pairs, adjusted: BundleResult) -> FloatArray:
    """`projected_error_px` where only the points of pairs are projected, which is less work."""
    error = np.full(len(pairs), np.inf)
    for slot, keyframe in enumerate(keyframes):
        here = np.flatnonzero(pairs.slot == slot)
        rows = pairs.keypoint[here]
        view = keyframe.view
        there = _projected(query, adjusted, slot + 1, view.points[rows], view.image_row[rows])
        offset = there - query.xy[pairs.query[here]] * query.focal
        error[here] = np.hypot(offset[:, 0], offset[:, 1])
    return np.where(np.isfinite(error), error, np.inf)
