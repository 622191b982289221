"""From the support of a pose to a verdict that can be trusted, and a confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.localization.pose import PoseEstimate
from semdb.types import Verdict


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
    maximum_translation_sigma_m: float = 0.035
    maximum_rotation_sigma_deg: float = 1.5
    rival_share: float = 0.7  # of the first inliers with the best keyframe, that a pose elsewhere may have at most


@dataclass(frozen=True, slots=True)
class Judgement:
    """`reason` is one line for people."""

    verdict: Verdict
    confidence: float
    reason: str


def position_sigma(estimate: PoseEstimate) -> tuple[float, float]:
    """Standard deviation of position (m) and rotation (deg) along the worst axis; infinite without covariance."""
    if estimate.covariance is None:
        return float("inf"), float("inf")
    position = float(np.sqrt(max(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1], 0.0)))
    rotation = float(np.sqrt(max(np.linalg.eigvalsh(estimate.covariance[3:, 3:])[-1], 0.0)))
    return position, float(np.degrees(rotation))


def confidence_of(estimate: PoseEstimate, rival_inliers: int) -> float:
    """Confidence 0..1: a logistic function of inliers, their spread and the best rival's inliers."""
    support = np.log(max(estimate.inliers, 1)) - np.log(max(rival_inliers, 6)) / 3
    score = 3.0 * (support - 2.1) + 4.0 * (estimate.spread - 0.25)
    return float(1 / (1 + np.exp(-score)))


def convinces(estimate: PoseEstimate | None, options: VerdictOptions) -> bool:
    """Whether a pose is so well supported that no further keyframe need be asked."""
    return (
        estimate is not None
        and estimate.inliers >= options.convincing_inliers
        and estimate.first_inliers >= options.many_first_inliers
        and estimate.spread >= options.minimum_spread
    )


def _is_plausible(estimate: PoseEstimate, options: VerdictOptions) -> bool:
    """Whether more agrees than does for images of quite another place."""
    by_best = (
        estimate.first_of_best >= options.ambiguous_first_of_best and estimate.agreement >= options.ambiguous_agreement
    )
    return estimate.inliers >= options.ambiguous_inliers and (
        by_best or estimate.first_inliers >= options.ambiguous_first_inliers or estimate.inliers >= options.many_inliers
    )


def _first_support_is_enough(estimate: PoseEstimate, options: VerdictOptions) -> bool:
    few = estimate.first_inliers >= options.few_first_inliers and estimate.agreement >= options.agreement_of_few
    many = estimate.first_inliers >= options.many_first_inliers or estimate.inliers >= options.many_inliers
    return few or many


def judge(estimate: PoseEstimate | None, rival_inliers: int, options: VerdictOptions) -> Judgement:
    """The verdict on a pose whose best rival elsewhere has `rival_inliers` (0: none was found)."""
    if estimate is None or not _is_plausible(estimate, options):
        count = 0 if estimate is None else estimate.first_inliers
        return Judgement(Verdict.FAILED, 0.0, f"no more keypoints agree on a pose than may by chance: {count}")
    confidence = confidence_of(estimate, rival_inliers)
    position, rotation = position_sigma(estimate)
    doubts = []
    if estimate.inliers < options.localized_inliers:
        doubts.append(f"only {estimate.inliers} keypoints agree")
    if not _first_support_is_enough(estimate, options):
        doubts.append(
            f"without the pose as a guide only {estimate.first_inliers} pairs agree, "
            f"{estimate.agreement:.0%} of those with the best keyframe"
        )
    if estimate.spread < options.minimum_spread:
        doubts.append("they cover a small part of the image")
    if estimate.covariance is not None and position > options.maximum_translation_sigma_m:
        doubts.append(f"the position is uncertain by {position:.2f} m")
    if estimate.covariance is not None and rotation > options.maximum_rotation_sigma_deg:
        doubts.append(f"the rotation is uncertain by {rotation:.1f} deg")
    # like with like: nothing that a pose has guided, and one keyframe, since of a place elsewhere one was asked
    if rival_inliers > options.rival_share * estimate.first_of_best:
        doubts.append(f"a pose elsewhere has {rival_inliers} against {estimate.first_of_best} inliers")
    if doubts:
        return Judgement(Verdict.AMBIGUOUS, min(confidence, 0.5), "; ".join(doubts))
    return Judgement(Verdict.LOCALIZED, confidence, f"{estimate.inliers} keypoints agree")
