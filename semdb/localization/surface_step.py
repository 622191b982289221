"""What surfaces say of a query's pose: the pose at which its depth lies on the map, how sure it is, and in words.

Shapes alone do not tell a place: boxes fit turned by half a turn, bare rooms fit each other. So keypoints vouch for it:
far fewer than make a pose of their own are enough, as they need only agree with one that is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.geometry import invert_pose, pose_error, so3_log
from semdb.localization.confidence import Evidence, confidence_of, sigmas
from semdb.localization.matching import Matches
from semdb.localization.pairs import join_pairs, reprojection_px, world_points_of
from semdb.localization.pose import FirstPose, FirstSupport, PoseEstimate, estimate_pose, image_spread
from semdb.localization.pose_options import PoseOptions
from semdb.localization.surface_alignment import SurfaceFit, SurfaceOptions, moved
from semdb.localization.verdict import Judgement
from semdb.localization.views import KeyframeView, View
from semdb.types import FloatArray, Verdict

WEIGHT_OF_SUPPORT = 0.25  # of the logarithm of keypoints against shares, where poses are compared
LOGIT, LOGIT_OF_SUPPORT = 0.0, 1.5
POINTS_PER_CELL = 60.0  # whose errors are alike: the depth's own, and of keyframes' poses
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.006, 0.007  # of what keyframes share: recorded poses, clocks of colour and depth
SCATTER = 4.0  # times what keyframes show that disagree: neighbours err alike


@dataclass(frozen=True, slots=True)
class SurfaceVerdictOptions:
    """A pose is sure when every bound holds."""

    fit: SurfaceOptions = field(default_factory=SurfaceOptions)
    support_px: float = 10.0  # of a keypoint that vouches: the surfaces' pose is good to some pixels
    least_near: float = 0.55
    least_alike: float = 0.55
    most_through: float = 0.10
    least_correlation: float = 0.6
    least_support: int = 6
    rival_support: float = 0.4  # of the support, that a pose elsewhere may have at most that fits nearly as well,
    rival_score: float = 0.15  # by so much less,
    rival_alone: float = 0.7  # and any pose elsewhere
    convinced_likeness: float = 0.65  # where keypoints are many, and yet in doubt: a room of the same shapes shows
    convinced_confidence: float = 0.9  # other textures, which surfaces do not see
    same_m: float = 0.05  # the keypoints' own pose is this one if it is no further off
    same_deg: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LaidPose:
    """The best pose of the surfaces. `doubts` are in words; without any it is sure.

    `support` counts distinct keypoints of the query that first matching gave and this pose puts where they are,
    `rival_support` the same of a pose elsewhere that may be the right one instead, 0 without any.
    """

    fit: SurfaceFit
    covariance: FloatArray
    support: int
    rival_support: int
    doubts: tuple[str, ...]

    @property
    def world_from_camera(self) -> FloatArray:
        return self.fit.world_from_camera

    @property
    def is_sure(self) -> bool:
        return not self.doubts

    @property
    def confidence(self) -> float:
        """Probability 0..1 that the pose is within 0.25 m and 5 degrees of the truth."""
        return float(1 / (1 + np.exp(-(LOGIT + LOGIT_OF_SUPPORT * np.log1p(self.support)))))

    def fits_well(self, options: SurfaceVerdictOptions) -> bool:
        """Whether the shapes fit, whatever the place."""
        return self.fit.near >= options.least_near and self.fit.through <= options.most_through

    def as_mapping(self) -> dict[str, float]:
        """Name to number, for results and files."""
        fit = self.fit
        return {
            "surface_near": fit.near,
            "surface_alike": fit.alike,
            "surface_through": fit.through,
            "surface_correlation": fit.correlation,
            "surface_support": float(self.support),
            "surface_rival": float(self.rival_support),
        }

    def is_same(self, world_from_camera: FloatArray, options: SurfaceVerdictOptions) -> bool:
        """Whether another pose is this one."""
        distance, angle = pose_error(world_from_camera, self.world_from_camera)
        return distance < options.same_m and angle < options.same_deg


def weigh(
    fits: Sequence[SurfaceFit],
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: SurfaceVerdictOptions,
    limits: tuple[float, float],
) -> LaidPose | None:
    """The best of `fits`, weighed with the pairs of first matching; `limits` (m, deg) of its standard deviations."""
    if not fits:
        return None
    supports = [support_of(fit.world_from_camera, query, keyframes, matches, options.support_px) for fit in fits]
    worth = [fit.score + WEIGHT_OF_SUPPORT * np.log1p(count) for fit, count in zip(fits, supports, strict=True)]
    best = int(np.argmax(worth))
    fit, support = fits[best], supports[best]
    rival = 0
    for other, count in zip(fits, supports, strict=True):
        distance, angle = pose_error(other.world_from_camera, fit.world_from_camera)
        elsewhere = distance > options.same_m or angle > options.same_deg
        fits_nearly = other.score > fit.score - options.rival_score
        if elsewhere and count > (options.rival_support if fits_nearly else options.rival_alone) * support:
            rival = max(rival, count)
    covariance = covariance_of(fit)
    return LaidPose(fit, covariance, support, rival, tuple(_doubts(fit, covariance, support, rival, options, limits)))


def support_of(
    world_from_camera: FloatArray,
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    within_px: float,
) -> int:
    """Distinct keypoints of the query that a pose puts within so many pixels of where they are."""
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    error = reprojection_px(query, invert_pose(world_from_camera), pairs.query, points)
    return len(np.unique(pairs.query[error < within_px]))


def may_overrule(convinced: bool, evidence: Evidence, options: SurfaceVerdictOptions) -> bool:
    """Whether a sure pose of the surfaces stands against a doubtful verdict of keypoints.

    `evidence` is what keypoints say of that pose, `convinced` whether there were many.
    """
    return not convinced or (
        evidence.likeness >= options.convinced_likeness and confidence_of(evidence) >= options.convinced_confidence
    )


def judge_with_surfaces(
    judgement: Judgement, estimate: PoseEstimate | None, laid: LaidPose, options: SurfaceVerdictOptions, overrule: bool
) -> Judgement:
    """What becomes of the verdict of keypoints on their `estimate`, where surfaces may `overrule` it or not."""
    if laid.is_sure and overrule:
        fit = laid.fit
        reason = f"{fit.near:.0%} of the surfaces lie where they were measured, {laid.support} keypoints agree"
        return Judgement(Verdict.LOCALIZED, laid.confidence, reason)
    elsewhere = estimate is not None and not laid.is_same(estimate.world_from_camera, options)
    if judgement.verdict is Verdict.LOCALIZED and elsewhere and laid.fits_well(options):
        reason = "the depth of the image lies better on the map elsewhere"
        return Judgement(Verdict.AMBIGUOUS, min(judgement.confidence, 0.5), reason)
    return judgement


def estimate_with_surfaces(
    laid: LaidPose,
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: SurfaceVerdictOptions,
    pose: PoseOptions,
) -> PoseEstimate:
    """The pose of surfaces and keypoints together, where both say the same; else that of the surfaces alone."""
    camera_from_world = invert_pose(laid.world_from_camera)
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    error = reprojection_px(query, camera_from_world, pairs.query, points)
    near = error < options.support_px
    counts = np.bincount(pairs.slot[near], minlength=len(keyframes))
    best = int(counts.argmax())
    agreement = float(counts[best] / max(np.count_nonzero(pairs.slot == best), 1))
    first = FirstSupport(laid.support, int(counts[best]), agreement, best)
    start = FirstPose(camera_from_world, len(keyframes), first, laid.support, 0.0)
    found = estimate_pose(query, keyframes, matches, pose, start)
    if found is not None and found.covariance is not None and laid.is_same(found.world_from_camera, options):
        together, covariance = fused(laid.world_from_camera, laid.covariance, found.world_from_camera, found.covariance)
        return replace(found, world_from_camera=together, covariance=covariance)
    agreeing = pairs.take(near)
    return PoseEstimate(
        world_from_camera=laid.world_from_camera,
        covariance=laid.covariance,
        pairs=agreeing,
        inliers=laid.support,
        per_keyframe=tuple(int(count) for count in counts),
        first_inliers=first.inliers,
        first_of_best=first.of_best,
        agreement=agreement,
        residual_px=float(np.median(error[near])) if near.any() else float("nan"),
        spread=image_spread(query, agreeing.query),
    )


def covariance_of(fit: SurfaceFit) -> FloatArray:
    """``[6, 6]`` of translation (m, world) and rotation (rad, left perturbation in the world)."""
    loose = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])  # nothing is believed to be further off
    covariance = np.linalg.inv(fit.information / POINTS_PER_CELL + loose)
    shared = np.repeat([POSE_SIGMA_M, POSE_SIGMA_RAD], 3) ** 2
    return np.asarray(covariance + np.diag(shared) + SCATTER * fit.scatter)


def fused(
    laid: FloatArray, laid_covariance: FloatArray, other: FloatArray, other_covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Two independent estimates of one pose in one, each ``[4, 4]`` with its ``[6, 6]``."""
    one, two = np.linalg.inv(laid_covariance), np.linalg.inv(other_covariance)
    covariance = np.linalg.inv(one + two)
    offset = np.concatenate([other[:3, 3] - laid[:3, 3], so3_log(other[:3, :3] @ laid[:3, :3].T)])
    step = covariance @ two @ offset
    return moved(laid, step), covariance


def _doubts(
    fit: SurfaceFit,
    covariance: FloatArray,
    support: int,
    rival: int,
    options: SurfaceVerdictOptions,
    limits: tuple[float, float],
) -> list[str]:
    found = []
    if fit.near < options.least_near or fit.through > options.most_through:
        found.append(
            f"of the surfaces {fit.near:.0%} lie where they were measured, {fit.through:.0%} were seen through"
        )
    if fit.alike < options.least_alike or fit.correlation < options.least_correlation:
        found.append(f"{fit.alike:.0%} of them look as they do in the map")
    if support < options.least_support:
        found.append(f"only {support} keypoints vouch for where the surfaces fit")
    if rival:
        found.append(f"a pose elsewhere fits too, with {rival} against {support} keypoints")
    sigma_m, sigma_deg = sigmas(covariance)
    if sigma_m > limits[0] or sigma_deg > limits[1]:
        found.append(f"the surfaces leave the pose free by {sigma_m:.2f} m and {sigma_deg:.1f} deg")
    return found
