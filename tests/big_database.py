"""A database with so many rows that a server's optimizer takes an index where there is one; filled in seconds."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, Table, insert, select

from semdb.database import tables
from semdb.database.records import ItemState
from semdb.database.store import Store
from tests.database_samples import CATEGORIES, MODELS, fill, plan

MAPS, RECORDINGS, FRAMES = 8, 3, 100  # of keyframes, and three objects each
PLANNED = FRAMES + 10  # the last frames are not stored yet
FIRST_KEYFRAME, FIRST_OBJECT = 10_000, 100_000
OBJECTS = 3
OF_KEYFRAME = ("keyframe_images", "cnn_vectors", "keypoints", "descriptors")
OF_OBJECTS = ("objects", "keyframe_categories", "completed_categories", "object_features")
QUERY = {
    "image": "query.png",
    "verdict": "failed",
    "confidence": 0.1,
    "inliers": 3,
    "stage": "all",
    "reason": "no texture",
    "candidates": "[]",
    "timing_ms": "{}",
}


def fill_big(store: Store) -> list[int]:
    """Maps full of copies of one keyframe. Returns the ids of the maps."""
    _, _, ids = fill(store, "the original")
    rows = _Rows(store, ids[0])
    map_ids = []
    for number in range(MAPS):
        map_ids.append(store.ensure_map(f"big {number}"))
        for visit in range(RECORDINGS):
            planned = store.plan_recording(map_ids[-1], plan(f"visit {visit}", range(PLANNED), frames=200), MODELS)
            rows.add_recording(map_ids[-1], planned.recording_id, (number * RECORDINGS + visit) * FRAMES)
    with store.engine.begin() as connection:
        rows.insert(connection)
        names = ", ".join([*rows.by_table, tables.ingest_items.name])
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql("ANALYZE")
        else:
            connection.exec_driver_sql(f"ANALYZE TABLE {names}").all()
    return map_ids


class _Rows:
    """Rows to insert, by table, in an order that foreign keys allow."""

    def __init__(self, store: Store, original: int) -> None:
        self.by_table: dict[str, list[dict[str, Any]]] = {
            name: [] for name in ("keyframes", *OF_KEYFRAME, *OF_OBJECTS, "keyframe_changes", "queries")
        }
        with store.engine.connect() as connection:
            self._sample = {
                name: _first(connection, tables.metadata.tables[name], "keyframe_id", original)
                for name in (*OF_KEYFRAME, "objects", "keyframe_categories")
            }
            self._keyframe = _first(connection, tables.keyframes, "id", original)
            known = select(tables.categories.c.id).where(tables.categories.c.name.in_(CATEGORIES))
            self._categories = list(connection.execute(known).scalars())

    def add_recording(self, map_id: int, recording_id: int, start: int) -> None:
        for frame in range(FRAMES):
            key = {"keyframe_id": FIRST_KEYFRAME + start + frame}
            self._add("keyframes", self._keyframe, id=key["keyframe_id"], recording_id=recording_id, frame_index=frame)
            for name in OF_KEYFRAME:
                self._add(name, self._sample[name], **key)
            for ordinal in range(OBJECTS):
                category = {"category_id": self._categories[(start + frame + ordinal) % len(self._categories)]}
                object_id = FIRST_OBJECT + (start + frame) * OBJECTS + ordinal
                self._add("objects", self._sample["objects"], id=object_id, ordinal=ordinal, **key, **category)
                shown = {**self._sample["keyframe_categories"], "map_id": map_id, **key, **category}
                self._add("keyframe_categories", shown)
                shown.pop("model_id")
                self._add("completed_categories", shown)
                features = {"model_id": self._sample["keypoints"]["model_id"], "start": 10 * ordinal, "count": 10}
                self._add("object_features", features, object_id=object_id)
            self._add("keyframe_changes", {}, map_id=map_id, kind="added", **key)
            self._add("queries", QUERY, map_id=map_id)

    def _add(self, name: str, row: dict[str, Any], **values: Any) -> None:
        self.by_table[name].append({**row, **values})

    def insert(self, connection: Connection) -> None:
        for name, rows in self.by_table.items():
            connection.execute(insert(tables.metadata.tables[name]), rows)
        item = tables.ingest_items
        stored = item.c.frame_index < FRAMES
        connection.execute(item.update().where(stored).values(state=ItemState.DONE.value))


def _first(connection: Connection, table: Table, column: str, key: int) -> dict[str, Any]:
    row = connection.execute(select(table).where(table.c[column] == key).limit(1)).mappings().one()
    return dict(row)
