"""One suite for every server: what is stored comes back, and only once."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select

from semdb.database import schema, tables
from semdb.database.engine import make_engine
from semdb.database.records import RecordingState, WriteResult
from semdb.database.store import Store, open_store
from semdb.errors import NotFoundError, ProvenanceError, UsageError
from semdb.types import Candidate, Localization, Verdict
from tests.database_samples import DISTORTED, MODELS, OTHER_MODELS, description, fill, plan, pose, record
from tests.integration.comparison import FRAMES, assert_same, rows_per_table


def test_keyframes_come_back_as_they_were_written(store: Store) -> None:
    map_id, recording_id, ids = fill(store)
    wanted = list(reversed(ids))
    loaded = store.load_keyframes(wanted)
    assert [keyframe.id for keyframe in loaded] == wanted
    for keyframe, index in zip(loaded, reversed(FRAMES), strict=True):
        assert_same(keyframe, description(index), index)
        assert (keyframe.map_id, keyframe.recording_id, keyframe.recording) == (map_id, recording_id, "first visit")
        written = record(index, description(index))
        assert keyframe.timestamp_ns == written.timestamp_ns
        image = store.load_image(keyframe.id)
        assert (image.rgb, image.depth) == (written.image_bytes, written.depth_bytes)
        assert (image.rgb_format, image.depth_format) == ("png" if index % 2 else "jpeg", "png")
        assert (image.depth_scale, image.depth_registration) == (5000.0, "7scenes" if index % 2 else "")
        masks = store.load_masks(keyframe.id)
        assert len(masks) == len(description(index).detections)
        for mask, detection in zip(masks, description(index).detections, strict=True):
            np.testing.assert_array_equal(mask, detection.mask)


def test_vectors_and_poses_come_in_order(store: Store) -> None:
    map_id, _, ids = fill(store)
    order = [ids[2], ids[0], ids[4], ids[0]]
    expected = np.stack([description(FRAMES[ids.index(key)]).cnn_vector for key in order])
    np.testing.assert_array_equal(store.load_vectors(order), expected)
    assert store.load_vectors([]).shape == (0, 0)
    keys, matrices = store.poses(map_id)
    assert keys == ids == store.keyframe_ids(map_id)
    assert matrices.shape == (5, 4, 4)
    np.testing.assert_allclose(matrices[3], pose(12), atol=1e-12)
    assert store.load_keyframes([]) == []


def test_many_keys_are_read_in_chunks(store: Store) -> None:
    _, _, ids = fill(store)
    order = ids * 300
    vectors = store.load_vectors(np.array(order))  # type: ignore[arg-type]
    assert vectors.shape == (1500, 128)
    np.testing.assert_array_equal(vectors[-5:], vectors[:5])
    assert len(store.load_keyframes(order[:1001], descriptors=False)) == 1001


@pytest.mark.parametrize("case", ["no objects", "no keypoints", "binary", "no depth", "distorted", "one pixel"])
def test_unusual_keyframes(store: Store, case: str) -> None:
    described = {
        "no objects": lambda: description(1, []),
        "no keypoints": lambda: description(1, ["cup"], keypoints=0),
        "binary": lambda: description(1, binary=True),
        "no depth": lambda: description(1),
        "distorted": lambda: description(1, camera=DISTORTED),
        "one pixel": lambda: description(1, ["cup"] * 80, keypoints=1),
    }[case]()
    planned = store.plan_recording(store.ensure_map("room"), plan("r", [1]), MODELS)
    written = store.write_keyframe(planned.recording_id, record(1, described, depth=case != "no depth"))
    (loaded,) = store.load_keyframes([written.keyframe_id])
    assert_same(loaded, described, 1)
    assert len(store.load_masks(loaded.id)) == len(described.detections)
    assert (store.load_image(loaded.id).depth is None) == (case == "no depth")
    without = store.load_keyframes([loaded.id], descriptors=False)[0].keypoints.features.descriptors
    assert without.shape == (len(described.keypoints), 0)


def test_writing_again_adds_nothing(store: Store) -> None:
    _, recording_id, ids = fill(store)
    before = rows_per_table(store)
    again = store.write_keyframe(recording_id, record(7, description(99)))
    assert again == WriteResult(ids[2], created=False)
    assert rows_per_table(store) == before
    assert fill(store)[2] == []
    assert rows_per_table(store) == before


def test_an_interrupted_ingest_goes_on_where_it_stopped(store: Store, database_url: str) -> None:
    map_id = store.ensure_map("room")
    first = store.plan_recording(map_id, plan("r", [5, 1, 9]), MODELS)
    assert (first.pending, first.stored, first.failed) == ((1, 5, 9), (), ())
    store.write_keyframe(first.recording_id, record(5, description(5)))
    store.fail_item(first.recording_id, 9, "truncated image")
    assert store.finish_recording(first.recording_id) == RecordingState.INGESTING
    with open_store(database_url) as other:
        again = other.plan_recording(map_id, plan("r", [9, 5, 1]), MODELS)
        assert (again.recording_id, again.pending, again.stored, again.failed) == (
            first.recording_id,
            (1, 9),
            (5,),
            (9,),
        )
        other.write_keyframe(again.recording_id, record(1, description(1)))
        assert other.finish_recording(again.recording_id) == RecordingState.COMPLETE
        (status,) = other.status()
    assert dict(status.items) == {"done": 2, "failed": 1}
    assert (status.state, status.keyframes, status.frame_count) == (RecordingState.COMPLETE, 2, 100)
    (failed,) = store.failed_items()
    assert (failed.frame_index, failed.attempts, failed.error) == (9, 1, "truncated image")


def test_status_counts_what_is_stored(store: Store) -> None:
    _, recording_id, _ = fill(store)
    (status,) = store.status()
    assert status.recording_id == recording_id
    assert dict(status.items) == {"done": 5}
    assert status.objects == sum(len(description(index).detections) for index in FRAMES)
    assert status.keypoints == 5 * 60
    sizes = [len(r.image_bytes) + len(r.depth_bytes or b"") for r in (record(i, description(i)) for i in FRAMES)]
    assert status.image_bytes == sum(sizes)
    assert store.status(store.ensure_map("empty")) == []
    assert [(info.name, info.keyframes, info.recordings) for info in store.maps()] == [("room", 5, 1), ("empty", 0, 0)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fingerprint": "0" * 64}, "which keyframes it has, its camera, or their times or poses are others"),
        ({"format": "icl_nuim"}, "its format is tum, not icl_nuim"),
        ({"frame_count": 99}, "number of frames is 100, not 99"),
        ({"frame_indexes": (0, 3, 7, 12, 21)}, "only then: 20; only now: 21"),
    ],
)
def test_another_plan_under_the_same_name_is_refused(store: Store, change: dict[str, object], message: str) -> None:
    map_id, _, _ = fill(store)
    other = dataclasses.replace(plan("first visit", FRAMES), **change)
    with pytest.raises(UsageError, match=message) as caught:
        store.plan_recording(map_id, other, MODELS)
    assert "semdb delete" in str(caught.value)


def test_other_models_are_refused_with_both_names(store: Store) -> None:
    map_id, recording_id, _ = fill(store)
    assert store.map_models(map_id) == MODELS
    assert store.map_models(store.ensure_map("empty")) == ()
    for attempt in (
        lambda: store.plan_recording(map_id, plan("second", [1]), OTHER_MODELS),
        lambda: store.write_keyframe(recording_id, record(1, description(1, models=OTHER_MODELS))),
        lambda: store.check_models(map_id, OTHER_MODELS),
    ):
        both = r"the map 'room' is described by the encoder gist.*not by onnx:resnet50.onnx \(sha256 abababababab\)"
        with pytest.raises(ProvenanceError, match=both):
            attempt()
    other_settings = (dataclasses.replace(MODELS[0], config='{"score_threshold": 0.7}'), *MODELS[1:])
    with pytest.raises(ProvenanceError, match=r"0\.5.*0\.7"):
        store.check_models(map_id, other_settings)
    assert rows_per_table(store)["recordings"] == 1


def test_descriptions_that_contradict_themselves_are_refused(store: Store) -> None:
    planned = store.plan_recording(store.ensure_map("room"), plan("r", [1]), MODELS)
    good = description(1, ["cup", "tv"])
    turned = dataclasses.replace(good.keypoints, object_index=good.keypoints.object_index[::-1].copy())
    high = dataclasses.replace(good.keypoints, object_index=np.full(60, 2, np.int32))
    no_vector = np.full(128, np.nan, np.float32)
    for bad, message in (
        (dataclasses.replace(good, keypoints=turned), "sorted by object"),
        (dataclasses.replace(good, keypoints=high), "on object 2 of 2"),
        (dataclasses.replace(good, geometry=()), "one geometry per detection"),
        (dataclasses.replace(good, cnn_vector=no_vector), "finite"),
    ):
        with pytest.raises(UsageError, match=message):
            store.write_keyframe(planned.recording_id, record(1, bad))
    no_pose = dataclasses.replace(record(1, good), world_from_camera=np.full((4, 4), np.nan))
    with pytest.raises(UsageError, match="finite 4x4 pose"):
        store.write_keyframe(planned.recording_id, no_pose)
    with pytest.raises(UsageError, match="frame 2 is not in the plan"):
        store.write_keyframe(planned.recording_id, record(2, good))
    assert rows_per_table(store)["keyframes"] == 0


def test_names_are_stored_exactly(store: Store, database_url: str) -> None:
    names = ["Küche 厨房 🍳", "küche", "Küche", "KÜCHE", "a'b\"c`d\\e%f_g;--"]
    ids = [store.ensure_map(name) for name in names]
    assert len(set(ids)) == 5
    with open_store(database_url) as other:
        assert [other.ensure_map(name) for name in names] == ids
        assert [info.name for info in other.maps()] == names
        fill(other, names[0], names[4])
        assert store.find_recording(ids[0], names[4]) == 1
        assert store.find_map(names[0]).keyframes == 5
    for bad in ("", " room", "room ", "a\nb", "x" * 256):
        with pytest.raises(UsageError, match="cannot be the name of a map"):
            store.ensure_map(bad)
    with pytest.raises(NotFoundError, match=r"there is no map 'hall'.*Küche 厨房"):
        store.find_map("hall")


def test_same_names_in_two_maps_are_two_recordings(store: Store) -> None:
    first, second = fill(store, "room"), fill(store, "hall", seed=50)
    assert first[1] != second[1]
    assert set(first[2]).isdisjoint(second[2])
    assert store.keyframe_ids(second[0]) == second[2]
    query = store.class_query(second[0], dict.fromkeys(("chair", "cup", "laptop", "tv", "person"), 1.0))
    scored = store.class_filter(second[0], query, 0.0)
    assert {item.keyframe_id for item in scored} <= set(second[2])


def test_missing_rows_are_named(store: Store) -> None:
    map_id, _, ids = fill(store)
    with pytest.raises(NotFoundError, match="no keyframe 999"):
        store.load_keyframes([ids[0], 999])
    with pytest.raises(NotFoundError, match=r"keyframe 998 \(and 1 more\)"):
        store.load_vectors([998, 999])
    for attempt in (
        lambda: store.load_image(999),
        lambda: store.delete_recording(999),
        lambda: store.delete_map(999),
        lambda: store.finish_recording(999),
        lambda: store.plan_recording(999, plan("r", [1]), MODELS),
        lambda: store.write_keyframe(999, record(1, description(1))),
        lambda: store.find_recording(map_id, "second visit"),
    ):
        with pytest.raises(NotFoundError, match="there is no"):
            attempt()
    assert store.delete_keyframes([998, 999]) == 0


def test_the_log_of_queries(store: Store) -> None:
    map_id, _, ids = fill(store)
    candidate = Candidate(ids[0], "first visit", 0, 0.75, float("nan"), 0)
    found = Localization(
        Verdict.LOCALIZED,
        "room",
        pose(1),
        np.eye(6),
        0.9,
        120,
        "filtered",
        (candidate,),
        0.2,
        3,
        "fine",
        {"total": 12.34567},
    )
    lost = dataclasses.replace(found, verdict=Verdict.FAILED, world_from_camera=None, covariance=None, inliers=0)
    assert store.log_query(map_id, "query.png", found) < store.log_query(map_id, "lost.png", lost)
    with store.engine.connect() as connection:
        rows = connection.execute(select(tables.queries).order_by(tables.queries.c.id)).all()
    assert [(row.image, row.verdict, row.inliers) for row in rows] == [
        ("query.png", "localized", 120),
        ("lost.png", "failed", 0),
    ]
    np.testing.assert_allclose([rows[0].tx, rows[0].ty, rows[0].tz], pose(1)[:3, 3])
    assert rows[1].tx is None
    assert rows[0].timing_ms == '{"total": 12.346}'
    assert '"cosine": null' in rows[0].candidates


def test_rows_are_equal_on_both_servers(tmp_path: Path, server_url: str) -> None:
    contents = []
    for url in (f"sqlite:///{tmp_path / 'a.sqlite3'}", server_url):
        engine = make_engine(url)
        schema.upgrade(engine)
        engine.dispose()
        with open_store(url) as store:
            fill(store)
            fill(store, name="second visit", frame_indexes=range(1, 30, 3), seed=300)
            store.delete_keyframes([2])
            contents.append({table.name: _rows(store, table) for table in tables.metadata.sorted_tables})
    assert contents[0] == contents[1]
    assert len(contents[0]["keyframes"]) == 14


def _rows(store: Store, table: tables.Table) -> list[tuple[object, ...]]:
    columns = [column for column in table.c if not column.name.endswith("_at")]
    with store.engine.connect() as connection:
        return [tuple(row) for row in connection.execute(select(*columns).order_by(*table.primary_key.columns))]
