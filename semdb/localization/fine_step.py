"""The fine step: keyframes are matched with the query, a pose found, others near it asked, and the last pose judged."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.localization.blurred import BlurredKeyframes, blurred_query, extractor_for
from semdb.localization.coarse import Batch, Proposal, Stage
from semdb.localization.confidence import Evidence
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.localization.laying import rival_of
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.neighbours import by_side
from semdb.localization.pose import estimate_pose, first_pose, match_views
from semdb.localization.search import Search, evidence_of
from semdb.localization.verdict import Judgement, convinces, judge
from semdb.localization.views import in_kind_of
from semdb.perception.quality import motion_blur
from semdb.types import Description, ModelInfo

FAR = 4.0  # of `pose_distances`: keyframes nearer than this may see the same things
ASKED_BY_SIDE = 6  # so many of the nearest are candidates for each neighbour


@dataclass(frozen=True, slots=True)
class Settled:
    """What the keypoints of all that was matched say."""

    convinced: bool  # whether the first pose did
    judgement: Judgement
    evidence: Evidence | None


@dataclass(frozen=True, slots=True)
class FineStep:
    """Matches keyframes of `cache` with queries. `models` are those of the map."""

    cache: KeyframeCache
    models: Sequence[ModelInfo]
    options: LocalizerOptions

    def ask(self, search: Search, batch: Batch) -> None:
        search.stage, search.ranked = batch.stage, batch.ranked
        search.proposals += batch.proposals
        search.following = batch.following
        self.match(search, [proposal.keyframe_id for proposal in batch.proposals])
        started = time.perf_counter()
        search.first = first_pose(search.query, search.keyframes, search.matches, search.pose)
        search.timing_ms["pose"] += ms_since(started)

    def match(self, search: Search, keyframe_ids: Sequence[int]) -> None:
        started = time.perf_counter()
        if search.fallback:
            keyframes = self.cache.fallback_views(keyframe_ids)
        else:
            keyframes = self.cache.views(keyframe_ids, None if search.blurred else search.query.descriptors)
        if search.blurred is not None:
            keyframes = search.blurred.views(keyframes, self.options.pose.threads)
        search.keyframes += keyframes
        search.query = in_kind_of(keyframes, search.query)
        search.matches += match_views(search.query, keyframes, search.pose)
        search.timing_ms["match"] += ms_since(started)

    def blur_alike(self, search: Search, description: Description) -> None:
        """Where motion has blurred the query the likeliest keyframes are blurred alike, if more agrees then."""
        options, threads = self.options.blur, self.options.pose.threads
        if options is None or description.grey is None or not search.keyframes:
            return
        started = time.perf_counter()
        extractor, blur = extractor_for(self.models, options), motion_blur(description.grey, options.least_peak)
        if extractor is None or blur is None:
            return
        query = blurred_query(description, description.grey, extractor, self.cache.numbers)
        order = sorted(range(len(search.keyframes)), key=lambda slot: (-len(search.matches[slot]), slot))
        likeliest = [search.keyframes[slot] for slot in order[: options.keyframes]]
        blurred = BlurredKeyframes(self.cache.store, extractor, blur, self.cache.numbers)
        keyframes = blurred.views(likeliest, threads)
        matches = match_views(query, keyframes, self.options.pose)
        first = first_pose(query, keyframes, matches, self.options.pose)
        if first is not None and (search.first is None or first.inliers > search.first.inliers):
            search.query, search.keyframes, search.matches, search.first = query, keyframes, matches, first
            search.blurred = blurred
        search.timing_ms["match"] += ms_since(started)

    def settle(self, search: Search) -> Settled:
        """The last pose of all that was matched, and what the keypoints alone say of it."""
        convinced = convinces(search.first, self.options.verdict) and search.stage != Stage.GIVEN
        if convinced:
            self.ask_neighbours(search)
        convinced = self.ask_frames(search, convinced)
        self.estimate(search)
        if convinced:
            self.ask_twins(search)
        started = time.perf_counter()
        evidence, bounds = None, self.options.verdict.accepting(search.accept)
        if search.estimate is not None:
            rival = rival_of(search, search.estimate)
            evidence = evidence_of(search, search.estimate, 0 if rival is None else rival.inliers)
            if rival is not None and rival.inliers > bounds.rival_share * evidence.first_of_best:
                search.others.append(rival)
        search.timing_ms["pose"] += ms_since(started)
        return Settled(convinced, judge(evidence, bounds), evidence)

    def ask_neighbours(self, search: Search) -> None:
        """Keyframes near the first pose see the same things from elsewhere: their pairs steady the pose."""
        if search.first is None or self.options.neighbours == 0:
            return
        matched = {keyframe.keyframe_id for keyframe in search.keyframes}
        pose, best = search.first.world_from_camera, search.keyframes[search.first.first.best]
        near, poses = self.cache.near(pose, FAR, matched, ASKED_BY_SIDE * self.options.neighbours)
        order = by_side(pose, best.world_from_camera, poses)[: self.options.neighbours]
        chosen = [near[n] for n in order]
        if chosen:
            search.proposals += [Proposal(i, float("nan"), float("nan")) for i in chosen]
            self.match(search, chosen)

    def ask_frames(self, search: Search, convinced: bool) -> bool:
        """Frames beside the keyframes may have seen it from nearer; whether the first pose convinces now."""
        of = self.options
        if search.first is None or not of.frames or search.fallback or search.stage == Stage.GIVEN:
            return convinced
        if search.blurred is not None:
            return convinced
        started = time.perf_counter()
        found = self.cache.frames_near(search.first.world_from_camera, FAR, of.frames, search.query.descriptors)
        if found:
            search.proposals += [Proposal(one.keyframe_id, float("nan"), float("nan")) for one in found]
            search.keyframes += found
            search.matches += match_views(search.query, found, search.pose)
            if not convinced:
                search.first = first_pose(search.query, search.keyframes, search.matches, search.pose) or search.first
        search.timing_ms["match"] += ms_since(started)
        return convinced or (bool(found) and convinces(search.first, of.verdict))

    def estimate(self, search: Search) -> None:
        """The last pose, of all that was matched; without the neighbours where these take support away."""
        if search.first is None:
            return
        started = time.perf_counter()
        counts = dict.fromkeys((len(search.keyframes), search.first.keyframes))
        for count in counts:
            found = estimate_pose(
                search.query, search.keyframes[:count], search.matches[:count], search.pose, search.first
            )
            if search.estimate is None or (found is not None and found.inliers > search.estimate.inliers):
                search.estimate = found
            if search.estimate is not None and search.estimate.inliers >= search.first.inliers:
                break
        search.timing_ms["pose"] += ms_since(started)

    def ask_twins(self, search: Search) -> None:
        """A keyframe far from the pose that looks as much like the query may show a place that is the same twice.

        Its pairs do not join the pose; they are there for `rival_pose`. On the recordings of README.md the
        best far keyframe is 0.07 or more behind in cosine for 99 of 100 queries, so hardly any query pays for this.
        """
        known = [proposal.cosine for proposal in search.proposals if np.isfinite(proposal.cosine)]
        if search.estimate is None or not known:
            return
        limit = max(known) - self.options.twin_cosine
        matched = {keyframe.keyframe_id for keyframe in search.keyframes}
        alike = [p for p in search.following if p.cosine >= limit and p.keyframe_id not in matched]
        distance = self.cache.distances(search.estimate.world_from_camera, [p.keyframe_id for p in alike])
        chosen = [p for p, far in zip(alike, distance >= FAR, strict=True) if far][: self.options.twins]
        if chosen:
            search.proposals += chosen
            self.match(search, [proposal.keyframe_id for proposal in chosen])


def ms_since(started: float) -> float:
    """Milliseconds since `started`, of `time.perf_counter`."""
    return (time.perf_counter() - started) * 1000
