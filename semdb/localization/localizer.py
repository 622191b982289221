"""Where the algorithms meet the database: a description in, a typed localization out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

from semdb.class_score import strengths
from semdb.database.planning import check_models
from semdb.errors import NotFoundError
from semdb.localization.alike import alike_of, weigh_learned
from semdb.localization.coarse import (
    Batch,
    CoarseSource,
    Proposal,
    QueryClasses,
    Stage,
    cascade,
    query_classes,
    retrieve,
)
from semdb.localization.confidence import Evidence
from semdb.localization.depth_step import only_unsure, weigh_unsure
from semdb.localization.fallback_step import ask_fallback
from semdb.localization.fine_step import FineStep, ms_since
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.localization.landmark_step import landmark_pose
from semdb.localization.laying import Laying, with_laid
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.pose import PoseEstimate, recorded_covariance
from semdb.localization.search import Search, best_of, best_pairs, candidates_of, numbers_of
from semdb.localization.sources import TimedSource
from semdb.localization.telling_apart import tell_apart
from semdb.localization.verdict import Judgement, convinces
from semdb.localization.viewing import Viewing
from semdb.localization.views import View, make_view
from semdb.perception.quality import complaint_of, image_quality
from semdb.types import Description, FloatArray, Localization, ModelInfo, Tolerance, Verdict


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
        self.fine = FineStep(cache, self.models, of)
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
            search.timing_ms["rank"] += ms_since(started)
            self.fine.ask(search, batch)
            if convinces(search.first, self.options.verdict):
                break
            started = time.perf_counter()
        else:
            self.fine.blur_alike(search, description)
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
        self.fine.ask(search, Batch(Stage.GIVEN, proposals, 0))
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

    def _conclude(self, search: Search, description: Description) -> Localization:
        damaged = [p.keyframe_id for p in search.proposals if p.keyframe_id in self.cache.left_out]
        if damaged and not search.keyframes:
            raise self.cache.left_out[damaged[0]]
        settled = self.fine.settle(search)
        settled = replace(settled, judgement=self._look(search, settled.judgement, settled.evidence))
        if settled.judgement.verdict is not Verdict.LOCALIZED and self.cache.fallback is not None:
            search, settled = ask_fallback(self.fine, search, self.cache.fallback, description, settled)
        convinced, judgement, evidence = settled.convinced, settled.judgement, settled.evidence
        started, counted = time.perf_counter(), search.timing_ms["match"] + search.timing_ms["pose"]
        if self.viewing is not None:
            judgement, evidence = tell_apart(self.fine, self.viewing, search, description, judgement, evidence)
        if not (convinced or search.seen is not None) or judgement.verdict is not Verdict.LOCALIZED:
            for laid, options in self.laying.poses(search, description):
                judgement, evidence = with_laid(search, laid, options, convinced, judgement, evidence)
                if laid.is_sure:
                    break
        counted -= search.timing_ms["match"] + search.timing_ms["pose"]  # what was counted meanwhile counts once
        search.timing_ms["pose"] += ms_since(started) + counted
        if judgement.verdict is Verdict.FAILED and search.stage != Stage.GIVEN:
            judgement = self._by_landmarks(search, description, judgement)
        if judgement.verdict is not Verdict.LOCALIZED and description.grey is not None:
            wrong = complaint_of(image_quality(description.grey, description.stretch))
            judgement = replace(judgement, reason="; ".join(filter(None, (judgement.reason, wrong))))
        return self._result(search, judgement, evidence)

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
        search.timing_ms["pose"] += ms_since(started)
        if learned is not None and asked:
            return weigh_learned(judgement, evidence, search.alike, learned)
        return judgement if unsure is None else weigh_unsure(search.alike, evidence, judgement, bounds, unsure)

    def _by_landmarks(self, search: Search, description: Description, judgement: Judgement) -> Judgement:
        """What landmarks make of an image whose keypoints failed; its confidence stays that of the keypoints."""
        if self.options.landmarks is None:
            return judgement
        started = time.perf_counter()
        found = landmark_pose(description, self.cache.landmarks(), self.options.landmarks)
        search.by_landmarks = found
        search.timing_ms["landmarks"] = ms_since(started)
        if found is None:
            return judgement
        doubt = found.doubt(self.options.landmarks)
        if doubt:
            return Judgement(Verdict.FAILED, judgement.confidence, f"{judgement.reason}; {doubt}")
        reason = f"{judgement.reason}; {found.matched} landmarks agree, of {found.expected} in view"
        return Judgement(Verdict.COARSE, judgement.confidence, reason)

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
