"""Where only the confidence is in doubt: does the image look like the map, where measured depth says it is seen?

Far from keyframes few descriptors agree, and what lies between keypoints is seen elsewhere than their depths tell; so
the confidence of keypoints is low for right poses too. Measured depth tells where every pixel of the keyframe is
(`likeness_by_depth`), and then a right pose looks right from afar, and a room of the same shapes still does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from semdb.localization.alike import Alike
from semdb.localization.confidence import Evidence
from semdb.localization.verdict import Judgement, VerdictOptions, judge
from semdb.types import Verdict


@dataclass(frozen=True, slots=True)
class DepthVerdictOptions:
    """Shares (0..1), from which on likeness stands for a confidence that is too low: docs/verdict.md has on what
    they were chosen and on what judged.
    """

    least_alike: float = 0.83  # of what is about the inliers with the best keyframe
    least_alike_in_all: float = 0.74  # of all that the query should see of it
    least_confidence: float = 0.1  # of the keypoints: equal doors of a corridor have .01 to .05


def only_unsure(evidence: Evidence, bounds: VerdictOptions, options: DepthVerdictOptions) -> bool:
    """Whether nothing but the confidence speaks against the pose with this evidence, and not much."""
    surer = replace(bounds, localized_confidence=min(options.least_confidence, bounds.localized_confidence))
    return judge(evidence, surer).verdict is Verdict.LOCALIZED


def weigh_unsure(
    alike: Alike | None,
    evidence: Evidence,
    judgement: Judgement,
    bounds: VerdictOptions,
    options: DepthVerdictOptions,
) -> Judgement:
    """The verdict of a pose that is `only_unsure`: `judgement`, unless it looks `alike` (None: cannot be compared)."""
    if alike is None or alike.about < options.least_alike or alike.in_all < options.least_alike_in_all:
        return judgement
    confidence = max(judgement.confidence, bounds.localized_confidence)
    reason = f"{evidence.inliers} keypoints agree, and by depth {alike.in_all:.0%} of the keyframe looks alike"
    return Judgement(Verdict.LOCALIZED, confidence, reason)
