"""One suite for every server: deletion without a trace, writers side by side, damage."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Sequence

import pytest
from sqlalchemy import delete, insert, select, text, update
from sqlalchemy.exc import IntegrityError

from semdb.database import tables
from semdb.database.records import ChangeKind, RecordingState, WriteResult
from semdb.database.store import Store, open_store
from semdb.errors import CodecError, DatabaseError, NotFoundError, UsageError
from semdb.types import Description
from tests.database_samples import MODELS, OTHER_MODELS, PNG, description, fill, plan, record
from tests.integration.comparison import FRAMES, REMAINING, assert_same, rows_per_table


def test_a_deleted_recording_leaves_nothing_behind(store: Store) -> None:
    map_id, _, kept = fill(store)
    before = rows_per_table(store)
    _, second, ids = fill(store, name="second visit", frame_indexes=range(1, 40, 2), seed=500)
    steps: list[tuple[int, int]] = []
    deleted = store.delete_recording(second, lambda done, total: steps.append((done, total)))
    assert (deleted.recordings, deleted.keyframes) == (1, 20)
    assert steps == [(20, 20)]
    after = rows_per_table(store)
    assert {name: count for name, count in after.items() if before[name] != count} == {"keyframe_changes": 5 + 20 + 20}
    assert store.keyframe_ids(map_id) == kept
    kinds = [(change.keyframe_id, change.kind) for change in store.changes_since(map_id, 0)]
    assert kinds[-20:] == [(key, ChangeKind.DELETED) for key in ids]
    # Ids are never used again: what a mirror or a log remembers stays true.
    assert min(fill(store, name="third visit")[2]) > max(ids)


def test_a_deleted_map_takes_its_logs_along_in_chunks(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of one second, which are more than a chunk; another map keeps its own."""
    monkeypatch.setattr("semdb.database.deletion.SMALL_CHUNK", 2)
    maps = {name: fill(store, map_name=name)[0] for name in ("room", "hall")}
    image = {"confidence": 0.0, "inliers": 0, "stage": "pose", "reason": "", "candidates": "[]", "timing_ms": "{}"}
    with store.engine.begin() as connection:
        rows = [
            {"map_id": key, "image": f"{k}.png", "verdict": "lost", **image} for key in maps.values() for k in range(5)
        ]
        connection.execute(insert(tables.queries), rows)
    store.delete_map(maps["room"])
    with store.engine.connect() as connection:
        for table in (tables.queries, tables.keyframe_changes, tables.recordings):
            left = set(connection.execute(select(table.c.map_id)).scalars())
            assert left == {maps["hall"]}, table.name
    assert rows_per_table(store)["queries"] == 5


def test_an_emptied_map_takes_other_models(store: Store) -> None:
    map_id, recording_id, _ = fill(store)
    store.delete_recording(recording_id)
    counts = rows_per_table(store)
    assert {name for name, count in counts.items() if count} <= REMAINING
    assert store.map_models(map_id) == ()
    planned = store.plan_recording(map_id, plan("first visit", [1]), OTHER_MODELS)
    assert store.write_keyframe(planned.recording_id, record(1, description(1, models=OTHER_MODELS))).created
    store.delete_map(map_id)
    counts = rows_per_table(store)
    assert {name for name, count in counts.items() if count} <= {"models", "categories"}


def test_deleted_keyframes_stay_deleted(store: Store) -> None:
    map_id, recording_id, ids = fill(store)
    assert store.delete_keyframes([ids[1], ids[3], 12345]) == 2
    assert store.keyframe_ids(map_id) == [ids[0], ids[2], ids[4]]
    assert dict(store.status()[0].items) == {"deleted": 2, "done": 3}
    again = store.plan_recording(map_id, plan("first visit", FRAMES), MODELS)
    assert (again.recording_id, again.pending, again.stored) == (recording_id, (), (0, 7, 20))


def test_a_half_deleted_recording_is_neither_read_on_nor_written(store: Store) -> None:
    map_id, recording_id, _ = fill(store)
    change = update(tables.recordings).values(state=RecordingState.DELETING.value)
    with store.engine.begin() as connection:
        connection.execute(change)
    with pytest.raises(UsageError, match="is being deleted"):
        store.plan_recording(map_id, plan("first visit", FRAMES), MODELS)
    with open_store(store.engine.url.render_as_string(hide_password=False)) as other, pytest.raises(NotFoundError):
        other.write_keyframe(recording_id, record(3, description(3)))
    assert store.delete_recording(recording_id).keyframes == 5


def test_a_writer_notices_that_its_recording_was_deleted(store: Store, database_url: str) -> None:
    planned = store.plan_recording(store.ensure_map("room"), plan("r", [1, 2, 3]), MODELS)
    store.write_keyframe(planned.recording_id, record(1, description(1)))
    with open_store(database_url) as other:
        other.delete_recording(planned.recording_id)
    with pytest.raises(NotFoundError, match="it was deleted"):
        store.write_keyframe(planned.recording_id, record(2, description(2)))
    counts = rows_per_table(store)
    assert {name for name, count in counts.items() if count} <= REMAINING | {"cameras"}


def _write_all(url: str, recording_id: int, frames: Sequence[int], results: list[object]) -> None:
    try:
        with open_store(url) as store:
            results.extend(store.write_keyframe(recording_id, record(i, description(i))) for i in frames)
    except Exception as error:  # a thread cannot raise into the test
        results.append(error)


def test_concurrent_writers_of_the_same_keyframes_write_each_once(store: Store, database_url: str) -> None:
    frames = list(range(1, 21))
    planned = store.plan_recording(store.ensure_map("room"), plan("r", frames), MODELS)
    results: list[list[object]] = [[], [], []]
    orders = [frames, frames, frames[::-1]]
    threads = [
        threading.Thread(target=_write_all, args=(database_url, planned.recording_id, order, result))
        for order, result in zip(orders, results, strict=True)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    every = [result for part in results for result in part]
    assert [item for item in every if not isinstance(item, WriteResult)] == []
    assert sum(item.created for item in every if isinstance(item, WriteResult)) == 20
    counts = rows_per_table(store)
    assert (counts["keyframes"], counts["cnn_vectors"], counts["keyframe_changes"], counts["cameras"]) == (20,) * 3 + (
        1,
    )
    assert counts["objects"] == sum(len(description(i).detections) for i in frames)
    assert dict(store.status()[0].items) == {"done": 20}
    assert_same(store.load_keyframes([store.keyframe_ids(1)[0]])[0], *_described(store, store.keyframe_ids(1)[0]))


def _described(store: Store, keyframe_id: int) -> tuple[Description, int]:
    frame_index = store.load_keyframes([keyframe_id])[0].frame_index
    return description(frame_index), frame_index


def test_concurrent_plans_of_one_recording_are_one(store: Store, database_url: str) -> None:
    ids: list[int] = []

    def make() -> None:
        with open_store(database_url) as other:
            ids.append(other.plan_recording(other.ensure_map("room"), plan("r", range(50)), MODELS).recording_id)

    threads = [threading.Thread(target=make) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert ids == [1] * 4
    assert rows_per_table(store)["ingest_items"] == 50


@pytest.mark.parametrize(
    ("table", "column", "read"),
    [
        (tables.keypoints, "data", "load_keyframes"),
        (tables.descriptors, "data", "load_keyframes"),
        (tables.cnn_vectors, "vector", "load_vectors"),
        (tables.objects, "mask", "load_masks"),
    ],
)
def test_damaged_blobs_are_named(store: Store, table: tables.Table, column: str, read: str) -> None:
    _, _, ids = fill(store)
    key = ids[0]
    with store.engine.connect() as connection:
        blob = connection.execute(select(table.c[column]).where(table.c.keyframe_id == key)).scalars().first()
    assert blob is not None
    for damaged in (
        blob[:-1],
        blob[:-1] + bytes([blob[-1] ^ 1]),
        b"",
        b"JUNK" + blob[4:],
        blob[:4] + b"\x09" + blob[5:],
    ):
        with store.engine.begin() as connection:
            connection.execute(update(table).where(table.c.keyframe_id == key).values({column: damaged}))
        with pytest.raises(CodecError, match=f"keyframe {key}"):
            getattr(store, read)(key if read == "load_masks" else [key])
    other = store.load_keyframes([ids[1]])[0]  # the rest can still be read
    assert_same(other, description(3), 3)


def test_missing_keypoints_are_an_error_not_an_empty_keyframe(store: Store) -> None:
    _, _, ids = fill(store)
    with store.engine.begin() as connection:
        connection.execute(delete(tables.descriptors).where(tables.descriptors.c.keyframe_id == ids[0]))
    with pytest.raises(CodecError, match=f"descriptors has no row of keyframe {ids[0]}"):
        store.load_keyframes(ids)


def test_a_value_that_the_server_does_not_take_is_refused_before_it_is_sent(store: Store) -> None:
    planned = store.plan_recording(store.ensure_map("room"), plan("r", [1]), MODELS)
    large = dataclasses.replace(record(1, description(1)), image_bytes=PNG + bytes(17 * 2**20))
    if store.engine.dialect.name == "sqlite":  # has no such limit
        assert store.write_keyframe(planned.recording_id, large).created
        return
    with pytest.raises(DatabaseError, match=r"keyframe_images row of frame 1 .*bytes.*max_allowed_packet"):
        store.write_keyframe(planned.recording_id, large)
    assert rows_per_table(store)["keyframes"] == 0
    assert store.write_keyframe(planned.recording_id, record(1, description(1))).created


def test_foreign_keys_hold(store: Store) -> None:
    fill(store)
    statement = text("UPDATE keyframes SET camera_id = 999")
    with store.engine.connect() as connection, pytest.raises(IntegrityError, match=r"(?i)foreign key"):
        connection.execute(statement)
