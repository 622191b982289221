"""What another local feature makes of a query that the map's own left in doubt."""

from __future__ import annotations

import time
from dataclasses import replace

from semdb.localization.alike import alike_of
from semdb.localization.confidence import Evidence
from semdb.localization.fallback import (
    Fallback,
    FallbackOptions,
    alike_by_depth,
    asked_first,
    fallback_numbers,
    weigh_alone,
    weigh_fallback,
)
from semdb.localization.fine_step import FineStep, Settled, ms_since
from semdb.localization.pose import first_pose
from semdb.localization.search import Search, best_of
from semdb.localization.verdict import Judgement, convinces
from semdb.types import Description


def ask_fallback(
    fine: FineStep, search: Search, fallback: Fallback, description: Description, settled: Settled
) -> tuple[Search, Settled]:
    """`search` and what its keypoints say, or those of `fallback` on the same keyframes, where both together are sure.

    What it costs and what it says stands in the search that is returned.
    """
    started = time.perf_counter()
    query = fallback.view_of(description, fine.cache.numbers) if search.keyframes else None
    search.timing_ms["fallback"] = ms_since(started)
    if query is None:
        return search, settled
    pose = fallback.pose_options(fine.options.pose)
    again = replace(
        search, query=query, pose=pose, fallback=fallback.name, blurred=None, keyframes=[], matches=[], first=None,
        estimate=None, others=[], proposals=list(search.proposals), alike=None,
    )  # fmt: skip
    for batch in asked_first(search.keyframes, search.estimate.per_keyframe if search.estimate else ()):
        fine.match(again, batch)
        again.first = first_pose(query, again.keyframes, again.matches, pose)
        if convinces(again.first, fine.options.verdict):
            break
    found = fine.settle(again) if again.keyframes else settled
    if again.estimate is None or found.evidence is None:
        return search, settled
    judgement = _believe_both(fine, search, again, settled.evidence, found)
    reason = f"{again.estimate.inliers} keypoints of {fallback.name} agree, and with the map's own"
    if judgement is None:
        judgement = _believe_alone(fine, search, again, settled.evidence, found)
        reason = f"{again.estimate.inliers} keypoints of {fallback.name} agree, where the map has few of its own"
    if judgement is None:
        return search, settled
    return again, replace(found, judgement=replace(judgement, reason=reason))


def _believe_both(
    fine: FineStep, search: Search, again: Search, evidence: Evidence | None, found: Settled
) -> Judgement | None:
    """What both features say together; `evidence` is of the map's own. Both searches get the numbers."""
    if again.estimate is None or found.evidence is None:
        return None
    alike = alike_by_depth(best_of(search), best_of(again), fine.cache.fallback_views)
    said = fallback_numbers(search.estimate, again.estimate, found.evidence, found.judgement.confidence, alike)
    search.fallback_numbers = again.fallback_numbers = said
    bounds = fine.options.verdict.accepting(search.accept)
    of_both = (search.estimate, evidence, again.estimate, found.evidence, alike, found.judgement)
    return weigh_fallback(*of_both, FallbackOptions(), bounds, search.accept)


def _believe_alone(
    fine: FineStep, search: Search, again: Search, evidence: Evidence | None, found: Settled
) -> Judgement | None:
    """What a fallback says of plain things, on which the map's own feature has hardly a keypoint."""
    options, seen = FallbackOptions(), best_of(again)
    if seen is None or found.evidence is None:
        return None
    own = fine.cache.views([seen[1].keyframe_id])
    if not own or len(own[0].view) >= options.plain:
        return None
    alike = alike_of(seen, fine.cache.fallback_views)
    return weigh_alone(search.estimate, evidence, seen[2], found.evidence, alike, found.judgement, options)
