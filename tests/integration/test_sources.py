"""SQL, the reference of the coarse step, tells what changed; the log of changes is followed whatever happens to it."""

from __future__ import annotations

import numpy as np
from sqlalchemy import delete, insert

from semdb.database import retry
from semdb.database.records import ChangeKind
from semdb.database.store import Store
from semdb.database.tables import keyframe_changes
from semdb.localization.changes import ChangeReader
from semdb.localization.coarse import MapChange
from semdb.localization.sources import SqlSource
from tests.database_samples import description, fill


def note(store: Store, map_id: int, change_id: int, keyframe_id: int, kind: ChangeKind = ChangeKind.ADDED) -> None:
    row = {"id": change_id, "map_id": map_id, "keyframe_id": keyframe_id, "kind": kind.value}
    retry.write(store.engine, lambda connection: connection.execute(insert(keyframe_changes), row))


def test_the_reference_tells_what_changed(store: Store) -> None:
    map_id, _, ids = fill(store, name="first", frame_indexes=range(5))
    sql = SqlSource(store, map_id)
    assert [sql.refresh(), sql.refresh()] == [MapChange(), MapChange()]
    store.delete_keyframes(ids[:1])
    assert [sql.refresh(), sql.refresh()] == [MapChange(gone=frozenset(ids[:1])), MapChange()]
    added = fill(store, name="second", frame_indexes=range(2))[2]
    assert sql.refresh() == MapChange(added=frozenset(added))
    assert sql.keyframe_count() == 6


def test_cosines_of_the_reference(store: Store) -> None:
    map_id, _, ids = fill(store, frame_indexes=range(6))
    vector = description(99).cnn_vector
    asked = np.array([ids[4], 10**6, ids[0], ids[4]], np.int64)
    expected = store.load_vectors([ids[4], ids[0], ids[4]]).astype(np.float64) @ vector.astype(np.float64)
    found = SqlSource(store, map_id).cosines(vector, asked)
    assert np.isnan(found[1])
    np.testing.assert_allclose(found[[0, 2, 3]], expected, atol=1e-12)
    assert np.isnan(SqlSource(store, map_id).cosines(vector, np.array([10**6], np.int64))).all()


def test_changes_that_commit_late_are_told_once(store: Store) -> None:
    map_id = store.ensure_map("room")
    reader = ChangeReader(store, map_id, overlap=50)
    for change_id in (10, 11, 30):
        note(store, map_id, change_id, change_id)
    reader.skip()
    assert reader.read() == []
    note(store, map_id, 20, 20)  # its transaction began before that of 30
    changes = reader.read()
    assert changes is not None
    assert [change.id for change in changes] == [20]
    assert reader.read() == []
    note(store, map_id, 90, 90)
    note(store, map_id, 25, 25, ChangeKind.DELETED)
    changes = reader.read()
    assert changes is not None
    assert [(change.id, change.kind) for change in changes] == [(25, ChangeKind.DELETED), (90, ChangeKind.ADDED)]
    assert reader.read() == []


def test_a_log_that_was_cut_off_is_noticed(store: Store) -> None:
    map_id = store.ensure_map("room")
    reader = ChangeReader(store, map_id)
    for change_id in (10, 11):
        note(store, map_id, change_id, change_id)
    reader.skip()
    below = delete(keyframe_changes).where(keyframe_changes.c.id < 11)
    retry.write(store.engine, lambda connection: connection.execute(below))
    assert reader.read() == []  # what was seen long ago may go
    note(store, map_id, 12, 12)
    note(store, map_id, 13, 13)
    below = delete(keyframe_changes).where(keyframe_changes.c.id < 13)
    retry.write(store.engine, lambda connection: connection.execute(below))
    assert reader.read() is None
    assert reader.read() == []
    note(store, map_id, 14, 14)
    changes = reader.read()
    assert changes is not None
    assert [change.id for change in changes] == [14]
