"""Where the place is in doubt, poses are told apart by what keyframes predict from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from semdb.geometry import invert_pose
from semdb.localization.coarse import Stage
from semdb.localization.confidence import Evidence
from semdb.localization.fine_step import FineStep
from semdb.localization.laid_pose import LaidPose, estimate_with, support_of
from semdb.localization.pose import first_pose_at
from semdb.localization.predicted_view import SmallView
from semdb.localization.search import Search, evidence_of
from semdb.localization.verdict import Judgement, judge
from semdb.localization.view_search import is_same
from semdb.localization.view_step import (
    Standing,
    is_like,
    is_weak,
    judge_seen,
    view_numbers,
    vouches,
)
from semdb.localization.viewing import Viewing
from semdb.types import ConsistentPose, Description, FloatArray, Verdict

Judged = tuple[Judgement, Evidence | None]


def tell_apart(
    fine: FineStep,
    viewing: Viewing,
    search: Search,
    description: Description,
    judgement: Judgement,
    evidence: Evidence | None,
) -> Judged:
    """The verdict after `viewing`, and the evidence of the pose that `search` has then."""
    if search.stage == Stage.GIVEN or search.fallback or search.blurred is not None:
        return judgement, evidence
    if fine.options.learned is not None and search.alike is not None and judgement.verdict is Verdict.AMBIGUOUS:
        return judgement, evidence  # a learned feature was refused by what it should look like
    viewing = replace(viewing, options=viewing.options.accepting(search.accept))
    options, bounds = viewing.options, fine.options.verdict.accepting(search.accept)
    weak = evidence is not None and is_weak(evidence, options)
    doubted = weak if judgement.verdict is Verdict.LOCALIZED else True
    query = viewing.of(description) if doubted and search.keyframes else None
    standing = None if query is None else _standing(fine, viewing, search, query, description)
    if query is None or standing is None:
        return judgement, evidence
    pose, own = standing.best.world_from_camera, False
    if search.estimate is not None:
        own = is_same(search.estimate.world_from_camera, pose, options.same)
    laid = None
    if standing.is_sure(options):
        search.seen = pose
        anew, laid = _found_at(fine, viewing, search, query, description, own)
        if anew is not None:
            own, (judgement, evidence) = True, anew
        elif own and search.estimate is not None:  # what is answered is not the pose that is sure, but one near it
            standing = replace(standing, best=viewing.see(query, search.estimate.world_from_camera))
    search.view_numbers = view_numbers(standing)
    after = judge_seen(judgement, evidence, standing, own, options, bounds, laid is not None)
    if after.verdict is not judgement.verdict and after.verdict is Verdict.AMBIGUOUS and search.estimate:
        _name_others(search, standing.against(search.estimate.world_from_camera, options))
    elif after is not judgement and after.verdict is Verdict.LOCALIZED:
        search.others.clear()  # they look less like the image
    return after, evidence


def _standing(
    fine: FineStep, viewing: Viewing, search: Search, query: SmallView, description: Description
) -> Standing | None:
    """How poses stand, once more keyframes were matched; these stay only where one pose is sure."""
    matched = {keyframe.keyframe_id for keyframe in search.keyframes}
    kept = list(search.keyframes), list(search.matches), list(search.proposals)
    more = [proposal for proposal in search.following if proposal.keyframe_id not in matched][: viewing.options.more]
    search.proposals += more
    fine.match(search, [proposal.keyframe_id for proposal in more])
    standing = viewing.standing(search, query, description)
    if standing is None or not standing.is_sure(viewing.options):
        search.keyframes, search.matches, search.proposals = kept
    return standing


def _found_at(
    fine: FineStep, viewing: Viewing, search: Search, query: SmallView, description: Description, own: bool
) -> tuple[Judged | None, LaidPose | None]:
    """What keypoints say about the pose that is sure (`search.seen`), which the search then has, and edges laid there.

    None, and the pose as it was, where neither finds any there, or it does not look like the query. `own` is whether
    it is the pose that they had found.
    """
    pose, before, options = search.seen, (search.first, search.estimate), viewing.options
    bounds, edges = fine.options.verdict.accepting(search.accept), fine.options.edges
    if pose is None:
        return None, None
    search.first = first_pose_at(search.query, search.keyframes, search.matches, invert_pose(pose), search.pose)
    search.estimate = None
    fine.ask_neighbours(search)
    laid = None if edges is None else viewing.laid(search, query, description, pose, edges, bounds)
    if laid is None or edges is None:
        fine.estimate(search)
    else:  # keypoints along edges, or too few of them, leave a pose free that edges hold
        search.estimate = estimate_with(laid, search.query, search.keyframes, search.matches, edges, search.pose)
    found = search.estimate
    anew = None if found is None else evidence_of(search, found, 0)
    said = judge(anew, bounds)  # of another pose something else was said
    failed = said.verdict is Verdict.FAILED and not (laid is not None and vouches(anew, options.least_support, bounds))
    if found is None or failed or not is_like(viewing.see(query, found.world_from_camera), options):
        search.first, search.estimate = before
        return None, None
    search.alike = search.alike if own else None  # that was of another pose
    search.seen = found.world_from_camera
    search.others.clear()
    return (said, anew), laid


def _name_others(search: Search, poses: Sequence[FloatArray]) -> None:
    """Poses ``[4, 4]`` elsewhere that stand against the estimate, with the keypoints that vouch for each."""
    for pose in poses:
        count = support_of(pose, search.query, search.keyframes, search.matches, search.pose.inlier_px)
        search.others.append(ConsistentPose(pose, count))
