"""The fine step: 2D-3D pairs from several keyframes, robust PnP, guided matching, bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import poselib

from semdb.geometry import invert_pose, pose_error, transform_points
from semdb.localization.bundle import BundleProblem, BundleResult, MotionPrior, adjust, pixel_sigma
from semdb.localization.matching import Matches, MatchingOptions, match_guided, match_keypoints
from semdb.localization.views import KeyframeView, View
from semdb.types import BoolArray, FloatArray, IntArray

NEAREST_M = 0.05  # what is nearer is not in front of the camera
MINIMUM_PAIRS = 6  # below, a pose from 3 points has nothing to be checked with


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """Pixels are of the query image."""

    matching: MatchingOptions = field(default_factory=MatchingOptions)
    max_reprojection_px: float = 5.0
    inlier_px: float = 4.0
    close_radius_px: float = 6.0  # of guided matching once images' turns are known
    pixel_sigma_px: float = 1.0
    guided: bool = True
    bundle: bool = True
    use_query_depth: bool = True
    motion: MotionPrior = field(default_factory=MotionPrior)


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """2D-3D pairs of a query with several keyframes (`slot` counts them)."""

    query: IntArray  # [n] keypoint of the query
    slot: IntArray  # [n] which keyframe
    keypoint: IntArray  # [n] keypoint of that keyframe
    same_class: BoolArray  # [n]

    def __len__(self) -> int:
        return len(self.query)

    def take(self, keep: BoolArray | IntArray) -> Pairs:
        return Pairs(self.query[keep], self.slot[keep], self.keypoint[keep], self.same_class[keep])


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


def join_pairs(matches: Sequence[Matches]) -> Pairs:
    """Pairs of one query with several keyframes, in the order of `matches`."""
    if not matches:
        empty = np.zeros(0, np.int32)
        return Pairs(empty, empty, empty, np.zeros(0, np.bool_))
    return Pairs(
        np.concatenate([m.query for m in matches]),
        np.concatenate([np.full(len(m), slot, np.int32) for slot, m in enumerate(matches)]),
        np.concatenate([m.keyframe for m in matches]),
        np.concatenate([m.same_class for m in matches]),
    )


def match_view(query: View, keyframe: KeyframeView, options: MatchingOptions) -> Matches:
    """First matching, without a pose."""
    view = keyframe.view
    return match_keypoints(
        query.descriptors, view.descriptors, query.classes, view.classes, options,
        query_signs=query.signs, keyframe_signs=view.signs,
    )  # fmt: skip


def world_points_of(pairs: Pairs, keyframes: Sequence[KeyframeView]) -> FloatArray:
    """The stored 3D point ``[n, 3]`` of each pair, in the world."""
    points = np.empty((len(pairs), 3))
    for slot, keyframe in enumerate(keyframes):
        rows = pairs.slot == slot
        points[rows] = keyframe.world_points[pairs.keypoint[rows]]
    return points


def reprojection_px(query: View, camera_from_world: FloatArray, rows: IntArray, points: FloatArray) -> FloatArray:
    """Distance ``[n]`` in (undistorted) pixels of the query between keypoints `rows` and world `points`."""
    moved = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = moved[:, :2] / moved[:, 2:] - query.xy[rows]
    distance = np.hypot(offset[:, 0], offset[:, 1]) * query.focal
    return np.where(moved[:, 2] > NEAREST_M, distance, np.inf)


def robust_pnp(
    query: View, pairs: Pairs, points: FloatArray, options: PoseOptions, max_iterations: int = 10000
) -> tuple[FloatArray, BoolArray] | None:
    """LO-RANSAC over all pairs (PoseLib): ``camera_from_world`` and which pairs agree; None where none is found."""
    if len(pairs) < MINIMUM_PAIRS:
        return None
    focal = query.focal
    pixels = query.xy[pairs.query] * focal
    camera = {
        "model": "SIMPLE_PINHOLE",
        "width": query.camera.width,
        "height": query.camera.height,
        "params": [focal, 0, 0],
    }
    ransac = {
        "max_reproj_error": options.max_reprojection_px,
        "min_iterations": min(200, max_iterations),
        "max_iterations": max_iterations,
        "seed": 0,
    }
    pose, report = poselib.estimate_absolute_pose(pixels, points, camera, ransac, {"loss_type": "CAUCHY"})
    inliers = np.asarray(report["inliers"], np.bool_)
    if inliers.sum() < MINIMUM_PAIRS:
        return None
    camera_from_world = np.eye(4)
    camera_from_world[:3] = pose.Rt
    if not np.isfinite(camera_from_world).all():
        return None
    return camera_from_world, inliers


def guided_pairs(
    query: View, keyframes: Sequence[KeyframeView], projected: Sequence[FloatArray], options: MatchingOptions
) -> Pairs:
    """Second matching: only near the projections ``[n, 2]`` of each keyframe's points, in pixels from the centre."""
    return join_pairs(
        [
            match_guided(
                query.descriptors,
                keyframe.view.descriptors,
                query.xy * query.focal,
                centres,
                query.classes,
                keyframe.view.classes,
                options,
                query_signs=query.signs,
                keyframe_signs=keyframe.view.signs,
            )
            for keyframe, centres in zip(keyframes, projected, strict=True)
        ]
    )


def _in_front(points: FloatArray) -> FloatArray:
    """Normalised coordinates ``[n, 2]`` of camera-frame points, NaN where they are not in front of the camera."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(points[:, 2:] > NEAREST_M, points[:, :2] / points[:, 2:], np.nan)


def project_adjusted(query: View, keyframes: Sequence[KeyframeView], adjusted: BundleResult) -> list[FloatArray]:
    """Where the query sees each keyframe's points, ``[n, 2]`` pixels from the centre, NaN behind it.

    All images stand and turn as `adjusted` found; the points are those measured in the keyframes.
    """
    projected = []
    for slot, keyframe in enumerate(keyframes, start=1):
        local = keyframe.view.points.astype(np.float64)
        local -= np.cross(adjusted.turn[slot] * keyframe.view.image_row[:, None], local)
        world = transform_points(invert_pose(adjusted.image_from_world[slot]), local)
        seen = transform_points(adjusted.camera_from_world, world)
        # the row that sees a point, to first order where it would be without a turn
        row = np.clip(_in_front(seen)[:, 1:] * query.focal / query.camera.height, -0.5, 0.5)
        projected.append(_in_front(seen + np.cross(adjusted.turn[0] * row, seen)) * query.focal)
    return projected


def estimate_pose(
    query: View, keyframes: Sequence[KeyframeView], matches: Sequence[Matches], options: PoseOptions
) -> PoseEstimate | None:
    """The pose that the pairs with all `keyframes` agree on, or None.

    `matches` are those of `match_view`, one per keyframe.
    """
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    found = robust_pnp(query, pairs, points, options)
    if found is None:
        return None
    camera_from_world, agreeing = found
    first = _first_support(pairs, agreeing)
    if options.guided:
        pairs = guided_pairs(query, keyframes, _project(query, keyframes, camera_from_world), options.matching)
        points = world_points_of(pairs, keyframes)
        agreeing = reprojection_px(query, camera_from_world, pairs.query, points) < options.max_reprojection_px
        if agreeing.sum() < MINIMUM_PAIRS:
            return None
    if not options.bundle:
        pairs, points = pairs.take(agreeing), points[agreeing]
        error = reprojection_px(query, camera_from_world, pairs.query, points)
        return _estimate(query, keyframes, pairs, error, camera_from_world, None, first, options)
    try:
        pairs, error, refined = _refine(query, keyframes, pairs, points, agreeing, camera_from_world, options)
    except np.linalg.LinAlgError:
        return None
    return _estimate(query, keyframes, pairs, error, refined.camera_from_world, refined.covariance, first, options)


def _refine(
    query: View,
    keyframes: Sequence[KeyframeView],
    pairs: Pairs,
    points: FloatArray,
    agreeing: BoolArray,
    camera_from_world: FloatArray,
    options: PoseOptions,
) -> tuple[Pairs, FloatArray, BundleResult]:
    """Bundle adjustment; with guided matching once roughly, then again over what matches near its projections.

    Returns the pairs with their errors in pixels. Raises numpy.linalg.LinAlgError where the pose is not determined.
    """
    adjusted = bundle_adjust(
        query, keyframes, pairs.take(agreeing), points[agreeing], camera_from_world, options, rough=options.guided
    )
    if options.guided:
        matching = replace(options.matching, guided_radius_px=options.close_radius_px)
        pairs = guided_pairs(query, keyframes, project_adjusted(query, keyframes, adjusted), matching)
        agreeing = adjusted_error_px(query, keyframes, pairs, adjusted) < options.inlier_px
        if agreeing.sum() < MINIMUM_PAIRS:
            raise np.linalg.LinAlgError("too few pairs are left")
        points = world_points_of(pairs, keyframes)[agreeing]
        adjusted = bundle_adjust(query, keyframes, pairs.take(agreeing), points, adjusted.camera_from_world, options)
    return pairs, adjusted_error_px(query, keyframes, pairs, adjusted), adjusted


def _project(query: View, keyframes: Sequence[KeyframeView], camera_from_world: FloatArray) -> list[FloatArray]:
    """Where the query sees each keyframe's points under a pose alone, ``[n, 2]`` pixels from the centre."""
    return [
        _in_front(transform_points(camera_from_world, keyframe.world_points)) * query.focal for keyframe in keyframes
    ]


def _first_support(pairs: Pairs, agreeing: BoolArray) -> tuple[int, int, float]:
    """Pairs that agree before any is guided: of all keyframes, of the best one, and the share of that one's pairs."""
    counts = np.bincount(pairs.slot[agreeing])
    best = int(counts.argmax())
    tried = np.count_nonzero(pairs.slot == best)
    return len(np.unique(pairs.query[agreeing])), int(counts[best]), float(counts[best] / tried)


def rival_pose(
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    best: PoseEstimate,
    options: PoseOptions,
) -> int:
    """Inliers (distinct query keypoints) of the best pose elsewhere, among the pairs that `best` leaves over.

    Elsewhere is more than 0.5 m or 15 degrees away; 0 when there is none.
    """
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    camera_from_world = invert_pose(best.world_from_camera)
    left = reprojection_px(query, camera_from_world, pairs.query, points) >= 2 * options.max_reprojection_px
    found = robust_pnp(query, pairs.take(left), points[left], options, max_iterations=1000)
    if found is None:
        return 0
    rival, agreeing = found
    distance, angle = pose_error(invert_pose(rival), best.world_from_camera)
    if distance < 0.5 and angle < 15:
        return 0
    return len(np.unique(pairs.take(left).query[agreeing]))


def _estimate(
    query: View,
    keyframes: Sequence[KeyframeView],
    pairs: Pairs,
    error: FloatArray,
    camera_from_world: FloatArray,
    covariance: FloatArray | None,
    first: tuple[int, int, float],
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
        first_inliers=first[0],
        first_of_best=first[1],
        agreement=first[2],
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


def bundle_adjust(
    query: View,
    keyframes: Sequence[KeyframeView],
    pairs: Pairs,
    points: FloatArray,
    camera_from_world: FloatArray,
    options: PoseOptions,
    *,
    rough: bool = False,
) -> BundleResult:
    """Equation (5) over the agreeing pairs. Pairs of one query keypoint with several keyframes are one point."""
    rows, point_index = np.unique(pairs.query, return_inverse=True)
    counts = np.bincount(point_index).astype(np.float64)
    first_guess = np.stack([np.bincount(point_index, points[:, axis]) / counts for axis in range(3)], axis=1)
    seen = [_observations(query, rows, options, with_depth=options.use_query_depth)]
    owner, image = [np.arange(len(rows))], [np.zeros(len(rows), np.int32)]
    for slot, keyframe in enumerate(keyframes):
        here = np.flatnonzero(pairs.slot == slot)
        seen.append(_observations(keyframe.view, pairs.keypoint[here], options, with_depth=True))
        owner.append(point_index[here])
        image.append(np.full(len(here), slot + 1, np.int32))
    observed, point = np.concatenate(seen), np.concatenate(owner).astype(np.int32)
    order = np.argsort(point, kind="stable")
    observed = observed[order]
    problem = BundleProblem(
        points=first_guess,
        observed_point=point[order],
        observed_image=np.concatenate(image)[order],
        xy=observed[:, :2],
        sigma=observed[:, 2],
        depth=observed[:, 3],
        rows=observed[:, 4],
        keyframe_from_world=np.stack([keyframe.camera_from_world for keyframe in keyframes]),
    )
    return adjust(problem, camera_from_world, options.motion, rough=rough)


def _observations(view: View, rows: IntArray, options: PoseOptions, *, with_depth: bool) -> FloatArray:
    """(x, y, sigma, depth, row of the image) ``[n, 5]`` of keypoints `rows`."""
    sigma = pixel_sigma(view.size[rows], view.focal, options.pixel_sigma_px)
    depth = view.points[rows, 2].astype(np.float64) if with_depth else np.full(len(rows), np.nan)
    return np.column_stack([view.xy[rows], sigma, depth, view.image_row[rows]])


def adjusted_error_px(
    query: View, keyframes: Sequence[KeyframeView], pairs: Pairs, adjusted: BundleResult
) -> FloatArray:
    """Distance ``[n]`` in pixels between the query's keypoints and the stored 3D points of `pairs`.

    All images stand and turn as `adjusted` found; the points are those measured in the keyframes.
    """
    error = np.empty(len(pairs))
    for slot, projected in enumerate(project_adjusted(query, keyframes, adjusted)):
        here = pairs.slot == slot
        offset = projected[pairs.keypoint[here]] - query.xy[pairs.query[here]] * query.focal
        error[here] = np.hypot(offset[:, 0], offset[:, 1])
    return np.where(np.isfinite(error), error, np.inf)
