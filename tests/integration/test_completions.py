"""Classes that landmarks complete: in SQL and in memory the same, used while the map is as it was, and then no more."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import select, text

from semdb.class_score import strength_query
from semdb.database.completions import STEP, replace_completions
from semdb.database.landmark_records import CompletedClass
from semdb.database.moving import move
from semdb.database.pose_records import Move, MovedRecording, OperationKind
from semdb.database.records import ScoredKeyframe
from semdb.database.refinements import forget
from semdb.database.store import Store, open_store
from semdb.database.tables import categories, completed_categories
from semdb.localization.index import IndexSource, MapIndex
from semdb.localization.sources import SqlSource
from tests.database_samples import MODELS, description, fill, plan, record
from tests.integration.test_index import assert_same
from tests.integration.test_landmarks import ingest, refine

QUERY = {"chair": (20, 9), "cup": (0, 31)}


def complete(store: Store, map_id: int, completed: Sequence[CompletedClass], state: str | None = None) -> None:
    """As the step `landmarks` does it, computed of what the map is, or was."""
    with store.engine.connect() as connection:
        known = {str(name): int(key) for name, key in connection.execute(select(categories.c.name, categories.c.id))}

    def write(connection: object, of_map: int, found: Sequence[CompletedClass]) -> int:
        replace_completions(connection, of_map, found, known)  # type: ignore[arg-type]
        return 0

    store.replace_refinement(map_id, STEP, state or store.map_state(map_id), {}, write, completed)


def rows(store: Store) -> list[tuple[int, ...]]:
    c = completed_categories.c
    columns = (c.keyframe_id, c.count, c.upper_strength, c.lower_strength, c.keyframe_strength)
    with store.engine.connect() as connection:
        return sorted(tuple(map(int, row)) for row in connection.execute(select(*columns)))


def asked(store: Store, map_id: int, completed: bool | None = None) -> list[ScoredKeyframe]:
    """The filter's answer, as whoever asks anew gets it."""
    query = strength_query(QUERY, store.keyframe_count(map_id), store.document_frequencies(map_id, list(QUERY)))
    use = store.completion_of(map_id) is not None if completed is None else completed
    return store.class_filter(map_id, query, 0.0, completed=use)


@pytest.fixture
def filled(store: Store) -> tuple[int, list[int]]:
    map_id = store.ensure_map("room")
    planned = store.plan_recording(map_id, plan("r", range(5)), MODELS)
    shown = (["chair", "cup"], ["chair"], ["laptop"], [], ["cup", "cup"])
    made = [record(i, description(i, names, keypoints=3)) for i, names in enumerate(shown)]
    ids = [store.write_keyframe(planned.recording_id, one).keyframe_id for one in made]
    fill(store, "another map", seed=77)
    return map_id, ids


def test_what_a_map_had_of_a_keyframe_that_was_moved_is_not_what_its_new_map_has(tmp_path: Path) -> None:
    with open_store(f"sqlite:///{tmp_path}/m.sqlite3", create=True) as store:
        old, new = store.ensure_map("own"), store.ensure_map("room")
        recording = store.plan_recording(old, plan("r", range(2)), MODELS).recording_id
        made = [record(i, description(i, ["chair", "cup"][: i + 1], keypoints=3)) for i in range(2)]
        ids = [store.write_keyframe(recording, one).keyframe_id for one in made]
        found = [CompletedClass(ids[0], "cup", 0, 40)]
        complete(store, old, found)
        poses = dict(zip(*store.poses(old), strict=True))
        moved = MovedRecording(recording, old, "moved", np.eye(4))
        move(store.engine, Move(OperationKind.ALIGN, new, poses, poses, (moved,)))
        complete(store, new, found)
        both = rows(store)
        complete(store, old, [])  # which has no keyframes any more
        assert (len(both), rows(store)) == (8, sorted(set(both)))
        assert store.completion_of(new) == store.map_state(new)


def test_what_is_missed_counts_until_the_map_changes(store: Store, filled: tuple[int, list[int]]) -> None:
    map_id, ids = filled
    before = asked(store, map_id)
    sql, index = SqlSource(store, map_id), MapIndex.open(store, map_id)
    memory = IndexSource(index)
    assert_same(memory, sql, 1, 2)
    assert (store.completion_of(map_id), rows(store)) == (None, [])
    complete(store, map_id, [CompletedClass(ids[2], "cup", 0, 40), CompletedClass(ids[1], "chair", 1, 1)])
    assert store.completion_of(map_id) == store.map_state(map_id)
    completed = asked(store, map_id)
    assert {item.keyframe_id for item in completed} == {*(item.keyframe_id for item in before), ids[2]}
    kept = {item.keyframe_id: item.class_score for item in before}
    assert {item.keyframe_id: item.class_score for item in completed if item.keyframe_id != ids[2]} == kept
    found = rows(store)
    assert next(row for row in found if row[0] == ids[2])[1:4] == (0, 0, 40)
    assert all(row[0] in ids for row in found)
    # who had the map open sees it by the log; so does one that opens it now
    assert (bool(sql.refresh()), memory.refresh().gone) == (True, frozenset({ids[2]}))
    fresh = MapIndex.open(store, map_id)
    for source in (memory, IndexSource(fresh)):
        assert_same(source, sql, 2, 3)
        query = strength_query(QUERY, 5, store.document_frequencies(map_id, list(QUERY)))
        assert ids[2] in source.filtered(query, 0.0, None).keyframe_ids
    # forgotten, and computed again: so does who opened the map in between
    forget(store.engine, map_id, STEP)
    between = SqlSource(store, map_id), IndexSource(MapIndex.open(store, map_id))
    for source in between:
        source.refresh()
    complete(store, map_id, [CompletedClass(ids[2], "cup", 0, 40)])
    for source in (*between, sql, memory):
        source.refresh()
        assert ids[2] in source.filtered(query, 0.0, None).keyframe_ids
    assert_same(between[1], between[0], 2, 3)
    # a keyframe more, and all is as it was seen
    planned = store.plan_recording(map_id, plan("more", [0]), MODELS)
    late = store.write_keyframe(planned.recording_id, record(0, description(9, ["laptop"], keypoints=3))).keyframe_id
    assert store.completion_of(map_id) is None
    for source in (sql, memory):
        source.refresh()
    assert_same(memory, sql, 3, 3)
    assert asked(store, map_id) == asked(store, map_id, completed=False)
    # without it the map is what it was; ids are another state all the same
    store.delete_keyframes([late])
    for source in (sql, memory):
        source.refresh()
    assert_same(memory, sql, 4, 2)
    assert [item.keyframe_id for item in asked(store, map_id)] == [
        item.keyframe_id for item in (before if store.completion_of(map_id) is None else completed)
    ]
    complete(store, map_id, [CompletedClass(ids[2], "cup", 0, 40), CompletedClass(ids[3], "zebra crossing", 9, 9)][:1])
    forget(store.engine, map_id, STEP)
    assert store.completion_of(map_id) is None
    complete(store, map_id, [])
    assert (store.completion_of(map_id), rows(store)) == (None, [])
    complete(store, map_id, [CompletedClass(ids[2], "cup", 0, 40)])
    store.delete_map(map_id)
    assert rows(store) == []


def test_what_was_computed_of_another_state_completes_nothing(store: Store, filled: tuple[int, list[int]]) -> None:
    map_id, ids = filled
    state = store.map_state(map_id)
    move = "UPDATE keyframes SET tx = tx + :by WHERE id = :key"

    def moved(by: float) -> None:
        with store.engine.begin() as connection:
            connection.execute(text(move), {"by": by, "key": ids[0]})

    moved(1.0)
    complete(store, map_id, [CompletedClass(ids[2], "cup", 0, 40)], state)
    moved(-1.0)
    assert (store.map_state(map_id), store.completion_of(map_id), rows(store)) == (state, None, [])


def test_an_index_whose_log_was_cut_off_forgets_what_was_completed(store: Store, filled: tuple[int, list[int]]) -> None:
    map_id, ids = filled
    complete(store, map_id, [CompletedClass(ids[2], "cup", 0, 40)])
    memory = IndexSource(MapIndex.open(store, map_id))
    query = strength_query(QUERY, 5, store.document_frequencies(map_id, list(QUERY)))
    assert ids[2] in memory.filtered(query, 0.0, None).keyframe_ids
    with store.engine.begin() as connection:
        connection.execute(text("DELETE FROM keyframe_changes"))
        connection.execute(text("UPDATE keyframes SET tx = tx + 1 WHERE id = :key"), {"key": ids[0]})
    memory.refresh()
    assert store.completion_of(map_id) is None
    assert ids[2] not in memory.filtered(query, 0.0, None).keyframe_ids
    assert_same(memory, SqlSource(store, map_id), 5, 3)


def test_the_step_completes_what_the_detector_missed(store: Store) -> None:
    info = ingest(store, range(6), spoiled=True)
    refine(store, info)
    (missed,) = {
        tuple(row)
        for row in _table(
            store,
            "SELECT k.frame_index, c.name FROM completed_categories b JOIN keyframes k ON k.id = b.keyframe_id "
            "JOIN categories c ON c.id = b.category_id LEFT JOIN keyframe_categories s ON s.keyframe_id = "
            "b.keyframe_id AND s.category_id = b.category_id WHERE COALESCE(s.upper_strength, 0) + "
            "COALESCE(s.lower_strength, 0) < b.upper_strength + b.lower_strength",
        )
    }
    assert missed == (2, "couch")
    names = _table(store, "SELECT DISTINCT keyframe_strength FROM completed_categories")
    assert len(names) > 1
    assert store.completion_of(info.id) == store.map_state(info.id)
    exact = ingest(store, range(6), "exact")
    refine(store, exact)
    assert store.completion_of(exact.id) is None  # nothing was missed: answers are what they were


def _table(store: Store, query: str) -> list[tuple[object, ...]]:
    with store.engine.connect() as connection:
        return [tuple(row) for row in connection.execute(text(query))]


STEPS = st.lists(st.tuples(st.sampled_from("aadccccf"), st.integers(0, 10**6)), min_size=3, max_size=10)


@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(steps=STEPS)
def test_index_and_sql_agree_whatever_happens(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]]
) -> None:
    path: Path = tmp_path_factory.mktemp("steps")
    with open_store(f"sqlite:///{path}/semdb.sqlite3", create=True) as store:
        map_id, _, ids = fill(store, "room", frame_indexes=range(4))
        sql, index = SqlSource(store, map_id), MapIndex.open(store, map_id, path)
        memory = IndexSource(index)
        for step, seed in steps:
            random = np.random.default_rng(seed)
            if step == "a":
                planned = store.plan_recording(map_id, plan(f"v{seed}", [0]), MODELS)
                ids.append(store.write_keyframe(planned.recording_id, record(0, description(seed))).keyframe_id)
            elif step == "d" and len(ids) > 1:
                store.delete_keyframes([ids.pop(int(random.integers(len(ids))))])
            elif step == "f":
                forget(store.engine, map_id, STEP)
            elif step == "c":
                names = ["chair", "cup", "laptop", "tv"]
                found = [
                    CompletedClass(int(key), str(random.choice(names)), *random.integers(0, 90, 2).tolist())
                    for key in random.choice(ids, min(3, len(ids)), replace=False)
                ]
                complete(store, map_id, found)
            sql.refresh()
            memory.refresh()
            if step != "f":  # what is forgotten is noticed with the next change
                assert_same(memory, sql, seed, 2)
        index.close()
        with MapIndex.open(store, map_id, path) as again:
            assert_same(IndexSource(again), SqlSource(store, map_id), 5, 2)
