"""The fine step: 2D-3D pairs from several keyframes, robust PnP, guided matching, bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import poselib

from semdb.geometry import invert_pose, transform_points
from semdb.localization.adjustment import (
    bundle_adjust,
    in_front,
    pairs_error_px,
    project_adjusted,
    projected_error_px,
)
from semdb.localization.alignment import Alignment, align_pairs
from semdb.localization.bundle import BundleResult
from semdb.localization.learned_matching import KeypointMatcher, match_by
from semdb.localization.matching import Matches, MatchingOptions, match_keypoints
from semdb.localization.pairs import Pairs, guided_pairs, join_pairs, reprojection_px, world_points_of
from semdb.localization.pose_options import PoseOptions
from semdb.localization.recorded_errors import AtQuery, at_query, recorded_errors, shrunk, weighted
from semdb.localization.views import KeyframeView, View
from semdb.threads import each
from semdb.types import BoolArray, FloatArray, IntArray

MINIMUM_PAIRS = 6  # below, a pose from 3 points has nothing to be checked with


@dataclass(frozen=True, slots=True)
class FirstSupport:
    """Pairs that agree on a pose before any was guided: `inliers` distinct keypoints of the query, `of_best` pairs."""

    inliers: int  # of all keyframes
    of_best: int  # with the keyframe that has most of them
    agreement: float  # their share of the pairs with that keyframe
    best: int  # which keyframe it is


@dataclass(frozen=True, slots=True, eq=False)
class FirstPose:
    """A pose found in a few milliseconds: enough to decide whether more keyframes are to be matched.

    `inliers` (distinct keypoints of the query, guided) and `spread` are as in `PoseEstimate`, of a pose that nothing
    refined: those of a turning camera are fewer than in the end.
    """

    camera_from_world: FloatArray
    keyframes: int  # how many were matched
    first: FirstSupport
    inliers: int
    spread: float
    guided: tuple[Pairs, FloatArray] | None = None  # pairs near its projections, and their points

    @property
    def world_from_camera(self) -> FloatArray:
        return invert_pose(self.camera_from_world)

    @property
    def first_inliers(self) -> int:
        return self.first.inliers


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A pose with its support. `inliers` counts distinct keypoints of the query, `per_keyframe` the pairs.

    Guided matching finds pairs for wrong poses too, so what the first matching, which knew no pose, agreed on is kept
    beside: `first_inliers` pairs of all keyframes, and their share `agreement` of the pairs with the keyframe that has
    most of them.
    """

    world_from_camera: FloatArray
    covariance: FloatArray | None
    pairs: Pairs  # inliers only
    inliers: int
    per_keyframe: tuple[int, ...]
    first_inliers: int
    first_of_best: int  # those with the keyframe that has most of them
    agreement: float
    residual_px: float  # median reprojection error of the inliers
    spread: float  # 0..1: share of a 4x4 grid over the image that holds inliers
    aligned: int = 0  # pairs whose patches are alike to a fraction of a pixel; 0 without images
    recorded: FloatArray | None = None  # [6, 6] of how far poses recorded here are off, beyond `covariance`
    at: AtQuery | None = None  # where these errors meet the query
    turn: FloatArray | None = None  # [3] rad, of the query in its own frame while it was read out; None without bundle
    seen: Alignment | None = None  # where the query shows `pairs`, to a fraction of a pixel where patches were aligned


def match_views(query: View, keyframes: Sequence[KeyframeView], options: PoseOptions) -> list[Matches]:
    """First matching with each of `keyframes`, without a pose."""
    return each(
        lambda keyframe: match_view(query, keyframe, options.matching, options.matcher), keyframes, options.threads
    )


def match_view(
    query: View, keyframe: KeyframeView, options: MatchingOptions, matcher: KeypointMatcher | None = None
) -> Matches:
    """First matching, without a pose; by a `matcher` where there is one, else by nearest neighbours."""
    view = keyframe.view
    if matcher is not None:
        return match_by(matcher, query, view, options)
    return match_keypoints(
        query.descriptors, view.descriptors, query.classes, view.classes, options,
        query_signs=query.signs, keyframe_signs=view.signs,
    )  # fmt: skip


def robust_pnp(
    query: View, pairs: Pairs, points: FloatArray, options: PoseOptions, max_iterations: int = 10000
) -> tuple[FloatArray, BoolArray] | None:
    """LO-RANSAC over all pairs (PoseLib): ``camera_from_world`` and which pairs agree; None where none is found."""
    if len(pairs) < MINIMUM_PAIRS:
        return None
    pixels = query.xy[pairs.query] * query.focal
    ransac = {
        "max_reproj_error": options.max_reprojection_px,
        "min_iterations": min(200, max_iterations),
        "max_iterations": max_iterations,
        "seed": 0,
    }
    pose, report = poselib.estimate_absolute_pose(pixels, points, pinhole(query), ransac, {"loss_type": "CAUCHY"})
    inliers = np.asarray(report["inliers"], np.bool_)
    if inliers.sum() < MINIMUM_PAIRS:
        return None
    camera_from_world = np.eye(4)
    camera_from_world[:3] = pose.Rt
    if not np.isfinite(camera_from_world).all():
        return None
    return camera_from_world, inliers


def pinhole(query: View) -> dict[str, Any]:
    """The camera of pixels that are undistorted and counted from the centre, as PoseLib wants it."""
    width, height = query.camera.width, query.camera.height
    return {"model": "SIMPLE_PINHOLE", "width": width, "height": height, "params": [query.focal, 0, 0]}


def first_pose(
    query: View, keyframes: Sequence[KeyframeView], matches: Sequence[Matches], options: PoseOptions
) -> FirstPose | None:
    """The pose that most pairs with all `keyframes` agree on, not refined, or None.

    `matches` are those of `match_view`, one per keyframe.
    """
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    found = robust_pnp(query, pairs, points, options)
    return None if found is None else _first_at(query, keyframes, pairs, points, *found, options)


def first_pose_at(
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    camera_from_world: FloatArray,
    options: PoseOptions,
) -> FirstPose | None:
    """As `first_pose`, of a pose that is given; None where no pair agrees on it."""
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    agreeing = reprojection_px(query, camera_from_world, pairs.query, points) < options.max_reprojection_px
    if not agreeing.any():
        return None
    return _first_at(query, keyframes, pairs, points, camera_from_world, agreeing, options)


def _first_at(
    query: View,
    keyframes: Sequence[KeyframeView],
    pairs: Pairs,
    points: FloatArray,
    camera_from_world: FloatArray,
    agreeing: BoolArray,
    options: PoseOptions,
) -> FirstPose:
    first = _first_support(pairs, agreeing)
    guided = _guided_by_pose(query, keyframes, camera_from_world, options) if options.guided else None
    pairs, points = guided or (pairs, points)
    error = reprojection_px(query, camera_from_world, pairs.query, points)
    rows = pairs.query[error < options.inlier_px]
    return FirstPose(camera_from_world, len(keyframes), first, len(np.unique(rows)), image_spread(query, rows), guided)


def estimate_pose(
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: PoseOptions,
    start: FirstPose | None = None,
) -> PoseEstimate | None:
    """The pose that the pairs with all `keyframes` agree on, or None.

    `matches` are those of `match_view`, one per keyframe. With `start`, which `first_pose` found with the first of
    them, no other pose is looked for.
    """
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    if start is None:
        start = first_pose(query, keyframes, matches, options)
        if start is None:
            return None
    camera_from_world, first = start.camera_from_world, start.first
    if start.keyframes < len(keyframes):
        camera_from_world = _joined_pose(query, pairs, points, camera_from_world, options)
    agreeing = reprojection_px(query, camera_from_world, pairs.query, points) < options.max_reprojection_px
    if start.keyframes < len(keyframes) and agreeing.any():
        first = _first_support(pairs, agreeing)
    if options.guided:
        known = start.guided if start.keyframes == len(keyframes) else None
        pairs, points = known or _guided_by_pose(query, keyframes, camera_from_world, options)
        agreeing = reprojection_px(query, camera_from_world, pairs.query, points) < options.max_reprojection_px
    if agreeing.sum() < MINIMUM_PAIRS:
        return None
    if not options.bundle:
        pairs, points = pairs.take(agreeing), points[agreeing]
        error = reprojection_px(query, camera_from_world, pairs.query, points)
        return _estimate(query, keyframes, pairs, error, camera_from_world, None, first, options)
    try:
        pairs, error, refined, seen = _refine(query, keyframes, pairs, points, agreeing, camera_from_world, options)
    except np.linalg.LinAlgError:
        return None
    pose = refined.camera_from_world
    estimate = _estimate(query, keyframes, pairs, error, pose, refined.covariance, first, options)
    if estimate is None or estimate.covariance is None:
        return None
    keep = error < options.inlier_px
    aligned = int(np.count_nonzero(seen.found))
    alignment = Alignment(seen.xy[keep], seen.found[keep])
    at = at_query(refined.nearest, refined.turn, estimate.per_keyframe, estimate.world_from_camera)
    found = replace(estimate, aligned=aligned, at=at, turn=refined.turn[0], seen=alignment)
    if not options.evident:
        return found
    # by what this query shows, what its keyframes' recordings do, and what is usual
    measured = weighted([keyframe.pose_errors for keyframe in keyframes], estimate.per_keyframe)
    return replace(found, recorded=recorded_errors(shrunk(refined.evident, measured), at, estimate.covariance))


def recorded_covariance(estimate: PoseEstimate) -> FloatArray | None:
    """``[6, 6]`` of the pose in the frame of the recorded poses: what images leave open, and how far these are off."""
    if estimate.covariance is None or estimate.recorded is None:
        return estimate.covariance
    return estimate.covariance + estimate.recorded


def _joined_pose(
    query: View, pairs: Pairs, points: FloatArray, camera_from_world: FloatArray, options: PoseOptions
) -> FloatArray:
    """The pose fitted also to the pairs with keyframes that joined later, unless fewer pairs agree on it then."""
    error = reprojection_px(query, camera_from_world, pairs.query, points)
    near = error < 2 * options.max_reprojection_px
    if near.sum() < MINIMUM_PAIRS:
        return camera_from_world
    start = poselib.CameraPose()
    start.R, start.t = camera_from_world[:3, :3], camera_from_world[:3, 3]
    pixels = query.xy[pairs.query[near]] * query.focal
    loss = {"loss_type": "CAUCHY", "loss_scale": options.pixel_sigma_px}
    pose, _ = poselib.refine_absolute_pose(pixels, points[near], start, pinhole(query), loss)
    fitted = np.eye(4)
    fitted[:3] = pose.Rt
    agreeing = reprojection_px(query, fitted, pairs.query, points) < options.max_reprojection_px
    better = np.isfinite(fitted).all() and agreeing.sum() >= (error < options.max_reprojection_px).sum()
    return fitted if better else camera_from_world


def _guided_by_pose(
    query: View, keyframes: Sequence[KeyframeView], camera_from_world: FloatArray, options: PoseOptions
) -> tuple[Pairs, FloatArray]:
    """Pairs near where a pose alone projects the keyframes' points, and their points ``[n, 3]``."""
    pairs = guided_pairs(query, keyframes, _project(query, keyframes, camera_from_world), options.matching)
    return pairs, world_points_of(pairs, keyframes)


def _refine(
    query: View,
    keyframes: Sequence[KeyframeView],
    pairs: Pairs,
    points: FloatArray,
    agreeing: BoolArray,
    camera_from_world: FloatArray,
    options: PoseOptions,
) -> tuple[Pairs, FloatArray, BundleResult, Alignment]:
    """Bundle adjustment; with guided matching once roughly, then again over what matches near its projections.

    For that the patches of the keyframes are aligned in the query. Returns the pairs with their errors in pixels,
    and where the query shows each of them.
    Raises numpy.linalg.LinAlgError where the pose is not determined.
    """
    agreeing = _thinned(agreeing, options.most_pairs and options.most_pairs // 2)  # it is a rough solution
    used = pairs.take(agreeing)
    if not options.guided:
        unaligned = Alignment(query.xy[used.query], np.zeros(len(used), np.bool_))
        adjusted = bundle_adjust(query, keyframes, used, points[agreeing], camera_from_world, options, unaligned)
        projected = project_adjusted(query, keyframes, adjusted)
        seen = Alignment(query.xy[pairs.query], np.zeros(len(pairs), np.bool_))
        return pairs, projected_error_px(query, pairs, projected), adjusted, seen
    adjusted = bundle_adjust(query, keyframes, used, points[agreeing], camera_from_world, options)
    if options.rematched:
        matching = replace(options.matching, guided_radius_px=options.close_radius_px)
        projected = project_adjusted(query, keyframes, adjusted)
        pairs = guided_pairs(query, keyframes, projected, matching)
        error = projected_error_px(query, pairs, projected)
    else:
        error = pairs_error_px(query, keyframes, pairs, adjusted)
    agreeing = error < options.inlier_px
    if agreeing.sum() < MINIMUM_PAIRS:
        raise np.linalg.LinAlgError("too few pairs are left")
    agreeing = _thinned(agreeing, options.most_pairs)
    used, points = pairs.take(agreeing), world_points_of(pairs, keyframes)[agreeing]
    alignment = align_pairs(query, keyframes, used.query, used.slot, used.keypoint, adjusted, options.threads)
    pose = adjusted.camera_from_world
    adjusted = bundle_adjust(query, keyframes, used, points, pose, options, alignment, start=adjusted)
    seen = Alignment(query.xy[pairs.query], np.zeros(len(pairs), np.bool_))
    seen.xy[agreeing], seen.found[agreeing] = alignment.xy, alignment.found
    if options.rematched:
        error = projected_error_px(query, pairs, project_adjusted(query, keyframes, adjusted))
    else:
        error = pairs_error_px(query, keyframes, pairs, adjusted)
    return pairs, error, adjusted, seen


def _thinned(agreeing: BoolArray, most: int | None) -> BoolArray:
    """At most so many of the pairs that agree, evenly over all of them; the same array where they are not more."""
    if most is None:
        return agreeing
    rows = np.flatnonzero(agreeing)
    if len(rows) <= most:
        return agreeing
    kept = np.zeros(len(agreeing), np.bool_)
    kept[rows[np.linspace(0, len(rows) - 1, most).astype(int)]] = True
    return kept


def _project(query: View, keyframes: Sequence[KeyframeView], camera_from_world: FloatArray) -> list[FloatArray]:
    """Where the query sees each keyframe's points under a pose alone, ``[n, 2]`` pixels from the centre."""
    return [
        in_front(transform_points(camera_from_world, keyframe.world_points)) * query.focal for keyframe in keyframes
    ]


def _first_support(pairs: Pairs, agreeing: BoolArray) -> FirstSupport:
    counts = np.bincount(pairs.slot[agreeing])
    best = int(counts.argmax())
    tried = np.count_nonzero(pairs.slot == best)
    return FirstSupport(len(np.unique(pairs.query[agreeing])), int(counts[best]), float(counts[best] / tried), best)


def _estimate(
    query: View,
    keyframes: Sequence[KeyframeView],
    pairs: Pairs,
    error: FloatArray,
    camera_from_world: FloatArray,
    covariance: FloatArray | None,
    first: FirstSupport,
    options: PoseOptions,
) -> PoseEstimate | None:
    keep = error < options.inlier_px
    if keep.sum() < MINIMUM_PAIRS or not np.isfinite(camera_from_world).all():
        return None
    inliers = pairs.take(keep)
    residual_px = float(np.median(error[keep]))
    return PoseEstimate(
        world_from_camera=invert_pose(camera_from_world),
        covariance=None if covariance is None else covariance * _excess_variance(residual_px, options),
        pairs=inliers,
        inliers=len(np.unique(inliers.query)),
        per_keyframe=tuple(int((inliers.slot == slot).sum()) for slot in range(len(keyframes))),
        first_inliers=first.inliers,
        first_of_best=first.of_best,
        agreement=first.agreement,
        residual_px=residual_px,
        spread=image_spread(query, inliers.query),
    )


def _excess_variance(residual_px: float, options: PoseOptions) -> float:
    """By how much the residuals exceed the noise that was assumed (a blurred query): at least 1.

    With noise of sigma in both images the median distance of a pair is 1.177 sqrt(2) sigma (Rayleigh).
    """
    expected = float(np.sqrt(2 * np.log(2)) * np.sqrt(2)) * options.pixel_sigma_px
    return max(1.0, residual_px / expected) ** 2


def image_spread(query: View, rows: IntArray) -> float:
    """Share of the cells of a 4x4 grid over the query image that hold at least one of the keypoints `rows`."""
    size = np.array([query.camera.width, query.camera.height])
    cells = np.clip((query.seen_xy[rows] * 4 / size).astype(int), 0, 3)
    return len(np.unique(cells[:, 0] * 4 + cells[:, 1])) / 16
