"""What one query has tried so far, and what is read off it in the end."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from semdb.localization.alike import Alike, Seen
from semdb.localization.blurred import BlurredKeyframes
from semdb.localization.coarse import Proposal, Stage
from semdb.localization.confidence import Evidence, gather_evidence
from semdb.localization.laid_pose import LaidPose
from semdb.localization.landmark_pose import LandmarkPose
from semdb.localization.matching import Matches
from semdb.localization.pose import FirstPose, PoseEstimate
from semdb.localization.pose_options import PoseOptions
from semdb.localization.views import KeyframeView, View
from semdb.types import Candidate, ConsistentPose, Float32Array, FloatArray, Tolerance


@dataclass(slots=True)
class Search:
    """What one query has tried so far."""

    query: View
    keyframes_in_map: int
    pose: PoseOptions
    accept: Tolerance | None = None
    others: list[ConsistentPose] = field(default_factory=list)
    laid: list[LaidPose] = field(default_factory=list)
    by_landmarks: LandmarkPose | None = None
    keyframes: list[KeyframeView] = field(default_factory=list)
    matches: list[Matches] = field(default_factory=list)
    proposals: list[Proposal] = field(default_factory=list)
    first: FirstPose | None = None
    blurred: BlurredKeyframes | None = None  # what makes its keyframes, where these are blurred like it
    estimate: PoseEstimate | None = None
    fallback: str = ""  # the feature that `query` and `keyframes` are of, where it is not the map's
    fallback_numbers: dict[str, float] = field(default_factory=dict)  # what another feature said
    alike: Alike | None = None  # by measured depth, of a learned feature or where one is not sure
    seen: FloatArray | None = None  # a pose that is sure by what is predicted from there
    view_numbers: dict[str, float] = field(default_factory=dict)
    following: tuple[Proposal, ...] = ()
    stage: str = Stage.FILTERED
    ranked: int = 0
    timing_ms: dict[str, float] = field(default_factory=lambda: {"filter": 0.0, "rank": 0.0, "match": 0.0, "pose": 0.0})


def numbers_of(search: Search, evidence: Evidence | None) -> dict[str, float]:
    """All evidence, of keypoints, of what was laid, and of landmarks."""
    found = evidence.as_mapping() if evidence else {}
    for laid in search.laid:
        found |= laid.numbers
    if search.alike is not None:
        found |= {"alike": search.alike.about, "alike_in_all": search.alike.in_all}
    found |= search.fallback_numbers | search.view_numbers
    return found | (search.by_landmarks.as_mapping() if search.by_landmarks else {})


def evidence_of(search: Search, estimate: PoseEstimate, rival: int) -> Evidence:
    cosines = {proposal.keyframe_id: proposal.cosine for proposal in search.proposals}
    known = [cosines[keyframe.keyframe_id] for keyframe in search.keyframes]
    return gather_evidence(search.query, search.keyframes, estimate, rival, known)


def best_of(search: Search) -> Seen | None:
    """The query, the keyframe that has most inliers, the pose, and its number there; None where there is none."""
    return None if search.estimate is None else seen_by(search, search.estimate)


def seen_by(search: Search, estimate: PoseEstimate) -> Seen:
    """The same of any pose of what was matched."""
    own = (n for n in range(len(estimate.per_keyframe)) if search.keyframes[n].keyframe_id > 0)
    best = max(own, key=estimate.per_keyframe.__getitem__)  # of frames beside keyframes no depth is kept
    return search.query, search.keyframes[best], estimate, best


def best_pairs(
    search: Search, estimate: PoseEstimate | None, best: int | None
) -> tuple[Float32Array | None, Float32Array | None]:
    """Pixels as seen of the inlier pairs with the best keyframe, for pictures."""
    if estimate is None or best is None:
        return None, None
    slot = next(s for s, keyframe in enumerate(search.keyframes) if keyframe.keyframe_id == best)
    pairs = estimate.pairs.take(estimate.pairs.slot == slot)
    return search.query.seen_xy[pairs.query], search.keyframes[slot].view.seen_xy[pairs.keypoint]


def candidates_of(
    search: Search, inliers: Mapping[int, int], name_of: Callable[[int], tuple[str, int]]
) -> tuple[Candidate, ...]:
    """The keyframes that were proposed, with `inliers` by id; `name_of` gives recording and frame index of one."""
    found = []
    for proposal in search.proposals:
        if proposal.keyframe_id < 0:  # a frame beside keyframes
            continue
        recording, frame_index = name_of(proposal.keyframe_id)
        found.append(
            Candidate(
                keyframe_id=proposal.keyframe_id,
                recording=recording,
                frame_index=frame_index,
                class_score=proposal.class_score,
                cosine=proposal.cosine,
                inliers=inliers.get(proposal.keyframe_id, 0),
            )
        )
    return tuple(found)
