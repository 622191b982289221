"""From the support of a pose to a verdict that can be trusted, and a confidence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semdb.localization.confidence import Evidence, confidence_of
from semdb.localization.pose import FirstPose, PoseEstimate
from semdb.types import Tolerance, Verdict


@dataclass(frozen=True, slots=True)
class VerdictOptions:
    """A pose is `localized` when every bound holds, `ambiguous` when only those named so do, `failed` otherwise.

    The support of the first matching is enough when it is many pairs, or fewer that are a good share of those tried.
    Of 700 pairs of images of the recordings in README.md, 250 without a right answer, the bounds let 3
    wrong poses pass (all of them less than twice as far off as the limit of a false localization) and keep 92 % of the
    right ones; with several keyframes joined hardly a right one is that weak. Images of another room reach up to 50
    guided inliers, but at most 15 first ones, 9 with the best keyframe and an agreement of 0.28.
    """

    localized_inliers: int = 20
    many_first_inliers: int = 25
    few_first_inliers: int = 10
    agreement_of_few: float = 0.35
    many_inliers: int = 90  # or so many in the end, which chance does not reach either
    ambiguous_inliers: int = 8
    ambiguous_first_inliers: int = 16  # of all keyframes; or
    ambiguous_first_of_best: int = 8  # with the best keyframe, if they are
    ambiguous_agreement: float = 0.2  # of its pairs
    convincing_inliers: int = 60  # and `many_first_inliers`: enough to stop looking at more keyframes
    minimum_spread: float = 0.19  # three cells of a 4x4 grid over the image
    maximum_translation_sigma_m: float = 0.06
    maximum_rotation_sigma_deg: float = 1.5
    localized_confidence: float = 0.82
    rival_share: float = 0.7  # of the first inliers with the best keyframe, that a pose elsewhere may have at most

    def accepting(self, tolerance: Tolerance | None) -> VerdictOptions:
        """The same for a caller who takes poses within `tolerance` for one: two standard deviations are within it."""
        if tolerance is None:
            return self
        return replace(
            self,
            maximum_translation_sigma_m=tolerance.metres / 2,
            maximum_rotation_sigma_deg=tolerance.degrees / 2,
        )


@dataclass(frozen=True, slots=True)
class Judgement:
    """`reason` is one line for people."""

    verdict: Verdict
    confidence: float
    reason: str


def convinces(estimate: PoseEstimate | FirstPose | None, options: VerdictOptions) -> bool:
    """Whether a pose is so well supported that no further keyframe need be asked."""
    return (
        estimate is not None
        and estimate.inliers >= options.convincing_inliers
        and estimate.first_inliers >= options.many_first_inliers
        and estimate.spread >= options.minimum_spread
    )


def _is_plausible(evidence: Evidence, options: VerdictOptions) -> bool:
    """Whether more agrees than does for images of quite another place."""
    by_best = (
        evidence.first_of_best >= options.ambiguous_first_of_best and evidence.agreement >= options.ambiguous_agreement
    )
    return evidence.inliers >= options.ambiguous_inliers and (
        by_best or evidence.first_inliers >= options.ambiguous_first_inliers or evidence.inliers >= options.many_inliers
    )


def _first_support_is_enough(evidence: Evidence, options: VerdictOptions) -> bool:
    few = evidence.first_inliers >= options.few_first_inliers and evidence.agreement >= options.agreement_of_few
    many = evidence.first_inliers >= options.many_first_inliers or evidence.inliers >= options.many_inliers
    return few or many


def is_precise(evidence: Evidence, options: VerdictOptions) -> bool:
    """Whether what agrees covers enough of the image to tell position and rotation as exactly as a verdict needs."""
    return (
        evidence.spread >= options.minimum_spread
        and evidence.sigma_m <= options.maximum_translation_sigma_m
        and evidence.sigma_deg <= options.maximum_rotation_sigma_deg
    )


def judge(evidence: Evidence | None, options: VerdictOptions) -> Judgement:
    """The verdict on a pose with this evidence, None where there is no pose."""
    if evidence is None or not _is_plausible(evidence, options):
        count = 0 if evidence is None else evidence.first_inliers
        return Judgement(Verdict.FAILED, 0.0, f"no more keypoints agree on a pose than may by chance: {count}")
    confidence = confidence_of(evidence)
    doubts = []
    if evidence.inliers < options.localized_inliers:
        doubts.append(f"only {evidence.inliers} keypoints agree")
    if not _first_support_is_enough(evidence, options):
        doubts.append(
            f"without the pose as a guide only {evidence.first_inliers} pairs agree, "
            f"{evidence.agreement:.0%} of those with the best keyframe"
        )
    if evidence.spread < options.minimum_spread:
        doubts.append("they cover a small part of the image")
    if np.isfinite(evidence.sigma_m) and evidence.sigma_m > options.maximum_translation_sigma_m:
        doubts.append(f"the position is uncertain by {evidence.sigma_m:.2f} m")
    if np.isfinite(evidence.sigma_deg) and evidence.sigma_deg > options.maximum_rotation_sigma_deg:
        doubts.append(f"the rotation is uncertain by {evidence.sigma_deg:.1f} deg")
    # like with like: nothing that a pose has guided, and one keyframe, since of a place elsewhere one was asked
    if evidence.rival > options.rival_share * evidence.first_of_best:
        doubts.append(f"a pose elsewhere has {evidence.rival} against {evidence.first_of_best} inliers")
        confidence = min(confidence, 0.5)  # two places are alike: it is one of them
    if confidence < options.localized_confidence:
        doubts.append(f"all evidence together makes it {confidence:.0%} likely to be right")
    if doubts:
        return Judgement(Verdict.AMBIGUOUS, confidence, "; ".join(doubts))
    return Judgement(Verdict.LOCALIZED, confidence, f"{evidence.inliers} keypoints agree")
