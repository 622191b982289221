"""A frame placed near to where it should be, by keyframes of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import poselib

from semdb.geometry import invert_pose, transform_points
from semdb.localization.adjustment import in_front
from semdb.localization.confidence import gather_evidence, sigmas
from semdb.localization.matching import Matches, no_matches
from semdb.localization.pairs import Pairs, guided_pairs, reprojection_px, world_points_of
from semdb.localization.pose import (
    FirstPose,
    FirstSupport,
    PoseEstimate,
    estimate_pose,
    first_pose,
    image_spread,
    match_views,
    pinhole,
    robust_pnp,
)
from semdb.localization.rivals import rival_pose
from semdb.localization.verdict import judge
from semdb.localization.views import KeyframeView, View
from semdb.tracking.options import PlacingOptions
from semdb.types import FloatArray, Verdict

FIT_ITERATIONS = 25  # of a pose from a start; the last ones change nothing that matters


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A pose in the map with its support."""

    estimate: PoseEstimate
    keyframes: tuple[KeyframeView, ...]

    @property
    def pose(self) -> FloatArray:
        return self.estimate.world_from_camera

    @property
    def covariance(self) -> FloatArray:
        """``[6, 6]``"""
        found = self.estimate.covariance
        return np.diag([0.05**2] * 3 + [0.03**2] * 3) if found is None else found


def search_radius_px(view: View, covariance: FloatArray, distance_m: float, options: PlacingOptions) -> float:
    """Pixels within which a point at a distance is to be looked for, with a pose of `covariance` ``[6, 6]``."""
    metres, degrees = sigmas(covariance)
    off = np.hypot(metres / max(distance_m, 0.3), np.radians(degrees))
    return float(np.clip(3 * view.focal * off, options.least_px, options.most_px))


def place_near(
    view: View, keyframes: Sequence[KeyframeView], predicted: FloatArray, radius_px: float, options: PlacingOptions
) -> Placed | None:
    """The pose of a frame near `predicted` ``[4, 4]``, as far as it holds (`PlacingOptions`); None without one."""
    if not keyframes:
        return None
    near = replace(options.pose.matching, guided_radius_px=radius_px)
    pairs = guided_pairs(view, keyframes, project_all(view, keyframes, predicted), near)
    if len(pairs) < options.least_inliers:
        return None
    points = world_points_of(pairs, keyframes)
    sample = np.linspace(0, len(pairs) - 1, min(options.sampled, len(pairs))).astype(np.int32)
    found = _first_pose(view, pairs.take(sample), points[sample], predicted, options)
    if found is None:
        return None
    pose, share = found
    close = reprojection_px(view, pose, pairs.query, points) < options.pose.max_reprojection_px
    rows = pairs.query[close]
    inliers = len(np.unique(rows))
    if inliers < options.least_inliers:
        return None
    counts = np.bincount(pairs.slot[close], minlength=len(keyframes))
    best = int(counts.argmax())
    support = FirstSupport(inliers, int(counts[best]), share, best)
    start = FirstPose(pose, len(keyframes), support, inliers, image_spread(view, rows), (pairs, points))
    none = [no_matches() for _ in keyframes]
    estimate = estimate_pose(view, keyframes, none, options.pose, start)
    if estimate is None:
        return None
    placed = Placed(estimate, tuple(keyframes))
    if not _is_sound(estimate, options):
        return None
    if estimate.inliers >= options.strong_inliers and share >= options.strong_share:
        return placed
    return placed if convinces(view, placed, options) else None


def _first_pose(
    view: View, pairs: Pairs, points: FloatArray, predicted: FloatArray, options: PlacingOptions
) -> tuple[FloatArray, float] | None:
    """A rough ``camera_from_world`` and the share of pairs that agree: from the prediction, else by random samples."""
    fitted = fitted_pose(view, invert_pose(predicted), pairs, points, options.pose.max_reprojection_px)
    if fitted is not None:
        share = float((reprojection_px(view, fitted, pairs.query, points) < options.pose.max_reprojection_px).mean())
        if share >= options.strong_share:
            return fitted, share
    found = robust_pnp(view, pairs, points, options.pose, options.iterations)
    if found is None or found[1].mean() < options.least_first_share:
        return None
    return found[0], float(found[1].mean())


def fitted_pose(view: View, start: FloatArray, pairs: Pairs, points: FloatArray, scale_px: float) -> FloatArray | None:
    """``camera_from_world`` from a start, with a loss that leaves out what is far off; None where it diverges."""
    first = poselib.CameraPose()
    first.R, first.t = start[:3, :3], start[:3, 3]
    pixels = view.xy[pairs.query] * view.focal
    fitted, _ = poselib.refine_absolute_pose(
        pixels, points, first, pinhole(view),
        {"loss_type": "CAUCHY", "loss_scale": scale_px, "max_iterations": FIT_ITERATIONS},
    )  # fmt: skip
    pose = np.eye(4)
    pose[:3] = fitted.Rt
    return pose if np.isfinite(pose).all() else None


def place_anywhere_near(view: View, keyframes: Sequence[KeyframeView], options: PlacingOptions) -> Placed | None:
    """The pose of a frame that may be anywhere, by whole images of `keyframes`, if all evidence speaks for it."""
    if not keyframes:
        return None
    matches = match_views(view, keyframes, options.pose)
    start = first_pose(view, keyframes, matches, options.pose)
    if start is None or start.first.inliers < options.verdict.few_first_inliers:
        return None
    estimate = estimate_pose(view, keyframes, matches, options.pose, start)
    if estimate is None or not _is_sound(estimate, options):
        return None
    placed = Placed(estimate, tuple(keyframes))
    return placed if convinces(view, placed, options, matches) else None


def _is_sound(estimate: PoseEstimate, options: PlacingOptions) -> bool:
    metres, degrees = sigmas(estimate.covariance)
    return (
        estimate.inliers >= options.least_inliers
        and estimate.spread >= options.least_spread
        and metres <= options.most_sigma_m
        and degrees <= options.most_sigma_deg
    )


def convinces(view: View, placed: Placed, options: PlacingOptions, matches: Sequence[Matches] | None = None) -> bool:
    """Whether the verdict on the image alone would be that it is localized."""
    rival = 0
    if matches is not None:
        rival = rival_pose(view, placed.keyframes, matches, placed.estimate, options.pose)
    unknown = [float("nan")] * len(placed.keyframes)
    evidence = gather_evidence(view, placed.keyframes, placed.estimate, rival, unknown)
    return judge(evidence, options.verdict).verdict is Verdict.LOCALIZED


def project_all(view: View, keyframes: Sequence[KeyframeView], pose: FloatArray) -> list[FloatArray]:
    """Where a camera at `pose` sees each keyframe's points ``[n, 2]``, pixels from the centre; NaN outside of it."""
    camera_from_world = invert_pose(pose)
    half = np.array([view.camera.width, view.camera.height]) * 0.75
    found = []
    for keyframe in keyframes:
        at = in_front(transform_points(camera_from_world, keyframe.world_points)) * view.focal
        at[~(np.abs(at) < half).all(axis=1)] = np.nan
        found.append(at)
    return found
