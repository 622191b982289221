"""The index against SQL, the reference, while the map changes; on both servers, exact and reduced."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import insert, select, update

from semdb.class_score import class_query, strength_query
from semdb.database import retry
from semdb.database.codecs import encode_array
from semdb.database.records import ChangeKind
from semdb.database.scanning import CoarseRows
from semdb.database.store import Store, open_store
from semdb.database.tables import cnn_vectors, keyframe_categories, keyframe_changes, map_models
from semdb.localization.coarse import CoarseOptions, CoarseSource, MapChange, QueryClasses, cascade
from semdb.localization.index import IndexOptions, IndexSource, MapIndex
from semdb.localization.sources import SqlSource
from semdb.types import Int64Array
from tests.database_samples import CATEGORIES, MODELS, OTHER_MODELS, description, fill, plan, record

EXACT = IndexOptions()
REDUCED = IndexOptions(exact_up_to=8, components=6, rerank=1000)
MODES = pytest.mark.parametrize("options", [EXACT, REDUCED], ids=["exact", "reduced"])


def assert_same(index: CoarseSource, sql: CoarseSource, seed: int, queries: int = 6) -> None:
    """Both sources give the same to the last bit, for queries with known, unknown and no classes."""
    random = np.random.default_rng(seed)
    assert index.keyframe_count() == sql.keyframe_count()
    found = index.document_frequencies([*CATEGORIES, "zebra"])
    expected = sql.document_frequencies([*CATEGORIES, "zebra"])
    assert {name: df for name, df in found.items() if df} == {name: df for name, df in expected.items() if df}
    for _ in range(queries):
        names = random.choice([*CATEGORIES, "zebra"], size=int(random.integers(0, 5)))
        counts = {str(name): float(random.uniform(0.2, 4).__round__(1)) for name in names}
        vector = description(int(random.integers(1000))).cnn_vector
        query = class_query(counts, sql.keyframe_count(), expected)
        pairs = {name: tuple(random.integers(0, 60, 2).tolist()) for name in counts}
        strong = strength_query(pairs, sql.keyframe_count(), expected, {"cup": (9, 30)})
        for share, at_most in ((0.0, None), (0.5, None), (0.3, 3)):
            for asked in (query, strong):
                a, b = index.filtered(asked, share, at_most), sql.filtered(asked, share, at_most)
                assert a.keyframe_ids.tolist() == b.keyframe_ids.tolist()
                assert a.class_scores.tolist() == b.class_scores.tolist()
                assert index.cosines(vector, a.keyframe_ids).tolist() == sql.cosines(vector, b.keyframe_ids).tolist()
        for classes, weight, count in ((query, 0.15, 5), (strong, 0.15, 7), (None, 0.0, 1000)):
            c, d = index.nearest(vector, count, classes, weight), sql.nearest(vector, count, classes, weight)
            assert c.keyframe_ids.tolist() == d.keyframe_ids.tolist()
            assert c.class_scores.tolist() == d.class_scores.tolist()
            assert c.cosines.tolist() == d.cosines.tolist()
        steps = CoarseOptions(filtered_at_most=4, filtered_batches=(2, 3), soft_batches=(3,), all_batches=(100,))
        shown = QueryClasses(counts, pairs, {"cup": (9, 30)})
        assert list(cascade(index, shown, vector, steps)) == list(cascade(sql, shown, vector, steps))


def redescribe(store: Store, map_id: int, keyframe_id: int, seed: int) -> None:
    """Another vector and other counts for a keyframe, as a description anew would write them."""
    vector = encode_array(description(seed).cnn_vector)
    c, v = keyframe_categories.c, cnn_vectors.c
    change = {"map_id": map_id, "keyframe_id": keyframe_id, "kind": ChangeKind.REDESCRIBED.value}

    def work(connection: object) -> None:
        connection.execute(update(cnn_vectors).where(v.keyframe_id == keyframe_id).values(vector=vector))  # type: ignore[attr-defined]
        lower = select(c.lower_strength).where(c.keyframe_id == keyframe_id)
        held = [int(value) + seed % 200 for value in connection.execute(lower).scalars()]  # type: ignore[attr-defined]
        more = update(keyframe_categories).where(c.keyframe_id == keyframe_id)
        more = more.values(count=c.count + 1 + seed % 300, upper_strength=seed % 200, keyframe_strength=sum(held))
        connection.execute(more)  # type: ignore[attr-defined]
        connection.execute(insert(keyframe_changes), change)  # type: ignore[attr-defined]

    retry.write(store.engine, work)


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(1, 6)),
        st.tuples(st.just("delete"), st.lists(st.integers(0, 30), min_size=1, max_size=5)),
        st.tuples(st.just("redescribe"), st.integers(0, 30)),
        st.tuples(st.just("open"), st.just(0)),
        st.tuples(st.just("ask"), st.just(0)),
    ),
    min_size=2,
    max_size=7,
)


@MODES
@settings(
    max_examples=6,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(steps=STEPS, seed=st.integers(0, 10_000))
def test_the_index_answers_as_sql_does_whatever_happens(
    store: Store, tmp_path: Path, options: IndexOptions, steps: list[tuple[str, object]], seed: int
) -> None:
    name = f"map {store.ensure_map('counter')} {len(store.maps())}"
    map_id, _, _ = fill(store, name, "first", range(0, 20, 2), seed=seed)
    said: list[str] = []
    index = MapIndex.open(store, map_id, tmp_path, options=options, say=said.append)
    source, sql = IndexSource(index), SqlSource(store, map_id)
    for number, (step, argument) in enumerate([*steps, ("ask", 0)]):
        ids = store.keyframe_ids(map_id)
        if step == "add":
            fill(store, name, f"more {number}", range(argument), seed=seed + 50 * number)  # type: ignore[call-overload]
        elif step == "delete":
            store.delete_keyframes({ids[i % len(ids)] for i in argument} if ids else ())  # type: ignore[attr-defined]
        elif step == "redescribe" and ids:
            redescribe(store, map_id, ids[argument % len(ids)], seed + number)  # type: ignore[operator]
        elif step == "open":
            index.close()
            index = MapIndex.open(store, map_id, tmp_path, options=options, say=said.append)
            source = IndexSource(index)
        elif step == "ask":
            source.refresh()
            sql.refresh()
            assert_same(source, sql, seed + number, queries=2)
    assert said == []


@MODES
def test_only_what_changed_is_read(store: Store, options: IndexOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    map_id, _, ids = fill(store, name="first", frame_indexes=range(0, 40, 2))
    index = MapIndex.open(store, map_id, options=options)
    source, sql = IndexSource(index), SqlSource(store, map_id)
    sql.refresh()
    read: list[list[int]] = []
    rows = store.coarse_rows

    def counted(key: int, keys: Int64Array, *given: Any, **how: Any) -> CoarseRows:
        read.append(keys.tolist())
        return rows(key, keys, *given, **how)

    monkeypatch.setattr(store, "coarse_rows", counted)
    monkeypatch.setattr(store, "iter_vectors", lambda *_: pytest.fail("the whole map was read"))
    assert source.refresh() == sql.refresh() == MapChange()
    added = fill(store, name="second", frame_indexes=range(3), seed=70)[2]
    assert source.refresh() == sql.refresh() == MapChange(added=frozenset(added))
    store.delete_keyframes(ids[3:9])
    assert source.refresh() == sql.refresh() == MapChange(gone=frozenset(ids[3:9]))
    redescribe(store, map_id, ids[0], 333)
    assert source.refresh() == sql.refresh() == MapChange(gone=frozenset(ids[:1]))
    assert read == [added, ids[3:9], ids[:1]]
    monkeypatch.undo()
    assert_same(source, sql, 1)


def test_a_map_that_grows_large_is_reduced_beside_the_queries(store: Store, tmp_path: Path) -> None:
    map_id, _, _ = fill(store, "lab", "first", range(0, 12, 2))
    said: list[str] = []
    with MapIndex.open(store, map_id, tmp_path, options=REDUCED, say=said.append) as index:
        source, sql = IndexSource(index), SqlSource(store, map_id)
        assert index.state.reduction is None
        fill(store, "lab", "second", range(0, 10, 2))
        for changed in (source, sql):
            changed.refresh()
        assert_same(source, sql, 1)  # before, while or after components are found: the answers are the same
        index.settle()
        assert index.state.reduction is not None
        assert index.state.reduction.fitted_on == 11
        fill(store, "lab", "third", range(0, 4, 2))
        for changed in (source, sql):
            changed.refresh()
        assert_same(source, sql, 2)
    with MapIndex.open(store, map_id, tmp_path, options=REDUCED, say=said.append) as again:
        assert again.state.reduction is not None  # from the file
        assert again.state.living == 13
    assert said == []


def test_sources_are_told_what_changed_since_they_looked(store: Store) -> None:
    map_id, _, ids = fill(store, frame_indexes=range(4))
    index = MapIndex.open(store, map_id)
    early, late = IndexSource(index), IndexSource(index)
    added = fill(store, name="second", frame_indexes=range(3), seed=70)[2]
    assert early.refresh() == MapChange(added=frozenset(added))
    store.delete_keyframes([ids[0], added[1]])
    assert late.keyframe_count() == 4  # until it looks
    assert late.refresh() == MapChange(frozenset([added[0], added[2]]), frozenset([ids[0], added[1]]))
    assert early.refresh() == MapChange(gone=frozenset([ids[0], added[1]]))
    assert [early.keyframe_count(), late.keyframe_count()] == [5, 5]


def test_what_another_process_ingests_is_found(store: Store, database_url: str, tmp_path: Path) -> None:
    map_id, _, _ = fill(store, frame_indexes=range(4))
    source = IndexSource(MapIndex.open(store, map_id, tmp_path))
    code = (
        "import sys\nfrom semdb.database.store import open_store\nfrom tests.database_samples import fill\n"
        "with open_store(sys.argv[1]) as store:\n    print(*fill(store, name='other', frame_indexes=[5], seed=9)[2])\n"
    )
    here = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", code, database_url]
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    added = int(done.stdout)
    assert source.refresh() == MapChange(added=frozenset([added]))
    vector = description(9 + 5).cnn_vector
    assert source.nearest(vector, 1, None, 0.0).keyframe_ids.tolist() == [added]


@MODES
def test_threads_ask_while_the_map_changes(store: Store, options: IndexOptions, tmp_path: Path) -> None:
    """Every answer is of one state: the keyframes of a recording are all there or none, and cosines are theirs."""
    map_id, _, _ = fill(store, name="first", frame_indexes=range(30))
    index = MapIndex.open(store, map_id, tmp_path, options=options)
    stop = threading.Event()
    errors: list[BaseException] = []
    answers = [0, 0]

    def ask(number: int) -> None:
        source = IndexSource(index)
        vector = description(number).cnn_vector
        try:
            while not stop.is_set():
                source.refresh()
                ranked = source.nearest(vector, 1000, None, 0.0)
                assert len(ranked) == source.keyframe_count() == len(set(ranked.keyframe_ids.tolist()))
                assert source.cosines(vector, ranked.keyframe_ids).tolist() == ranked.cosines.tolist()
                query = class_query({"cup": 1.0}, len(ranked), source.document_frequencies(["cup"]))
                shown = source.filtered(query, 0.1, None)
                assert len(shown.keyframe_ids) == source.document_frequencies(["cup"]).get("cup", 0)
                answers[number] += 1
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for round_ in range(4):
        fill(store, name=f"round {round_}", frame_indexes=range(5), seed=100 * round_)
        ids = store.keyframe_ids(map_id)
        store.delete_keyframes(ids[round_ :: len(ids) // 4])
    stop.set()
    for thread in threads:
        thread.join()
    assert errors == []
    assert min(answers) > 0
    source, sql = IndexSource(index), SqlSource(store, map_id)
    source.refresh()
    assert_same(source, sql, 5)


def test_a_refresh_that_failed_is_made_up_for(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    map_id, _, ids = fill(store, frame_indexes=range(5))
    source = IndexSource(MapIndex.open(store, map_id))
    added = fill(store, name="second", frame_indexes=range(2), seed=70)[2]
    redescribe(store, map_id, ids[1], 44)

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("the database went away")

    monkeypatch.setattr(store, "coarse_rows", broken)
    with pytest.raises(RuntimeError):
        source.refresh()
    monkeypatch.undo()
    assert source.refresh() == MapChange(frozenset(added), frozenset([ids[1]]))
    assert_same(source, SqlSource(store, map_id), 3)


def test_a_map_described_anew_by_another_encoder(store: Store, tmp_path: Path) -> None:
    map_id, recording_id, _ = fill(store, frame_indexes=range(5))
    said: list[str] = []
    index = MapIndex.open(store, map_id, tmp_path, say=said.append)
    store.delete_recording(recording_id)
    retry.write(store.engine, lambda c: c.execute(map_models.delete().where(map_models.c.map_id == map_id)))
    planned = store.plan_recording(map_id, plan("new", range(3)), OTHER_MODELS)
    for i in range(3):
        described = description(i, models=OTHER_MODELS, vector_size=32)
        store.write_keyframe(planned.recording_id, record(i, described))
    source = IndexSource(index)
    assert source.refresh().everything
    vector = description(2, models=OTHER_MODELS, vector_size=32).cnn_vector
    assert source.nearest(vector, 9, None, 0.0).cosines[0] == pytest.approx(1)
    assert source.keyframe_count() == 3
    assert len(said) == 1
    assert "another encoder" in said[0]


def test_an_empty_map(store: Store, tmp_path: Path) -> None:
    map_id = store.ensure_map("room")
    for _ in range(2):
        index = MapIndex.open(store, map_id, tmp_path)
        source, sql = IndexSource(index), SqlSource(store, map_id)
        assert source.keyframe_count() == 0
        assert_same(source, sql, 1, queries=1)
    fill(store, "room", frame_indexes=range(2))
    source.refresh()
    sql.refresh()
    assert_same(source, sql, 1)


def test_the_database_of_another_url_has_another_folder(tmp_path: Path) -> None:
    from semdb.localization.index.cache_folder import database_key

    keys = set()
    for name in ("a", "b"):
        with open_store(f"sqlite:///{tmp_path / name}.sqlite3", create=True) as store:
            keys.add(database_key(store))
    assert len(keys) == 2
    assert len(MODELS) == 3
