"""The cascade: which keyframes come in which order, and never twice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semdb.localization.coarse import Batch, CoarseOptions, Stage, cascade, rank_by_score
from semdb.types import Float32Array


class FakeSource:
    """Scores and vectors as given; counts which vectors were asked for."""

    def __init__(self, scores: Mapping[int, float], vectors: Mapping[int, Sequence[float]]) -> None:
        self._scores = scores
        self._vectors = vectors
        self.asked: list[int] = []

    def refresh(self) -> bool:
        return False

    def keyframe_ids(self) -> Sequence[int]:
        return sorted(self._vectors)

    def class_scores(self, counts: Mapping[str, float]) -> dict[int, float]:
        return dict(self._scores)

    def filtered(self, counts: Mapping[str, float], minimum_share: float) -> dict[int, float]:
        return {i: score for i, score in self._scores.items() if score >= minimum_share}

    def vectors(self, keyframe_ids: Sequence[int]) -> Float32Array:
        self.asked += keyframe_ids
        return np.array([self._vectors[i] for i in keyframe_ids], np.float32)


def unit(degrees: float) -> list[float]:
    return [float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))]


QUERY = np.array([1.0, 0.0], np.float32)
# keyframe 1 looks like the query but shares no object, 2 and 3 share them, 4 shares a few
SOURCE_SCORES = {2: 0.9, 3: 0.6, 4: 0.3}
SOURCE_VECTORS = {1: unit(1), 2: unit(40), 3: unit(20), 4: unit(10), 5: unit(80)}


def run(options: CoarseOptions, counts: Mapping[str, float] | None = None) -> tuple[list[Batch], FakeSource]:
    source = FakeSource(SOURCE_SCORES, SOURCE_VECTORS)
    return list(cascade(source, {"cup": 1.0} if counts is None else counts, QUERY, options)), source


def order(batches: Sequence[Batch]) -> list[tuple[str, list[int]]]:
    return [(batch.stage, [proposal.keyframe_id for proposal in batch.proposals]) for batch in batches]


def test_filtered_keyframes_first_then_soft_then_all() -> None:
    batches, _ = run(CoarseOptions(class_weight=0.15, filtered_batches=(1, 2), soft_batches=(1,), all_batches=(9,)))
    assert order(batches) == [
        (Stage.FILTERED, [3]),  # of those that share half, the better cosine
        (Stage.FILTERED, [2]),
        (Stage.SOFT, [4]),  # cos 10 deg + .15 * .3 beats cos 1 deg
        (Stage.ALL, [1, 5]),
    ]
    assert [batch.ranked for batch in batches] == [2, 2, 5, 5]


def test_the_filtered_stage_ranks_only_what_passed() -> None:
    source = FakeSource(SOURCE_SCORES, SOURCE_VECTORS)
    first = next(iter(cascade(source, {"cup": 1.0}, QUERY, CoarseOptions())))
    assert source.asked == [2, 3]
    assert first.proposals[0].class_score == 0.6
    assert abs(first.proposals[0].cosine - np.cos(np.radians(20))) < 1e-6


def test_without_classes_all_by_cosine_with_the_same_budget() -> None:
    batches, _ = run(CoarseOptions(use_classes=False, filtered_batches=(1, 2), soft_batches=(1,), all_batches=(1,)))
    assert order(batches) == [(Stage.ALL, [1]), (Stage.ALL, [4, 3]), (Stage.ALL, [2]), (Stage.ALL, [5])]


def test_a_query_without_objects_is_not_lost() -> None:
    batches, _ = run(CoarseOptions(), counts={})
    assert batches[0].stage == Stage.ALL
    assert batches[0].proposals[0].keyframe_id == 1


def test_the_paper_stops_after_the_filter() -> None:
    batches, source = run(CoarseOptions(cascade=False, filtered_batches=(1,)))
    assert order(batches) == [(Stage.FILTERED, [3])]
    assert set(source.asked) == {2, 3}


def test_the_paper_looks_at_nothing_without_objects() -> None:
    assert run(CoarseOptions(cascade=False, filtered_batches=(1,)), counts={})[0] == []


def test_nothing_passes_the_filter() -> None:
    source = FakeSource({}, SOURCE_VECTORS)
    batches = list(cascade(source, {"zebra": 1.0}, QUERY, CoarseOptions()))
    assert batches[0].stage == Stage.SOFT
    assert batches[0].proposals[0].keyframe_id == 1


@given(scores=st.lists(st.floats(-1, 1), max_size=12), seed=st.integers(0, 99))
def test_rank_is_by_falling_score_then_by_id(scores: list[float], seed: int) -> None:
    ids = np.random.default_rng(seed).permutation(len(scores)).tolist()
    ranked = rank_by_score(ids, np.array(scores))
    keys = [(-scores[p], ids[p]) for p in ranked]
    assert keys == sorted(keys)


@given(
    scores=st.dictionaries(st.integers(0, 20), st.floats(0.01, 1), max_size=15),
    angles=st.lists(st.floats(0, 90), min_size=21, max_size=21),
)
def test_every_keyframe_comes_at_most_once(scores: dict[int, float], angles: list[float]) -> None:
    source = FakeSource(scores, {i: unit(angle) for i, angle in enumerate(angles)})
    options = CoarseOptions(filtered_batches=(2, 3), soft_batches=(4,), all_batches=(50,))
    proposed = [p.keyframe_id for batch in cascade(source, {"cup": 1.0}, QUERY, options) for p in batch.proposals]
    assert sorted(proposed) == list(range(21))
    assert len(source.asked) == len(set(source.asked))
