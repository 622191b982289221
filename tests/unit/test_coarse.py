"""The cascade: which keyframes come in which order, and never twice."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.class_score import ClassQuery
from semdb.localization.coarse import (
    Batch,
    CoarseOptions,
    MapChange,
    QueryClasses,
    Ranked,
    Scored,
    Scoring,
    Stage,
    cascade,
    query_classes,
    retrieve,
)
from semdb.localization.ranking import best_first, exact_cosines
from semdb.types import Float32Array, FloatArray, Int64Array


class FakeSource:
    """Class scores and vectors as given; keeps which cosines were asked for."""

    def __init__(self, scores: Mapping[int, float], vectors: Mapping[int, Sequence[float]]) -> None:
        self._ids = np.array(sorted(vectors), np.int64)
        self._scores = np.array([scores.get(int(i), 0.0) for i in self._ids])
        self._vectors = np.array([vectors[int(i)] for i in self._ids], np.float32).reshape(len(self._ids), 2)
        self.asked: list[int] = []
        self.at_most: list[int | None] = []

    def refresh(self) -> MapChange:
        return MapChange()

    def keyframe_count(self) -> int:
        return len(self._ids)

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        return {}

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        self.at_most.append(at_most)
        passed = (self._scores > 0) & (self._scores >= minimum_share)
        order = best_first(self._ids, np.where(passed, self._scores, np.nan), at_most)
        return Scored(self._ids[order], self._scores[order])

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        self.asked += keyframe_ids.tolist()
        return exact_cosines(self._vectors, np.searchsorted(self._ids, keyframe_ids), vector)

    def nearest(self, vector: Float32Array, count: int, query: ClassQuery | None, class_weight: float) -> Ranked:
        cosines = exact_cosines(self._vectors, np.arange(len(self._ids)), vector)
        scores = self._scores if query is not None else np.zeros(len(self._ids))
        order = best_first(self._ids, cosines + class_weight * scores, count)
        return Ranked(self._ids[order], scores[order], cosines[order])


def unit(degrees: float) -> list[float]:
    return [float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))]


QUERY = np.array([1.0, 0.0], np.float32)
# keyframe 1 looks like the query but shares no object, 2 and 3 share them, 4 shares a few
SOURCE_SCORES = {2: 0.9, 3: 0.6, 4: 0.3}
SOURCE_VECTORS = {1: unit(1), 2: unit(40), 3: unit(20), 4: unit(10), 5: unit(80)}


HALF = CoarseOptions(minimum_share=0.5, filtered_share=1.0, class_weight=0.15)
CUP = QueryClasses({"cup": 1.0}, {"cup": (10, 6)})
NOTHING = QueryClasses({}, {})


def run(options: CoarseOptions, classes: QueryClasses = CUP) -> tuple[list[Batch], FakeSource]:
    source = FakeSource(SOURCE_SCORES, SOURCE_VECTORS)
    return list(cascade(source, classes, QUERY, options)), source


def order(batches: Sequence[Batch]) -> list[tuple[str, list[int]]]:
    return [(batch.stage, [proposal.keyframe_id for proposal in batch.proposals]) for batch in batches]


def test_filtered_keyframes_first_then_soft_then_all() -> None:
    batches, _ = run(replace(HALF, filtered_batches=(1, 2), soft_batches=(1,), all_batches=(9,)))
    assert order(batches) == [
        (Stage.FILTERED, [3]),  # of those that share half, the better cosine
        (Stage.FILTERED, [2]),
        (Stage.SOFT, [4]),  # cos 10 deg + .15 * .3 beats cos 1 deg
        (Stage.ALL, [1, 5]),
    ]
    assert [batch.ranked for batch in batches] == [2, 2, 5, 5]


def test_the_filtered_stage_ranks_only_what_passed() -> None:
    source = FakeSource(SOURCE_SCORES, SOURCE_VECTORS)
    first = next(iter(cascade(source, CUP, QUERY, HALF)))
    assert sorted(source.asked) == [2, 3]
    assert first.proposals[0].class_score == 0.6
    assert abs(first.proposals[0].cosine - np.cos(np.radians(20))) < 1e-6


def test_without_classes_all_by_cosine_with_the_same_budget() -> None:
    batches, _ = run(CoarseOptions(use_classes=False, filtered_batches=(1, 2), soft_batches=(1,), all_batches=(1,)))
    assert order(batches) == [(Stage.ALL, [1]), (Stage.ALL, [4, 3]), (Stage.ALL, [2]), (Stage.ALL, [5])]


def test_a_query_without_objects_is_not_lost() -> None:
    batches, _ = run(HALF, NOTHING)
    assert batches[0].stage == Stage.ALL
    assert batches[0].proposals[0].keyframe_id == 1


def test_the_paper_stops_after_the_filter() -> None:
    batches, source = run(replace(HALF, cascade=False, filtered_batches=(1,)))
    assert order(batches) == [(Stage.FILTERED, [3])]
    assert set(source.asked) == {2, 3}


def test_the_paper_looks_at_nothing_without_objects() -> None:
    assert run(replace(HALF, cascade=False, filtered_batches=(1,)), NOTHING)[0] == []


def test_nothing_passes_the_filter() -> None:
    source = FakeSource({}, SOURCE_VECTORS)
    batches = list(cascade(source, QueryClasses({}, {"zebra": (1, 0)}), QUERY, HALF))
    assert batches[0].stage == Stage.SOFT
    assert batches[0].proposals[0].keyframe_id == 1


def test_the_filter_gives_the_best_by_class_score_and_they_are_ranked_by_cosine() -> None:
    source = FakeSource(SOURCE_SCORES, SOURCE_VECTORS)
    options = CoarseOptions(minimum_share=0.1, filtered_share=1.0, filtered_at_most=2, filtered_batches=(9,))
    first = next(iter(cascade(source, CUP, QUERY, options)))
    assert source.at_most == [2]
    assert [proposal.keyframe_id for proposal in first.proposals] == [3, 2]
    assert first.ranked == 2


def test_a_share_of_the_map_passes_the_filter() -> None:
    options = CoarseOptions(filtered_share=0.15, filtered_at_least=8, filtered_at_most=1000)
    assert [options.passing(n) for n in (1, 12, 20, 25, 53, 54, 1000, 10**6)] == [1, 4, 7, 8, 8, 9, 150, 1000]
    assert replace(options, filtered_share=1.0, filtered_at_most=10**9).passing(10**6) == 10**6
    _, source = run(options)
    assert source.at_most == [2]


def test_by_counts_what_is_seen_weakly_is_not_asked_for() -> None:
    weak = QueryClasses({}, {"cup": (0, 2)})
    assert run(HALF, weak)[0][0].stage == Stage.FILTERED
    assert run(replace(HALF, scoring=Scoring.COUNTS), weak)[0][0].stage == Stage.ALL


def test_the_ranking_alone_goes_through_the_stages() -> None:
    source = FakeSource(SOURCE_SCORES, SOURCE_VECTORS)
    first = [retrieve(source, CUP, QUERY, count, HALF) for count in (0, 1, 3, 9)]
    assert [[p.keyframe_id for p in found] for found in first] == [[], [3], [3, 2, 4], [3, 2, 4, 1, 5]]
    hard = retrieve(source, CUP, QUERY, 9, replace(HALF, cascade=False))
    assert [p.keyframe_id for p in hard] == [3, 2]


def test_classes_stand_for_those_they_are_taken_for() -> None:
    confusions = {"couch": {"bed": 500_000, "bench": 1}}
    made = query_classes({"couch": 1.0}, {"couch": (4, 12), "bed": (0, 5)}, confusions, CoarseOptions(confusion=1.0))
    assert made.stands_for == {"bed": (2, 6)}
    assert made.shown(Scoring.STRENGTHS) == ["bed", "couch"]
    assert made.shown(Scoring.COUNTS) == ["couch"]
    assert query_classes({}, {"couch": (4, 12)}, confusions, CoarseOptions(confusion=0.0)).stands_for == {}


def test_a_keyframe_that_was_deleted_meanwhile_is_left_out() -> None:
    class Late(FakeSource):
        def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
            cosines = super().cosines(vector, keyframe_ids)
            return np.where(keyframe_ids == 3, np.nan, cosines)

    first = next(iter(cascade(Late(SOURCE_SCORES, SOURCE_VECTORS), CUP, QUERY, HALF)))
    assert [proposal.keyframe_id for proposal in first.proposals] == [2]


def test_what_follows_a_batch_is_named() -> None:
    batches, _ = run(CoarseOptions(use_classes=False, filtered_batches=(1,), soft_batches=(), all_batches=(1,)))
    assert [[p.keyframe_id for p in batch.following] for batch in batches] == [[4, 3, 2, 5], [3, 2, 5]]


@given(scores=st.lists(st.floats(-1, 1), max_size=12), count=st.integers(0, 14), seed=st.integers(0, 99))
def test_best_first_is_by_falling_score_then_by_id(scores: list[float], count: int, seed: int) -> None:
    ids = np.random.default_rng(seed).permutation(len(scores)).astype(np.int64)
    keys = sorted((-score, int(i)) for score, i in zip(scores, ids, strict=True))
    assert [(-scores[p], int(ids[p])) for p in best_first(ids, np.array(scores), count)] == keys[:count]
    assert [(-scores[p], int(ids[p])) for p in best_first(ids, np.array(scores))] == keys


@settings(deadline=None)  # the kernel is compiled at the first call
@given(size=st.integers(0, 40), rows=st.lists(st.integers(0, 8), max_size=9), seed=st.integers(0, 99))
def test_a_cosine_does_not_depend_on_what_else_is_asked(size: int, rows: list[int], seed: int) -> None:
    random = np.random.default_rng(seed)
    vectors = random.normal(size=(9, size)).astype(np.float32)
    query = random.normal(size=size).astype(np.float32)
    together = exact_cosines(vectors, np.array(rows, np.int64), query)
    alone = [exact_cosines(vectors[row : row + 1], np.zeros(1, np.int64), query)[0] for row in rows]
    assert together.tolist() == alone
    np.testing.assert_allclose(together, vectors[rows].astype(np.float64) @ query.astype(np.float64), atol=1e-12)


@settings(deadline=None)
@given(
    scores=st.dictionaries(st.integers(0, 20), st.floats(0.01, 1), max_size=15),
    angles=st.lists(st.floats(0, 90), min_size=21, max_size=21),
)
def test_every_keyframe_comes_at_most_once(scores: dict[int, float], angles: list[float]) -> None:
    source = FakeSource(scores, {i: unit(angle) for i, angle in enumerate(angles)})
    options = CoarseOptions(filtered_batches=(2, 3), soft_batches=(4,), all_batches=(50,))
    proposed = [p.keyframe_id for batch in cascade(source, CUP, QUERY, options) for p in batch.proposals]
    assert sorted(proposed) == list(range(21))
    assert len(source.asked) == len(set(source.asked))
