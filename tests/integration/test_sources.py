"""The mirror in memory against SQL, the reference, while the map changes; on both servers."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.database.store import Store
from semdb.localization.coarse import CoarseOptions, cascade
from semdb.localization.sources import MemorySource, SqlSource
from tests.database_samples import CATEGORIES, description, fill

QUERIES = 12


def assert_equal_answers(memory: MemorySource, sql: SqlSource, seed: int) -> None:
    random = np.random.default_rng(seed)
    for _ in range(QUERIES):
        names = random.choice([*CATEGORIES, "zebra"], size=int(random.integers(0, 5)))
        counts = {str(name): float(random.integers(1, 4)) for name in names}
        vector = description(int(random.integers(1000))).cnn_vector
        assert memory.filtered(counts, 0.5) == sql.filtered(counts, 0.5)
        assert memory.class_scores(counts) == sql.class_scores(counts)
        options = CoarseOptions(filtered_batches=(2, 3), soft_batches=(3,), all_batches=(100,))
        assert list(cascade(memory, counts, vector, options)) == list(cascade(sql, counts, vector, options))


@pytest.mark.parametrize("seed", range(3))
def test_the_mirror_answers_as_sql_does_while_the_map_changes(store: Store, seed: int) -> None:
    map_id, _, _ = fill(store, name="first", frame_indexes=range(0, 30, 2), seed=seed)
    memory, sql = MemorySource(store, map_id), SqlSource(store, map_id)
    assert_equal_answers(memory, sql, seed)
    assert not memory.refresh()
    fill(store, name="second", frame_indexes=range(7), seed=seed + 50)
    assert memory.refresh()
    assert len(memory.keyframe_ids()) == 22
    assert_equal_answers(memory, sql, seed + 1)
    ids = store.keyframe_ids(map_id)
    store.delete_keyframes(ids[3:9])
    assert memory.refresh()
    assert len(memory.keyframe_ids()) == 16
    assert_equal_answers(memory, sql, seed + 2)


def test_the_reference_notices_too_that_the_keyframes_are_others(store: Store) -> None:
    map_id, _, _ = fill(store, name="first", frame_indexes=range(5))
    sql = SqlSource(store, map_id)
    assert [sql.refresh(), sql.refresh()] == [False, False]
    store.delete_keyframes(store.keyframe_ids(map_id)[:1])
    assert [sql.refresh(), sql.refresh()] == [True, False]
    fill(store, name="second", frame_indexes=range(2))
    assert sql.refresh()


def test_a_new_mirror_is_loaded_once(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    map_id, _, _ = fill(store, name="first", frame_indexes=range(5))
    loads: list[int] = []
    load = store.load_vectors
    monkeypatch.setattr(store, "load_vectors", lambda ids: (loads.append(len(ids)), load(ids))[1])
    MemorySource(store, map_id)
    assert loads == [5]
