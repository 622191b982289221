"""From the support of a pose to a verdict that can be trusted, and a confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.localization.pose import PoseEstimate
from semdb.types import Verdict


@dataclass(frozen=True, slots=True)
class VerdictOptions:
    """A pose is `localized` when every bound holds, `ambiguous` when only the lower count does."""

    localized_inliers: int = 14
    ambiguous_inliers: int = 8
    convincing_inliers: int = 30  # enough to stop looking at more keyframes
    minimum_spread: float = 0.19  # three cells of a 4x4 grid over the image
    maximum_translation_sigma_m: float = 0.05
    maximum_rotation_sigma_deg: float = 2.0
    rival_share: float = 0.7  # of the inliers that a pose elsewhere may have at most


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
        and estimate.spread >= options.minimum_spread
    )


def judge(estimate: PoseEstimate | None, rival_inliers: int, options: VerdictOptions) -> Judgement:
    """The verdict on a pose whose best rival elsewhere has `rival_inliers` (0: none was found)."""
    if estimate is None or estimate.inliers < options.ambiguous_inliers:
        count = 0 if estimate is None else estimate.inliers
        return Judgement(Verdict.FAILED, 0.0, f"only {count} keypoints agree on a pose")
    confidence = confidence_of(estimate, rival_inliers)
    position, rotation = position_sigma(estimate)
    doubts = []
    if estimate.inliers < options.localized_inliers:
        doubts.append(f"only {estimate.inliers} keypoints agree")
    if estimate.spread < options.minimum_spread:
        doubts.append("they cover a small part of the image")
    if estimate.covariance is not None and position > options.maximum_translation_sigma_m:
        doubts.append(f"the position is uncertain by {position:.2f} m")
    if estimate.covariance is not None and rotation > options.maximum_rotation_sigma_deg:
        doubts.append(f"the rotation is uncertain by {rotation:.1f} deg")
    if rival_inliers > options.rival_share * estimate.inliers:
        doubts.append(f"a pose elsewhere has {rival_inliers} against {estimate.inliers} inliers")
    if doubts:
        return Judgement(Verdict.AMBIGUOUS, min(confidence, 0.5), "; ".join(doubts))
    return Judgement(Verdict.LOCALIZED, confidence, f"{estimate.inliers} keypoints agree")
