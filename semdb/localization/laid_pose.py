"""A pose found by laying a query on the map, weighed with the keypoints, and what it makes of their verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry import invert_pose, pose_error, pose_offset
from semdb.localization.confidence import Evidence, confidence_of, sigmas
from semdb.localization.matching import Matches
from semdb.localization.pairs import join_pairs, reprojection_px, world_points_of
from semdb.localization.pose import FirstPose, FirstSupport, PoseEstimate, estimate_pose, image_spread
from semdb.localization.pose_options import PoseOptions
from semdb.localization.predicted_view import Windows
from semdb.localization.surface_alignment import moved
from semdb.localization.verdict import Judgement
from semdb.localization.views import KeyframeView, View
from semdb.types import ConsistentPose, FloatArray, Tolerance, Verdict

WEIGHT_OF_SUPPORT = 0.25  # of the logarithm of keypoints against shares, where poses are compared
LOGIT, LOGIT_OF_SUPPORT = 0.0, 1.5
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.006, 0.007  # of what keyframes share: recorded poses, clocks of colour and depth
FEW_KEYPOINTS = 4.0  # times the covariance of keypoints where they are few: weak pairs lie along edges and agree
SCATTER = 4.0  # times what keyframes show that disagree: neighbours err alike
# An answer counts 1.5 times what is laid leaves open, and this for what keyframes share: errors of recorded poses,
# which the verdict does not look at (fitted on the cabinet)
ANSWER_TIMES, ANSWER_SIGMA_M, ANSWER_SIGMA_RAD = 1.5, 0.005, 0.005


@dataclass(frozen=True, slots=True)
class LaidOptions:
    """Bounds that hold whatever is laid on the map."""

    support_px: float = 10.0  # of a keypoint that vouches: a laid pose is good to some pixels
    least_support: int = 6
    rival_support: float = 0.4  # of the support, that a pose elsewhere may have at most that fits nearly as well,
    rival_score: float = 0.15  # by so much less,
    rival_alone: float = 0.7  # and any pose elsewhere
    least_confidence: float = 0.1  # of keypoints at that pose: equal doors of a corridor have .01 to .05 of it
    convinced_likeness: float = 0.65  # where keypoints are many, and yet in doubt: a room of the same shapes shows
    convinced_confidence: float = 0.9  # other textures, which shapes do not see
    few_support: int = 20  # fewer keypoints, and what keyframes predict from there is looked at,
    least_view: float = 0.59  # which has to look alike,
    view_keyframes: int = 6
    view_windows: int = 1500  # where so much can be compared;
    lead_of_view: float = 0.15  # a pose elsewhere from which so much less looks alike is no rival
    same_m: float = 0.05  # the keypoints' own pose is this one if it is no further off
    same_deg: float = 3.0

    def tolerance(self, accept: Tolerance | None) -> Tolerance:
        """How far poses may differ that are one: what the caller would accept, at least these bounds."""
        if accept is None:
            return Tolerance(self.same_m, self.same_deg)
        return Tolerance(max(self.same_m, accept.metres), max(self.same_deg, accept.degrees))


@dataclass(frozen=True, slots=True, eq=False)
class LaidPose:
    """The best pose of what was laid on the map. `doubts` are in words; without any it is sure.

    `support` counts distinct keypoints of the query that first matching gave and this pose puts where they are;
    `others` are poses elsewhere, one of which may be the right one instead.
    """

    world_from_camera: FloatArray
    covariance: FloatArray
    support: int
    others: tuple[ConsistentPose, ...]
    doubts: tuple[str, ...]
    fits_well: bool  # whatever the place
    agrees: str  # what does, for people
    better: str  # what fits better there, for people
    numbers: Mapping[str, float]
    look: Callable[[FloatArray], Windows] | None = None  # how the query looks from a pose, where that was asked of it

    @property
    def is_sure(self) -> bool:
        return not self.doubts

    @property
    def confidence(self) -> float:
        """Probability 0..1 that the pose is within 0.25 m and 5 degrees of the truth."""
        return float(1 / (1 + np.exp(-(LOGIT + LOGIT_OF_SUPPORT * np.log1p(self.support)))))

    def looks_better_than(self, world_from_camera: FloatArray, options: LaidOptions) -> bool:
        """Whether the query clearly looks more as keyframes predict from here than from another pose."""
        if self.look is None:
            return False
        other = self.look(world_from_camera)
        enough = np.count_nonzero(other.compared) >= options.view_windows
        return bool(enough and other.alike < self.numbers["laid_view"] - options.lead_of_view)

    def is_same(self, world_from_camera: FloatArray, options: LaidOptions) -> bool:
        """Whether another pose is this one."""
        distance, angle = pose_error(world_from_camera, self.world_from_camera)
        return distance < options.same_m and angle < options.same_deg


@dataclass(frozen=True, slots=True)
class Standing:
    """Which of several poses is best, and the keypoints of it and of a rival (0 without any)."""

    best: int
    support: int
    rival: int
    others: tuple[ConsistentPose, ...] = ()  # that are rivals, most keypoints first


def compare(
    poses: Sequence[FloatArray],
    scores: Sequence[float],
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: LaidOptions,
    accept: Tolerance | None = None,
) -> Standing:
    """The best of `poses` ``[4, 4]`` by `scores` (shares) and by pairs of first matching; there is at least one.

    One that the caller would `accept` for the best is no rival.
    """
    supports = [support_of(pose, query, keyframes, matches, options.support_px) for pose in poses]
    worth = [score + WEIGHT_OF_SUPPORT * np.log1p(count) for score, count in zip(scores, supports, strict=True)]
    best = int(np.argmax(worth))
    others = []
    for pose, score, count in zip(poses, scores, supports, strict=True):
        elsewhere = not is_one(pose, poses[best], options.tolerance(accept))
        nearly = score > scores[best] - options.rival_score
        if elsewhere and count > (options.rival_support if nearly else options.rival_alone) * supports[best]:
            others.append(ConsistentPose(pose, count))
    others.sort(key=lambda other: -other.inliers)
    return Standing(best, supports[best], others[0].inliers if others else 0, tuple(others))


def is_one(pose: FloatArray, other: FloatArray, tolerance: Tolerance) -> bool:
    """Whether two poses ``[4, 4]`` are within `tolerance`."""
    distance, angle = pose_error(pose, other)
    return distance <= tolerance.metres and angle <= tolerance.degrees


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


def shared_doubts(
    covariance: FloatArray, standing: Standing, options: LaidOptions, limits: tuple[float, float], what: str
) -> list[str]:
    """In words; `what` (surfaces, edges) leaves the pose free, `limits` (m, deg) are of its standard deviations."""
    found = []
    if standing.support < options.least_support:
        found.append(f"only {standing.support} keypoints vouch for where the {what} fit")
    if standing.rival:
        found.append(f"a pose elsewhere fits too, with {standing.rival} against {standing.support} keypoints")
    sigma_m, sigma_deg = sigmas(covariance)
    if sigma_m > limits[0] or sigma_deg > limits[1]:
        found.append(f"the {what} leave the pose free by {sigma_m:.2f} m and {sigma_deg:.1f} deg")
    return found


def covariance_from(information: FloatArray, scatter: FloatArray, alike: float) -> FloatArray:
    """``[6, 6]`` of translation (m, world) and rotation (rad, left perturbation in the world).

    `alike` measurements err together; `scatter` is what keyframes show that disagree.
    """
    loose = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])  # nothing is believed to be further off
    return np.asarray(np.linalg.inv(information / alike + loose) + _shared() + SCATTER * scatter)


def with_view(
    laid: LaidPose,
    seen: Windows,
    options: LaidOptions,
    what: str,
    look: Callable[[FloatArray], Windows] | None = None,
) -> LaidPose:
    """`laid` in doubt where the query does not look like what is predicted from that pose (`seen`).

    `what` (surfaces, edges) fits there. Of two sides of a cabinet the other one has as many, and keypoints that vouch.
    """
    numbers = {**laid.numbers, "laid_view": seen.alike}
    if seen.alike >= options.least_view or np.count_nonzero(seen.compared) < options.view_windows:
        return replace(laid, numbers=numbers, look=look)
    doubt = f"where the {what} fit only {seen.alike:.0%} of the image look as the map predicts"
    return replace(laid, doubts=(*laid.doubts, doubt), fits_well=False, numbers=numbers)


def may_overrule(convinced: bool, evidence: Evidence, laid: LaidPose, options: LaidOptions) -> bool:
    """Whether a sure `laid` pose stands against a doubtful verdict of keypoints.

    `evidence` is what keypoints say of that pose, `convinced` whether there were many. Where a place is there twice
    it does not: the other place has as many, though nothing may have been laid on it.
    """
    own = evidence.first_of_best  # like with like: once convinced, one keyframe elsewhere was asked
    if not convinced:
        own = min(own, laid.support)
    if evidence.rival > options.rival_alone * own:
        return False
    confidence = confidence_of(evidence)
    if not convinced:
        return confidence >= options.least_confidence
    return evidence.likeness >= options.convinced_likeness and confidence >= options.convinced_confidence


def judge_with(
    judgement: Judgement,
    estimate: PoseEstimate | None,
    laid: LaidPose,
    options: LaidOptions,
    overrule: bool,
    accept: Tolerance | None = None,
) -> Judgement:
    """What becomes of the verdict of keypoints on their `estimate`, where `laid` may `overrule` it or not."""
    if laid.is_sure and overrule:
        reason = f"{laid.agrees}, {laid.support} keypoints agree"
        return Judgement(Verdict.LOCALIZED, laid.confidence, reason)
    elsewhere = estimate is not None and not is_one(
        laid.world_from_camera, estimate.world_from_camera, options.tolerance(accept)
    )
    if judgement.verdict is Verdict.LOCALIZED and elsewhere and laid.fits_well:
        return Judgement(Verdict.AMBIGUOUS, min(judgement.confidence, 0.5), laid.better)
    return judgement


def estimate_with(
    laid: LaidPose,
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: LaidOptions,
    pose: PoseOptions,
) -> PoseEstimate:
    """The pose of `laid` and keypoints together, where both say the same; else `laid` alone."""
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
        together, _ = fused(laid.world_from_camera, laid.covariance, found.world_from_camera, found.covariance)
        own, others = laid.covariance - _shared(), FEW_KEYPOINTS * found.covariance
        covariance = np.linalg.inv(np.linalg.inv(own) + np.linalg.inv(others)) + _shared()  # not seen by either
        return replace(found, world_from_camera=together, covariance=covariance, recorded=laid_recorded(covariance))
    agreeing = pairs.take(near)
    return PoseEstimate(
        world_from_camera=laid.world_from_camera,
        covariance=laid.covariance,
        recorded=laid_recorded(laid.covariance),
        pairs=agreeing,
        inliers=laid.support,
        per_keyframe=tuple(int(count) for count in counts),
        first_inliers=first.inliers,
        first_of_best=first.of_best,
        agreement=agreement,
        residual_px=float(np.median(error[near])) if near.any() else float("nan"),
        spread=image_spread(query, agreeing.query),
    )


def fused(
    laid: FloatArray, laid_covariance: FloatArray, other: FloatArray, other_covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Two independent estimates of one pose in one, each ``[4, 4]`` with its ``[6, 6]``."""
    one, two = np.linalg.inv(laid_covariance), np.linalg.inv(other_covariance)
    covariance = np.linalg.inv(one + two)
    step = covariance @ two @ pose_offset(other, laid)
    return moved(laid, step), covariance


def _shared(sigma_m: float = POSE_SIGMA_M, sigma_rad: float = POSE_SIGMA_RAD) -> FloatArray:
    """Covariance ``[6, 6]`` of the errors that keyframes share, which nothing that is laid on them can see."""
    return np.diag(np.repeat([sigma_m, sigma_rad], 3) ** 2)


def laid_recorded(covariance: FloatArray) -> FloatArray:
    """What is added to a `covariance` ``[6, 6]`` that the verdict has looked at, so that it is that of the answer."""
    seen = covariance - _shared()
    return ANSWER_TIMES * seen + _shared(ANSWER_SIGMA_M, ANSWER_SIGMA_RAD) - covariance
