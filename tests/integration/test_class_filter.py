"""The class-attribute filter against the same sums in plain Python, and the same to the last bit on every server."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import select

from semdb.class_score import SCALE, ClassQuery, ClassTerm, class_term, strength_query, strengths
from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.records import ScoredKeyframe
from semdb.database.store import Store, open_store
from semdb.database.tables import categories, keyframe_categories
from semdb.errors import UsageError
from semdb.types import Sighting
from tests.database_samples import CATEGORIES, MODELS, description, fill, plan, record

SHOWN: tuple[list[str], ...] = (
    ["chair", "chair", "cup"],
    ["chair"],
    ["cup", "laptop"],
    [],
    ["cup"] * 5,
    ["person", "chair", "cup", "laptop", "tv"],
)


@pytest.fixture
def filled(store: Store) -> tuple[int, list[int]]:
    return _fill(store)


def _fill(store: Store) -> tuple[int, list[int]]:
    map_id = store.ensure_map("room")
    planned = store.plan_recording(map_id, plan("r", range(len(SHOWN))), MODELS)
    ids = [
        store.write_keyframe(planned.recording_id, record(i, description(i, shown, keypoints=3))).keyframe_id
        for i, shown in enumerate(SHOWN)
    ]
    fill(store, "another map", seed=77)  # never to be seen
    return map_id, ids


def _expected(counts: dict[str, float], ids: list[int]) -> list[ScoredKeyframe]:
    """The formula of the module's docstring in floating point."""
    total = len(SHOWN)

    def idf(name: str) -> float:
        return math.log((1 + total) / (1 + sum(name in shown for shown in SHOWN))) + 1

    whole = sum(idf(name) * wanted for name, wanted in counts.items())
    scored = []
    for key, shown in zip(ids, SHOWN, strict=True):
        have = Counter(shown)
        score = sum(idf(name) * min(wanted, have[name]) for name, wanted in counts.items()) / whole
        if score > 0:
            scored.append(ScoredKeyframe(key, score))
    return sorted(scored, key=lambda item: (-round(item.class_score, 5), item.keyframe_id))


@pytest.mark.parametrize(
    "counts",
    [
        {"chair": 1.0},
        {"chair": 2.0, "cup": 1.0},
        {"cup": 3.0, "laptop": 1.0, "zebra": 2.0},
        {"chair": 0.4, "cup": 2.5, "tv": 0.0},
        dict.fromkeys(CATEGORIES, 1.0),
    ],
)
def test_scores_are_those_of_the_formula(store: Store, filled: tuple[int, list[int]], counts: dict[str, float]) -> None:
    map_id, ids = filled
    expected = _expected(counts, ids)
    query = store.class_query(map_id, counts)
    scored = store.class_filter(map_id, query, 0.0)
    assert [item.keyframe_id for item in scored] == [item.keyframe_id for item in expected]
    np.testing.assert_allclose(
        [item.class_score for item in scored], [item.class_score for item in expected], atol=2e-6
    )
    half = store.class_filter(map_id, query, 0.5)
    assert half == [item for item in scored if item.class_score >= 0.5]
    for at_most in (1, 2, 100):
        assert store.class_filter(map_id, query, 0.0, at_most) == scored[:at_most]
    assert store.class_scores(map_id, query, [*ids, 10**9]) == {k.keyframe_id: k.class_score for k in scored}
    assert store.class_scores(map_id, query, ids[:2]).keys() <= set(ids[:2])


def _filter(store: Store, map_id: int, counts: dict[str, float], share: float) -> list[ScoredKeyframe]:
    return store.class_filter(map_id, store.class_query(map_id, counts), share)


def test_the_best_keyframe_has_everything(store: Store, filled: tuple[int, list[int]]) -> None:
    map_id, ids = filled
    (best,) = _filter(store, map_id, {"chair": 1, "cup": 1, "laptop": 1, "tv": 1}, 1.0)
    assert best == ScoredKeyframe(ids[5], 1.0)
    full = _filter(store, map_id, {"cup": 1}, 1.0)  # four equal scores, by id
    assert full == [ScoredKeyframe(ids[i], 1.0) for i in (0, 2, 4, 5)]
    assert _filter(store, map_id, {"cup": 4.7}, 1.0) == [ScoredKeyframe(ids[4], 1.0)]  # which shows five


def test_nothing_shared_is_nothing_found(store: Store, filled: tuple[int, list[int]]) -> None:
    map_id, _ = filled
    assert _filter(store, map_id, {}, 0.0) == []
    assert _filter(store, map_id, {"zebra": 3}, 0.0) == []
    assert _filter(store, map_id, {"potted plant": 1}, 0.0) == []
    assert _filter(store, store.ensure_map("empty"), {"chair": 1}, 0.0) == []
    assert _filter(store, map_id, {"chair": 1, "zebra": 9}, 0.5) == []
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(UsageError, match="count of the class 'chair'"):
            store.class_query(map_id, {"chair": bad})


def test_rare_classes_weigh_more(store: Store, filled: tuple[int, list[int]]) -> None:
    map_id, _ = filled
    query = store.class_query(map_id, {"chair": 1, "tv": 2, "zebra": 3, "cup": 0})
    chair, tv, zebra = query.terms
    assert [chair.category, tv.category, zebra.category] == ["chair", "tv", "zebra"]
    assert chair.per_object == round(SCALE * (math.log(7 / 4) + 1)) == chair.full
    assert tv.per_object == round(SCALE * (math.log(7 / 2) + 1))
    assert zebra.per_object == round(SCALE * (math.log(7) + 1))
    assert chair.per_object < tv.per_object < zebra.per_object
    assert query.total == chair.full + 2 * tv.per_object + 3 * zebra.per_object
    assert class_term("cup", 1.0, 0, 0).per_object == SCALE


def test_terms_may_be_given(store: Store, filled: tuple[int, list[int]]) -> None:
    """A class that stands for another one, with a total of its own."""
    map_id, ids = filled
    query = ClassQuery((ClassTerm("chair", 30, 45), ClassTerm("person", 7, 10), ClassTerm("zebra", 5, 5)), 100)
    found = store.class_filter(map_id, query, 0.0)
    assert found == [ScoredKeyframe(ids[0], 0.45), ScoredKeyframe(ids[5], 0.37), ScoredKeyframe(ids[1], 0.3)]
    assert store.class_filter(map_id, query, 0.37) == found[:2]
    for terms in ((ClassTerm("cup", 1, 1),) * 2, (ClassTerm("cup", 0, 1),), (ClassTerm("cup", 1, 2**31),)):
        with pytest.raises(UsageError):
            ClassQuery(terms, 1)


SIGHTS: tuple[
    list[tuple[str, float, float]], ...
] = (  # what detectors saw: class, score, height in the image; the weak ones are no objects
    [("chair", 0.9, 0.8), ("chair", 0.6, 0.5), ("cup", 0.3, 0.4)],
    [("chair", 0.95, 0.1)],
    [("cup", 0.8, 0.45), ("laptop", 0.7, 0.6), ("tv", 0.06, 0.6)],
    [],
    [("cup", 0.9, 0.4)] * 40,
    [("person", 0.2, 0.5), ("tv", 0.1, 0.2)],
)


def _sighted(store: Store, map_name: str = "room") -> tuple[int, list[int]]:
    map_id = store.ensure_map(map_name)
    planned = store.plan_recording(map_id, plan("r", range(len(SIGHTS))), MODELS)
    ids = []
    for index, sights in enumerate(SIGHTS):
        made = replace(description(index, [], keypoints=3), sightings=tuple(Sighting(*sight) for sight in sights))
        ids.append(store.write_keyframe(planned.recording_id, record(index, made)).keyframe_id)
    return map_id, ids


def _jaccard(seen: dict[str, tuple[int, int]], shown: dict[str, tuple[int, int]]) -> int:
    """The formula of the module's docstring, all classes as rare as one another, in millionths, rounded down."""
    weight = round(1000 * (math.log(1 + len(SIGHTS)) + 1))  # no class has an object in any keyframe
    pairs = [
        (a, b) for name in {*seen, *shown} for a, b in zip(seen.get(name, (0, 0)), shown.get(name, (0, 0)), strict=True)
    ]
    return int(Fraction(weight * sum(map(min, pairs)), max(1, weight * sum(map(max, pairs)))) * SCALE)


def test_strengths_are_sums_of_scores_by_half_of_the_image(store: Store) -> None:
    map_id, ids = _sighted(store)
    c = keyframe_categories.c
    query = select(c.keyframe_id, categories.c.name, c.count, c.upper_strength, c.lower_strength, c.keyframe_strength)
    query = query.join(categories).where(c.map_id == map_id).order_by(c.keyframe_id, categories.c.name)
    with store.engine.connect() as connection:
        rows = [tuple(row) for row in connection.execute(query)]
    assert rows == [
        (ids[0], "chair", 0, 5, 19, 28),  # 16 * .6 / 2 above, 16 * (.9 + .6 / 2) below, rounded
        (ids[0], "cup", 0, 3, 1, 28),
        (ids[1], "chair", 0, 15, 0, 15),
        (ids[2], "cup", 0, 8, 5, 25),
        (ids[2], "laptop", 0, 3, 8, 25),
        (ids[2], "tv", 0, 0, 1, 25),
        (ids[4], "cup", 0, 255, 173, 428),
        (ids[5], "person", 0, 2, 2, 6),
        (ids[5], "tv", 0, 2, 0, 6),
    ]


def test_an_upgrade_gives_strengths_to_the_objects_that_are_there(store: Store) -> None:
    fill(store, "room", frame_indexes=range(12))
    c = keyframe_categories.c
    query = select(c.keyframe_id, c.category_id, c.upper_strength, c.lower_strength, c.keyframe_strength)

    def rows() -> list[tuple[int, ...]]:
        with store.engine.connect() as connection:
            return sorted(tuple(row) for row in connection.execute(query))

    before = rows()
    assert len(before) > 12
    assert all(row[4] > 0 for row in before)
    schema.downgrade(store.engine, "0004")
    schema.upgrade(store.engine)
    assert rows() == before


def test_a_score_by_strengths_is_the_jaccard_index(store: Store) -> None:
    map_id, ids = _sighted(store)
    _sighted(store, "another map")
    for seen in (*SIGHTS, [("chair", 0.5, 0.7), ("zebra", 0.9, 0.5), ("cup", 1.0, 0.2)]):
        found = strengths(seen)
        query = strength_query(found, len(SIGHTS), store.document_frequencies(map_id, found))
        scored = store.class_filter(map_id, query, 0.0)
        expected = {key: _jaccard(found, strengths(shown)) for key, shown in zip(ids, SIGHTS, strict=True)}
        order = sorted((-points, key) for key, points in expected.items() if points)
        assert [(-round(k.class_score * SCALE), k.keyframe_id) for k in scored] == order
        assert store.class_filter(map_id, query, 0.2) == [k for k in scored if k.class_score >= 0.2]
        assert store.class_filter(map_id, query, 0.0, 2) == scored[:2]
        assert store.class_scores(map_id, query, ids) == {k.keyframe_id: k.class_score for k in scored}


@given(st.lists(st.tuples(st.sampled_from(CATEGORIES), st.floats(0, 1), st.floats(-0.1, 1.1)), max_size=30))
def test_strengths_do_not_depend_on_the_order_of_detections(found: list[tuple[str, float, float]]) -> None:
    expected = strengths(found)
    assert strengths(reversed(found)) == expected
    assert all(0 <= value <= 255 for pair in expected.values() for value in pair)
    total = sum(16 * score for _, score, _ in found)
    if all(value < 255 for pair in expected.values() for value in pair):
        assert abs(sum(sum(pair) for pair in expected.values()) - total) <= 2 * len(CATEGORIES)


def test_what_a_class_is_taken_for_is_asked_for_too(store: Store) -> None:
    map_id, ids = _sighted(store)
    query = strength_query({"bench": (0, 20)}, len(SIGHTS), {}, {"chair": (4, 16), "bench": (0, 3)})
    assert {term.word: term.full // term.per_object for term in query.terms} == {
        "bench\nlower": 20,
        "chair\nupper": 4,
        "chair\nlower": 16,
    }
    assert [k.keyframe_id for k in store.class_filter(map_id, query, 0.0)] == [ids[0], ids[1]]


def test_a_query_that_sees_nothing_finds_nothing(store: Store) -> None:
    map_id, _ = _sighted(store)
    assert strength_query({}, 6, {}).terms == ()
    assert store.class_filter(map_id, strength_query({"cup": (0, 0)}, 6, {}), 0.0) == []
    with pytest.raises(UsageError, match="not more than its total"):
        ClassQuery((ClassTerm("cup", 10, 20),), 19, per_held=1)


def test_scores_are_equal_to_the_last_bit_on_both_servers(tmp_path: Path, server_url: str) -> None:
    rng = np.random.default_rng(3)
    queries = [
        {str(name): float(count) for name, count in zip(CATEGORIES, rng.uniform(0, 3, 6).round(2), strict=True)}
        for _ in range(20)
    ]
    answers = []
    for url in (f"sqlite:///{tmp_path / 'a.sqlite3'}", server_url):
        engine = make_engine(url)
        schema.upgrade(engine)
        engine.dispose()
        with open_store(url) as store:
            map_id, _ = _fill(store)
            fill(store, "room", "more", range(30), seed=200)
            answers.append([_filter(store, map_id, query, 0.3) for query in queries])
    assert answers[0] == answers[1]
    assert sum(map(len, answers[0])) == 146
