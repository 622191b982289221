"""Does the query look as the pose says, by the measured depth of a keyframe? What learned features cannot tell alone.

They match what is of one shape whatever its texture, so that a room of the same shapes is taken for the map's with
hundreds of pairs. Depth says where every pixel of the keyframe is, so that windows are compared wherever it is smooth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from semdb.localization.confidence import Evidence
from semdb.localization.likeness import likeness_by_depth
from semdb.localization.pose import PoseEstimate
from semdb.localization.verdict import Judgement
from semdb.localization.views import KeyframeView, View
from semdb.types import Verdict

Seen = tuple[View, KeyframeView, PoseEstimate, int]  # a query, the keyframe with most inliers, the pose, its slot there
WithDepth = Callable[[Sequence[int]], Sequence[KeyframeView]]  # keyframes of ids that have depth, with it

NO_MORE_THAN = 0.5  # the confidence where something looks otherwise


@dataclass(frozen=True, slots=True)
class Alike:
    """What looks alike in the query and its best keyframe, by measured depth; shares (0..1)."""

    about: float  # of what is about the inliers
    in_all: float  # of all that the query should see


@dataclass(frozen=True, slots=True)
class LearnedVerdictOptions:
    """What has to look alike where a learned feature alone is to be believed.

    Chosen on rendered rooms with their copies, the red kitchen and the cabinet (docs/features.md).
    """

    least_about: float = 0.8  # of rooms of the same shapes 0.58 to 0.88
    least_in_all: float = 0.47  # of the same furniture elsewhere at most 0.41
    least_likeness: float = 0.48  # by the depth of keypoints: of rooms of the same shapes that pass so far mostly 0.45


def alike_of(seen: Seen, with_depth: WithDepth) -> Alike | None:
    """How alike query and keyframe are about the pairs of the pose; None where they cannot be compared."""
    query, keyframe, estimate, slot = seen
    found = with_depth([keyframe.keyframe_id])
    if not found:
        return None
    pairs = estimate.pairs.take(estimate.pairs.slot == slot)
    pixels, theirs = query.seen_xy[pairs.query], keyframe.view.seen_xy[pairs.keypoint]
    shares = likeness_by_depth(query, found[0], estimate.world_from_camera, pixels, theirs)
    return None if shares is None else Alike(*shares)


def weigh_learned(
    judgement: Judgement, evidence: Evidence | None, alike: Alike | None, options: LearnedVerdictOptions
) -> Judgement:
    """`judgement` of a learned feature alone, from its `evidence`, by what looks `alike`.

    As it is where that is not known (None).
    """
    if judgement.verdict is not Verdict.LOCALIZED or evidence is None or alike is None:
        return judgement
    by_depth = alike.about >= options.least_about and alike.in_all >= options.least_in_all
    if by_depth and evidence.likeness >= options.least_likeness:
        return judgement
    doubt = (
        f"only {min(alike.about, evidence.likeness):.0%} of what is about the pairs looks alike, "
        f"{alike.in_all:.0%} of all that is in view"
    )
    return Judgement(Verdict.AMBIGUOUS, min(judgement.confidence, NO_MORE_THAN), doubt)
