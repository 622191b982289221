"""Where the algorithms meet the database: a description in, a typed localization out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.class_score import strengths
from semdb.database.planning import check_models
from semdb.errors import NotFoundError
from semdb.geometry import invert_pose
from semdb.localization.alike import LearnedVerdictOptions, alike_of, weigh_learned
from semdb.localization.blurred import BlurOptions, BlurredKeyframes, blurred_query, extractor_for
from semdb.localization.coarse import (
    Batch,
    CoarseOptions,
    CoarseSource,
    Proposal,
    QueryClasses,
    Stage,
    cascade,
    query_classes,
    retrieve,
)
from semdb.localization.confidence import Evidence
from semdb.localization.depth_step import DepthVerdictOptions, only_unsure, weigh_unsure
from semdb.localization.edge_step import EdgeVerdictOptions
from semdb.localization.fallback import (
    Fallback,
    FallbackOptions,
    alike_by_depth,
    asked_first,
    fallback_numbers,
    weigh_alone,
    weigh_fallback,
)
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.localization.laid_pose import support_of
from semdb.localization.landmark_pose import LandmarkPoseOptions
from semdb.localization.landmark_step import landmark_pose
from semdb.localization.laying import Laying, rival_of, with_laid
from semdb.localization.learned_matching import for_learned, is_learned
from semdb.localization.neighbours import by_side
from semdb.localization.pose import (
    PoseEstimate,
    estimate_pose,
    first_pose,
    first_pose_at,
    match_views,
    recorded_covariance,
)
from semdb.localization.pose_options import PoseOptions
from semdb.localization.search import Search, best_of, best_pairs, candidates_of, evidence_of, numbers_of
from semdb.localization.sources import TimedSource
from semdb.localization.surface_step import SurfaceVerdictOptions
from semdb.localization.verdict import Judgement, VerdictOptions, convinces, judge
from semdb.localization.view_step import Viewing, ViewOptions, is_like, is_same, is_weak, judge_seen, view_numbers
from semdb.localization.views import View, in_kind_of, make_view
from semdb.perception.quality import complaint_of, image_quality, motion_blur
from semdb.types import (
    ConsistentPose,
    Description,
    FloatArray,
    Localization,
    ModelInfo,
    Tolerance,
    Verdict,
)

Settled = tuple[bool, Judgement, Evidence | None]  # whether a first pose convinced, and what is made of the last

FAR = 4.0  # of `pose_distances`: keyframes nearer than this may see the same things
ASKED_BY_SIDE = 6  # so many of the nearest are candidates for each neighbour


@dataclass(frozen=True, slots=True)
class LocalizerOptions:
    """Everything that a method of `semdb evaluate` can vary."""

    coarse: CoarseOptions = field(default_factory=CoarseOptions)
    pose: PoseOptions = field(default_factory=PoseOptions)
    verdict: VerdictOptions = field(default_factory=VerdictOptions)
    neighbours: int = 2  # keyframes near the first pose that join once it convinces
    twins: int = 1  # keyframes far from the pose that are asked when they look as much like the query
    refined_points: bool = True  # those of `semdb refine`, where the map has not changed since
    frames: int = 2  # beside keyframes (`semdb refine --frames`), near the first pose, that join
    surfaces: SurfaceVerdictOptions | None = field(default_factory=SurfaceVerdictOptions)  # of a query with depth
    edges: EdgeVerdictOptions | None = field(default_factory=EdgeVerdictOptions)  # where neither convinces
    by_depth: DepthVerdictOptions | None = field(default_factory=DepthVerdictOptions)  # where keypoints are not sure
    views: ViewOptions | None = field(default_factory=ViewOptions)  # where poses elsewhere may be right as well
    blur: BlurOptions | None = field(default_factory=BlurOptions)  # of a query that motion has blurred
    landmarks: LandmarkPoseOptions | None = field(default_factory=LandmarkPoseOptions)  # where keypoints fail
    learned: LearnedVerdictOptions | None = None  # of a map of learned features; `for_models` sets it
    fallback: bool = True  # whether the other feature is asked that settings name, where keypoints do not convince
    recorded_errors: bool = True  # whether covariances count by how far recorded poses are off
    accept: Tolerance | None = None  # how far poses may differ that are one, where a query does not say
    twin_cosine: float = 0.05  # how much less than the best keyframe's cosine is "as much"

    def with_threads(self, threads: int) -> LocalizerOptions:
        """The same with so many threads for a query."""
        return replace(self, pose=replace(self.pose, threads=threads))

    def for_models(self, models: Sequence[ModelInfo]) -> LocalizerOptions:
        """The same with the thresholds that the local feature among `models` needs."""
        if not is_learned(models):
            return self
        pose = replace(self.pose, matching=for_learned(self.pose.matching))
        # they find a room of the same shapes as well: what they are unsure of stays in doubt
        return replace(self, pose=pose, learned=self.learned or LearnedVerdictOptions(), by_depth=None)


class Localizer:
    """Localizes descriptions in one map.

    `source` answers the coarse step, `cache` loads keyframes. Threads may share it where they may share the source
    (`SharedSource`).
    """

    def __init__(
        self,
        map_name: str,
        models: Sequence[ModelInfo],
        source: CoarseSource,
        cache: KeyframeCache,
        options: LocalizerOptions | None = None,
        confusions: Mapping[str, Mapping[str, int]] | None = None,
    ) -> None:
        self.map_name = map_name
        self.models = tuple(models)
        self.source = source
        self.cache = cache
        self.options = (options or LocalizerOptions()).for_models(self.models)
        of = self.options
        self.laying = Laying(cache, of.surfaces, of.edges, of.verdict, of.pose.use_query_depth)
        self.viewing = None if of.views is None else Viewing(cache, of.views)
        self.confusions = confusions or {}  # class -> classes it is taken for -> weight in millionths

    def localize(self, description: Description, accept: Tolerance | None = None) -> Localization:
        """The pose of `description` in the map; poses within `accept` are one for the caller.

        Raises ProvenanceError when other models made the map, NotFoundError when the map holds no keyframe, CodecError
        where none that can be used is found among damaged ones.
        """
        search = self._search(description, accept or self.options.accept)
        source = TimedSource(self.source)
        started = time.perf_counter()
        for batch in cascade(source, self._classes(description), description.cnn_vector, self.options.coarse):
            search.timing_ms["rank"] += _ms_since(started)
            self._try(search, batch)
            if convinces(search.first, self.options.verdict):
                break
            started = time.perf_counter()
        else:
            self._blur_alike(search, description)
        search.timing_ms["filter"] = source.filter_ms
        search.timing_ms["rank"] -= source.filter_ms
        return self._conclude(search, description)

    def retrieve(self, description: Description, count: int) -> list[Proposal]:
        """The first `count` keyframes of the coarse step alone, in the order in which it would have them matched.

        Raises what `localize` raises.
        """
        self._check(description)
        return retrieve(self.source, self._classes(description), description.cnn_vector, count, self.options.coarse)

    def _classes(self, description: Description) -> QueryClasses:
        counts = {name: float(count) for name, count in description.category_counts.items()}
        return query_classes(counts, strengths(description.evidence), self.confusions, self.options.coarse)

    def localize_among(self, description: Description, keyframe_ids: Sequence[int]) -> Localization:
        """The fine step alone, on keyframes that the caller names (the `oracle` of evaluations)."""
        search = self._search(description, self.options.accept)
        proposals = tuple(Proposal(i, float("nan"), float("nan")) for i in keyframe_ids)
        self._try(search, Batch(Stage.GIVEN, proposals, 0))
        return self._conclude(search, description)

    def refresh(self) -> int:
        """How many keyframes the map holds, once what was done to it is taken over."""
        change = self.source.refresh()
        if change:
            self.cache.forget(change)
        return self.source.keyframe_count()

    def _check(self, description: Description) -> int:
        """How many keyframes the map holds, once it is known that they can be compared with `description`."""
        keyframes = self.refresh()
        if not keyframes:
            raise NotFoundError(f"map {self.map_name!r} holds no keyframe: ingest a recording into it first")
        check_models(self.models, description.models, f"the map {self.map_name!r}")
        return keyframes

    def _search(self, description: Description, accept: Tolerance | None) -> Search:
        return Search(self._view_of(description), self._check(description), self.options.pose, accept)

    def _view_of(self, description: Description) -> View:
        categories = [detection.category for detection in description.detections]
        return make_view(
            description.camera, description.keypoints, categories, self.cache.numbers, grey=description.grey
        )

    def _blur_alike(self, search: Search, description: Description) -> None:
        """Where motion has blurred the query the likeliest keyframes are blurred alike, if more agrees then."""
        options, threads = self.options.blur, self.options.pose.threads
        if options is None or description.grey is None or not search.keyframes:
            return
        started = time.perf_counter()
        extractor, blur = extractor_for(self.models, options), motion_blur(description.grey)
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
        search.timing_ms["match"] += _ms_since(started)

    def _try(self, search: Search, batch: Batch) -> None:
        search.stage, search.ranked = batch.stage, batch.ranked
        search.proposals += batch.proposals
        search.following = batch.following
        self._match(search, [proposal.keyframe_id for proposal in batch.proposals])
        started = time.perf_counter()
        search.first = first_pose(search.query, search.keyframes, search.matches, search.pose)
        search.timing_ms["pose"] += _ms_since(started)

    def _match(self, search: Search, keyframe_ids: Sequence[int]) -> None:
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
        search.timing_ms["match"] += _ms_since(started)

    def _conclude(self, search: Search, description: Description) -> Localization:
        damaged = [p.keyframe_id for p in search.proposals if p.keyframe_id in self.cache.left_out]
        if damaged and not search.keyframes:
            raise self.cache.left_out[damaged[0]]
        convinced, judgement, evidence = self._settle(search)
        judgement = self._look(search, judgement, evidence)
        if judgement.verdict is not Verdict.LOCALIZED and self.cache.fallback is not None:
            search, convinced, judgement, evidence = self._ask_fallback(
                search, self.cache.fallback, description, (convinced, judgement, evidence)
            )
        started, counted = time.perf_counter(), search.timing_ms["match"] + search.timing_ms["pose"]
        judgement, evidence = self._tell_apart(search, description, judgement, evidence)
        if not (convinced or search.seen is not None) or judgement.verdict is not Verdict.LOCALIZED:
            for laid, options in self.laying.poses(search, description):
                judgement, evidence = with_laid(search, laid, options, convinced, judgement, evidence)
                if laid.is_sure:
                    break
        counted -= search.timing_ms["match"] + search.timing_ms["pose"]  # what was counted meanwhile counts once
        search.timing_ms["pose"] += _ms_since(started) + counted
        if judgement.verdict is Verdict.FAILED and search.stage != Stage.GIVEN:
            judgement = self._by_landmarks(search, description, judgement)
        if judgement.verdict is not Verdict.LOCALIZED and description.grey is not None:
            wrong = complaint_of(image_quality(description.grey, description.stretch))
            judgement = replace(judgement, reason="; ".join(filter(None, (judgement.reason, wrong))))
        return self._result(search, judgement, evidence)

    def _settle(self, search: Search) -> Settled:
        """The last pose of all that was matched, and what the keypoints alone say of it."""
        convinced = convinces(search.first, self.options.verdict) and search.stage != Stage.GIVEN
        if convinced:
            self._ask_neighbours(search)
        convinced = self._ask_frames(search, convinced)
        self._estimate(search)
        if convinced:
            self._ask_twins(search)
        started = time.perf_counter()
        evidence, bounds = None, self.options.verdict.accepting(search.accept)
        if search.estimate is not None:
            rival = rival_of(search, search.estimate)
            evidence = evidence_of(search, search.estimate, 0 if rival is None else rival.inliers)
            if rival is not None and rival.inliers > bounds.rival_share * evidence.first_of_best:
                search.others.append(rival)
        search.timing_ms["pose"] += _ms_since(started)
        return convinced, judge(evidence, bounds), evidence

    def _look(self, search: Search, judgement: Judgement, evidence: Evidence | None) -> Judgement:
        """The verdict by what looks alike in query and best keyframe: of learned features, and where one is unsure."""
        learned, unsure, seen = self.options.learned, self.options.by_depth, best_of(search)
        bounds = self.options.verdict.accepting(search.accept)
        if seen is None or evidence is None or search.blurred is not None:
            return judgement
        asked = judgement.verdict is Verdict.LOCALIZED and learned is not None
        doubted = judgement.verdict is Verdict.AMBIGUOUS and unsure is not None
        if not (asked or (doubted and unsure is not None and only_unsure(evidence, bounds, unsure))):
            return judgement
        started = time.perf_counter()
        search.alike = alike_of(seen, self.cache.with_depth)
        search.timing_ms["pose"] += _ms_since(started)
        if learned is not None and asked:
            return weigh_learned(judgement, evidence, search.alike, learned)
        return judgement if unsure is None else weigh_unsure(search.alike, evidence, judgement, bounds, unsure)

    def _ask_fallback(
        self, search: Search, fallback: Fallback, description: Description, settled: Settled
    ) -> tuple[Search, bool, Judgement, Evidence | None]:
        """What another feature makes of the same keyframes, where both together are sure."""
        started = time.perf_counter()
        query = fallback.view_of(description, self.cache.numbers) if search.keyframes else None
        search.timing_ms["fallback"] = _ms_since(started)
        if query is None:
            return search, *settled
        pose = fallback.pose_options(self.options.pose)
        again = replace(
            search, query=query, pose=pose, fallback=fallback.name, blurred=None, keyframes=[], matches=[], first=None,
            estimate=None, others=[], proposals=list(search.proposals), alike=None,
        )  # fmt: skip
        for batch in asked_first(search.keyframes, search.estimate.per_keyframe if search.estimate else ()):
            self._match(again, batch)
            again.first = first_pose(query, again.keyframes, again.matches, pose)
            if convinces(again.first, self.options.verdict):
                break
        found = self._settle(again) if again.keyframes else settled
        if again.estimate is None or found[2] is None:
            return search, *settled
        alike = alike_by_depth(best_of(search), best_of(again), self.cache.fallback_views)
        said = fallback_numbers(search.estimate, again.estimate, found[2], found[1].confidence, alike)
        search.fallback_numbers = again.fallback_numbers = said
        bounds, (_, _, evidence) = self.options.verdict.accepting(search.accept), settled
        judgement = weigh_fallback(
            search.estimate,
            evidence,
            again.estimate,
            found[2],
            alike,
            found[1],
            FallbackOptions(),
            bounds,
            search.accept,
        )
        reason = f"{again.estimate.inliers} keypoints of {fallback.name} agree, and with the map's own"
        if judgement is None:
            judgement = self._believe_alone(search, again, evidence, found[2], found[1])
            reason = f"{again.estimate.inliers} keypoints of {fallback.name} agree, where the map has few of its own"
        if judgement is None:
            return search, *settled
        return again, found[0], replace(judgement, reason=reason), found[2]

    def _believe_alone(
        self, search: Search, again: Search, evidence: Evidence | None, anew: Evidence, judgement: Judgement
    ) -> Judgement | None:
        """What a fallback says of plain things, on which the map's own feature has hardly a keypoint."""
        options, seen = FallbackOptions(), best_of(again)
        if seen is None:
            return None
        own = self.cache.views([seen[1].keyframe_id])
        if not own or len(own[0].view) >= options.plain:
            return None
        alike = alike_of(seen, self.cache.fallback_views)
        return weigh_alone(search.estimate, evidence, seen[2], anew, alike, judgement, options)

    def _tell_apart(
        self, search: Search, description: Description, judgement: Judgement, evidence: Evidence | None
    ) -> tuple[Judgement, Evidence | None]:
        """Where the place is in doubt, poses are told apart by what keyframes predict from them."""
        viewing, bounds = self.viewing, self.options.verdict.accepting(search.accept)
        if viewing is None or search.stage == Stage.GIVEN or search.fallback or search.blurred is not None:
            return judgement, evidence
        if self.options.learned is not None and search.alike is not None and judgement.verdict is Verdict.AMBIGUOUS:
            return judgement, evidence  # a learned feature was refused by what it should look like
        options = viewing.options.accepting(search.accept)
        viewing = replace(viewing, options=options)
        weak = evidence is not None and is_weak(evidence, options)
        doubted = weak if judgement.verdict is Verdict.LOCALIZED else judgement.verdict is Verdict.AMBIGUOUS
        query = viewing.of(description) if doubted and search.keyframes else None
        if query is None:
            return judgement, evidence
        matched = {keyframe.keyframe_id for keyframe in search.keyframes}
        kept = list(search.keyframes), list(search.matches), list(search.proposals)
        more = [proposal for proposal in search.following if proposal.keyframe_id not in matched][: options.more]
        search.proposals += more
        self._match(search, [proposal.keyframe_id for proposal in more])
        standing = viewing.standing(search, query, description)
        if standing is None or not standing.is_sure(options):
            search.keyframes, search.matches, search.proposals = kept
        if standing is None:
            return judgement, evidence
        search.view_numbers = view_numbers(standing)
        pose, own = standing.best.world_from_camera, False
        if search.estimate is not None:
            own = is_same(search.estimate.world_from_camera, pose, options.same)
        if standing.is_sure(options):
            search.seen = pose
            before = search.first, search.estimate
            search.first = first_pose_at(search.query, search.keyframes, search.matches, invert_pose(pose), search.pose)
            search.estimate = None
            self._ask_neighbours(search)
            self._estimate(search)
            found = search.estimate
            anew = None if found is None else evidence_of(search, found, 0)
            said = judge(anew, bounds)  # what was said of another pose is not said of this one
            if (
                found is None
                or said.verdict is Verdict.FAILED
                or not is_like(viewing.see(query, found.world_from_camera), options)
            ):
                search.first, search.estimate = before
            else:
                search.alike = search.alike if own else None  # that was of another pose
                own, search.seen, judgement, evidence = True, found.world_from_camera, said, anew
                search.others.clear()
        after = judge_seen(judgement, evidence, standing, own, options, bounds)
        if after.verdict is not judgement.verdict and after.verdict is Verdict.AMBIGUOUS and search.estimate:
            self._name_others(search, standing.against(search.estimate.world_from_camera, options))
        return after, evidence

    def _name_others(self, search: Search, poses: Sequence[FloatArray]) -> None:
        """Poses ``[4, 4]`` elsewhere that stand against the estimate, with the keypoints that vouch for each."""
        for pose in poses:
            count = support_of(pose, search.query, search.keyframes, search.matches, search.pose.inlier_px)
            search.others.append(ConsistentPose(pose, count))

    def _by_landmarks(self, search: Search, description: Description, judgement: Judgement) -> Judgement:
        """What landmarks make of an image whose keypoints failed; its confidence stays that of the keypoints."""
        if self.options.landmarks is None:
            return judgement
        started = time.perf_counter()
        found = landmark_pose(description, self.cache.landmarks(), self.options.landmarks)
        search.by_landmarks = found
        search.timing_ms["landmarks"] = _ms_since(started)
        if found is None:
            return judgement
        doubt = found.doubt(self.options.landmarks)
        if doubt:
            return Judgement(Verdict.FAILED, judgement.confidence, f"{judgement.reason}; {doubt}")
        reason = f"{judgement.reason}; {found.matched} landmarks agree, of {found.expected} in view"
        return Judgement(Verdict.COARSE, judgement.confidence, reason)

    def _ask_neighbours(self, search: Search) -> None:
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
            self._match(search, chosen)

    def _ask_frames(self, search: Search, convinced: bool) -> bool:
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
        search.timing_ms["match"] += _ms_since(started)
        return convinced or (bool(found) and convinces(search.first, of.verdict))

    def _estimate(self, search: Search) -> None:
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
        search.timing_ms["pose"] += _ms_since(started)

    def _ask_twins(self, search: Search) -> None:
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
            self._match(search, [proposal.keyframe_id for proposal in chosen])

    def _result(self, search: Search, judgement: Judgement, evidence: Evidence | None) -> Localization:
        coarse = search.by_landmarks if judgement.verdict is Verdict.COARSE else None
        estimate = search.estimate if judgement.verdict not in (Verdict.FAILED, Verdict.COARSE) else None
        pose = coarse if coarse is not None else estimate
        inliers = dict.fromkeys((keyframe.keyframe_id for keyframe in search.keyframes), 0)
        if estimate is not None:
            ids = [keyframe.keyframe_id for keyframe in search.keyframes]
            inliers.update(zip(ids, estimate.per_keyframe, strict=False))
        best = max((i for i in inliers if i > 0), key=lambda i: inliers[i]) if estimate is not None else None
        query_xy, keyframe_xy = best_pairs(search, estimate, best)
        return Localization(
            verdict=judgement.verdict,
            map_name=self.map_name,
            world_from_camera=None if pose is None else pose.world_from_camera,
            covariance=coarse.covariance if coarse is not None else self._covariance(estimate),
            confidence=judgement.confidence,
            inliers=0 if search.estimate is None else search.estimate.inliers,
            stage=search.stage,
            candidates=candidates_of(search, inliers, self.cache.name_of),
            ranked_share=search.ranked / search.keyframes_in_map,
            keyframes_matched=len(search.keyframes),
            reason=judgement.reason,
            timing_ms=search.timing_ms,
            evidence=numbers_of(search, evidence),
            refinements={"points": self.cache.points},
            others=tuple(sorted(search.others, key=lambda other: -other.inliers)) if estimate is not None else (),
            best_keyframe_id=best,
            query_xy=query_xy,
            keyframe_xy=keyframe_xy,
        )

    def _covariance(self, estimate: PoseEstimate | None) -> FloatArray | None:
        if estimate is None:
            return None
        return recorded_covariance(estimate) if self.options.recorded_errors else estimate.covariance


def _ms_since(started: float) -> float:
    return (time.perf_counter() - started) * 1000
