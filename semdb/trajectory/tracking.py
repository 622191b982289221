"""Tracking: a frame is placed by the keyframes near to where the camera should be, or looked for among all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry import invert_pose, pose_error, transform_points
from semdb.localization.adjustment import in_front
from semdb.localization.confidence import gather_evidence, sigmas
from semdb.localization.matching import no_matches
from semdb.localization.pairs import guided_pairs, world_points_of
from semdb.localization.pose import (
    FirstPose,
    FirstSupport,
    PoseEstimate,
    estimate_pose,
    first_pose,
    image_spread,
    match_views,
    robust_pnp,
)
from semdb.localization.rivals import rival_pose
from semdb.localization.verdict import judge
from semdb.localization.views import KeyframeView, View
from semdb.trajectory.options import TrajectoryOptions
from semdb.types import FloatArray, Verdict

MOTION_ITERATIONS = 30  # of random samples among pairs most of which are right


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A frame with a pose in the world of the keyframes that gave it."""

    estimate: PoseEstimate
    keyframes: tuple[KeyframeView, ...]  # in the order of the slots of the pairs
    laid: bool = False  # on surfaces, which its pairs alone would not place

    @property
    def pose(self) -> FloatArray:
        return self.estimate.world_from_camera

    @property
    def best(self) -> KeyframeView:
        """The keyframe that it has most pairs with."""
        return self.keyframes[int(np.argmax(self.estimate.per_keyframe))]


def place_by_motion(
    view: View, keyframes: Sequence[KeyframeView], predicted: FloatArray, options: TrajectoryOptions
) -> Placed | None:
    """Places a frame near `predicted` ``[4, 4]``: points are looked for only where the motion puts them."""
    if not keyframes:
        return None
    tracking, pose_options = options.tracking, options.pose
    camera_from_world = invert_pose(predicted)
    projected = [in_front(transform_points(camera_from_world, k.world_points)) * view.focal for k in keyframes]
    near = replace(options.matching, guided_radius_px=tracking.predicted_px)
    pairs = guided_pairs(view, keyframes, projected, near)
    if len(pairs) < tracking.predicted_inliers:
        return None
    points = world_points_of(pairs, keyframes)
    found = robust_pnp(view, pairs, points, pose_options, MOTION_ITERATIONS)
    if found is None:
        return None
    pose, agreeing = found
    inliers = len(np.unique(pairs.query[agreeing]))
    share = inliers / max(len(np.unique(pairs.query)), 1)
    if inliers < tracking.predicted_inliers or share < tracking.predicted_share:
        return None
    counts = np.bincount(pairs.slot[agreeing], minlength=len(keyframes))
    best = int(counts.argmax())
    support = FirstSupport(inliers, int(counts[best]), share, best)
    spread = image_spread(view, pairs.query[agreeing])
    start = FirstPose(pose, len(keyframes), support, inliers, spread)
    none = [no_matches() for _ in keyframes]
    estimate = estimate_pose(view, keyframes, none, pose_options, start)
    return None if estimate is None else Placed(estimate, tuple(keyframes))


def place_among(view: View, keyframes: Sequence[KeyframeView], options: TrajectoryOptions) -> Placed | None:
    """Places a frame by the whole images of `keyframes`, wherever it is."""
    if not keyframes:
        return None
    matches = match_views(view, keyframes, options.pose)
    estimate = estimate_pose(view, keyframes, matches, options.pose)
    return None if estimate is None else Placed(estimate, tuple(keyframes))


def holds(placed: Placed | None, agreement: float | None, options: TrajectoryOptions) -> bool:
    """Whether a pose near to where it should be has enough support to be believed.

    `agreement` is that of its depth with the keyframe that it has most pairs with, None where it is not known.
    """
    if placed is None:
        return False
    tracking, estimate = options.tracking, placed.estimate
    sigma_m, _ = sigmas(estimate.covariance)
    if estimate.inliers < tracking.many_inliers and not agrees(agreement, estimate.inliers, options):
        return False
    return (
        estimate.inliers >= tracking.least_inliers
        and estimate.spread >= tracking.least_spread
        and sigma_m <= tracking.most_sigma_m
    )


def agrees(agreement: float | None, inliers: int, options: TrajectoryOptions) -> bool:
    """Whether the depth of two frames fits a pose with so many inliers; where it is not known, it does."""
    few = inliers < options.tracking.many_inliers
    return agreement is None or agreement >= (
        options.tracking.least_agreement if few else options.closures.least_agreement
    )


def found_anywhere(
    view: View, keyframes: Sequence[KeyframeView], options: TrajectoryOptions, *, confidence: float | None = 0.0
) -> Placed | None:
    """The pose of an image of which nothing else is known, if all evidence makes it as good as certain; or None.

    The verdict is that of localization: images of a place that only looks alike do not pass. It must have a
    `confidence` besides; with None no verdict is asked for, but the pose alone.
    """
    if not keyframes:
        return None
    matches = match_views(view, keyframes, options.pose)
    start = first_pose(view, keyframes, matches, options.pose)
    if start is None or start.first.of_best < options.closures.first_inliers:
        return None
    estimate = estimate_pose(view, keyframes, matches, options.pose, start)
    if estimate is None:
        return None
    if confidence is None:
        return Placed(estimate, tuple(keyframes))
    rival = rival_pose(view, keyframes, matches, estimate, options.pose)
    evidence = gather_evidence(view, keyframes, estimate, rival, [float("nan")] * len(keyframes))
    judgement = judge(evidence, options.closures.verdict)
    if judgement.verdict is not Verdict.LOCALIZED or judgement.confidence < confidence:
        return None
    return Placed(estimate, tuple(keyframes))


def moved_too_far(pose: FloatArray, predicted: FloatArray, gap_s: float, options: TrajectoryOptions) -> bool:
    """Whether a hand-held camera cannot have come from where it was to `pose` in `gap_s`."""
    metres, degrees = pose_error(pose, predicted)
    tenths = max(gap_s / 0.1, 1.0)
    return metres > options.tracking.jump_m * tenths or degrees > options.tracking.jump_deg * tenths
