"""The mirror in memory against SQL, the reference, while the map changes; on both servers."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.database.store import Store
from semdb.localization.coarse import CoarseOptions, CoarseSource, MapChange, cascade
from semdb.localization.sources import MemorySource, SqlSource
from tests.database_samples import CATEGORIES, description, fill

QUERIES = 12


def assert_equal_answers(memory: CoarseSource, sql: CoarseSource, seed: int) -> None:
    random = np.random.default_rng(seed)
    for _ in range(QUERIES):
        names = random.choice([*CATEGORIES, "zebra"], size=int(random.integers(0, 5)))
        counts = {str(name): float(random.integers(1, 4)) for name in names}
        vector = description(int(random.integers(1000))).cnn_vector
        options = CoarseOptions(filtered_at_most=4, filtered_batches=(2, 3), soft_batches=(3,), all_batches=(100,))
        assert list(cascade(memory, counts, vector, options)) == list(cascade(sql, counts, vector, options))


@pytest.mark.parametrize("seed", range(3))
def test_the_mirror_answers_as_sql_does_while_the_map_changes(store: Store, seed: int) -> None:
    map_id, _, _ = fill(store, name="first", frame_indexes=range(0, 30, 2), seed=seed)
    memory, sql = MemorySource(store, map_id), SqlSource(store, map_id)
    sql.refresh()
    assert_equal_answers(memory, sql, seed)
    assert not memory.refresh()
    fill(store, name="second", frame_indexes=range(7), seed=seed + 50)
    assert memory.refresh()
    sql.refresh()
    assert memory.keyframe_count() == sql.keyframe_count() == 22
    assert_equal_answers(memory, sql, seed + 1)
    ids = store.keyframe_ids(map_id)
    store.delete_keyframes(ids[3:9])
    assert memory.refresh()
    sql.refresh()
    assert memory.keyframe_count() == sql.keyframe_count() == 16
    assert_equal_answers(memory, sql, seed + 2)


def test_the_reference_tells_what_changed(store: Store) -> None:
    map_id, _, ids = fill(store, name="first", frame_indexes=range(5))
    sql = SqlSource(store, map_id)
    assert [sql.refresh(), sql.refresh()] == [MapChange(), MapChange()]
    store.delete_keyframes(ids[:1])
    assert [sql.refresh(), sql.refresh()] == [MapChange(gone=frozenset(ids[:1])), MapChange()]
    added = fill(store, name="second", frame_indexes=range(2))[2]
    assert sql.refresh() == MapChange(added=frozenset(added))
    assert sql.keyframe_count() == 6
