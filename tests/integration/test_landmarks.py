"""Landmarks on every server: what is stored, that order and ids do not matter, and that ids live on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from sqlalchemy import text

from semdb.database.landmark_rows import LANDMARKS, give_up, load_gravity
from semdb.database.moving import move
from semdb.database.pose_records import Move, MovedRecording, OperationKind
from semdb.database.records import KeyframeRecord, MapInfo, RecordingPlan
from semdb.database.scene_reading import sighting_boxes
from semdb.database.store import Store, open_store
from semdb.landmarks.identity import keep_ids
from semdb.perception.describe import Describer
from semdb.perception.detectors.recorded import RecordedDetector
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features import load_features
from semdb.recordings.images import encode_16bit
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.refinement.run import refine_map
from semdb.settings import Settings
from semdb.types import InstanceMasks

FRAMES = 6
PICTURE = cv2.imencode(".png", np.zeros((2, 2, 3), np.uint8))[1].tobytes()  # nobody looks at it


@lru_cache(maxsize=2)
def records(spoiled: bool = False) -> tuple[KeyframeRecord, ...]:
    """Keyframes of a rendered room; `spoiled`: the third one misses what all show most of."""
    sequence = SyntheticSequence(SyntheticOptions(frames=FRAMES, lap_frames=24, width=320, height=240, room_seed=7))
    describer = Describer(RecordedDetector(), GistEncoder(), load_features("orb", Settings()))
    found, frames = [], [sequence.render(index) for index in range(FRAMES)]
    largest = max(sequence.classes, key=lambda label: min(np.count_nonzero(frame.labels == label) for frame in frames))
    for index, frame in enumerate(frames):
        labels = np.where(frame.labels == largest, 0, frame.labels) if spoiled and index == 2 else frame.labels
        masks = InstanceMasks(labels, sequence.classes)
        made = describer.describe(frame.rgb, frame.known_depth, sequence.camera, masks)
        packed = encode_16bit(np.rint(frame.depth * 5000).astype(np.uint16))
        pose = frame.world_from_camera
        time = 1_700_000_000_000_000_000 + index * 10**9
        found.append(KeyframeRecord(index, time, sequence.camera, pose, PICTURE, packed, 5000.0, "", made))
    return tuple(found)


def ingest(store: Store, order: Sequence[int], name: str = "room", *, spoiled: bool = False) -> MapInfo:
    map_id = store.ensure_map(name)
    made = records(spoiled)
    planned = tuple(range(FRAMES))
    plan = RecordingPlan("visit", "synthetic", "rendered", FRAMES, "rendered", planned)
    recording = store.plan_recording(map_id, plan, made[0].description.models).recording_id
    for index in order:
        store.write_keyframe(recording, made[index])
    return store.find_map(name)


def refine(store: Store, info: MapInfo, *, force: bool = False) -> int:
    (result,) = refine_map(store, info, kinds=[LANDMARKS], force=force)
    return result.rows


def table(store: Store, query: str) -> list[tuple[object, ...]]:
    with store.engine.connect() as connection:
        return [tuple(row) for row in connection.execute(text(query))]


THING = (
    "SELECT l.id, r.name, k.frame_index, o.ordinal FROM landmark_sightings s JOIN landmarks l ON l.id = s.landmark_id "
    "JOIN objects o ON o.id = s.object_id JOIN keyframes k ON k.id = o.keyframe_id "
    "JOIN recordings r ON r.id = k.recording_id"
)


def things(store: Store) -> dict[int, tuple[object, ...]]:
    """Of each landmark its sightings without ids: a name that every database gives it."""
    found: dict[int, list[tuple[object, ...]]] = {}
    for key, *sighting in table(store, THING):
        found.setdefault(int(str(key)), []).append(tuple(sighting))
    return {key: tuple(sorted(sightings)) for key, sightings in found.items()}


def contents(store: Store) -> list[object]:
    """All that is stored, ids apart, to the last bit."""
    named = things(store)
    columns = "c.name, l.probability, l.evidence, l.x, l.y, l.z, l.cov_xx, l.cov_xy, l.cov_xz, l.cov_yy, l.cov_yz, "
    columns += "l.cov_zz, l.size_x, l.size_y, l.size_z, l.yaw, l.sightings, l.keyframes, l.missed, l.seen_through, "
    columns += "l.state, l.first_seen_ns, l.last_seen_ns, k.frame_index, f.frame_index"
    rows = table(
        store,
        f"SELECT l.id, {columns} FROM landmarks l JOIN categories c ON c.id = l.category_id "
        "JOIN keyframes k ON k.id = l.first_keyframe_id JOIN keyframes f ON f.id = l.last_keyframe_id",
    )
    found: list[object] = [(named[int(str(key))], *rest) for key, *rest in rows]
    relations = table(store, "SELECT landmark_id, other_landmark_id, kind, score FROM landmark_relations")
    found += [(named[int(str(a))], named[int(str(b))], *rest) for a, b, *rest in relations]
    views = table(
        store,
        "SELECT v.landmark_id, v.place, k.frame_index, o.ordinal, v.quality, v.distance FROM landmark_views v "
        "JOIN objects o ON o.id = v.object_id JOIN keyframes k ON k.id = o.keyframe_id",
    )
    found += [(named[int(str(key))], *rest) for key, *rest in views]
    found += table(
        store,
        "SELECT k.frame_index, c.name, b.count, b.upper_strength, b.lower_strength, b.keyframe_strength "
        "FROM completed_categories b JOIN keyframes k ON k.id = b.keyframe_id "
        "JOIN categories c ON c.id = b.category_id",
    )
    visits = "presence, keyframes, points, seen, seen_through, occluded, missed, x, y, z, size_x, size_y, size_z"
    of_visits = table(store, f"SELECT landmark_id, {visits} FROM landmark_visits")
    found += [(named[int(str(key))], *rest) for key, *rest in of_visits]
    found += table(store, "SELECT up_x, up_y, up_z, up_certainty, floor, floor_certainty, given FROM map_gravity")
    return sorted(found, key=repr)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> list[object]:
    """What one order of ingest on SQLite gives."""
    path: Path = tmp_path_factory.mktemp("reference") / "semdb.sqlite3"
    with open_store(f"sqlite:///{path}", create=True) as store:
        refine(store, ingest(store, range(FRAMES)))
        return contents(store)


def test_contents_do_not_depend_on_order_ids_or_server(store: Store, reference: list[object]) -> None:
    ingest(store, [0, 1], "another map")  # ids begin elsewhere
    info = ingest(store, [4, 1, 5, 0, 3, 2])
    assert refine(store, info) > 15
    assert contents(store) == reference
    before = things(store)
    refine(store, info, force=True)
    assert contents(store) == reference
    assert things(store) == before


def test_ids_live_on_when_keyframes_come_and_go(store: Store) -> None:
    info = ingest(store, range(4))
    refine(store, info)
    before = things(store)
    info = ingest(store, range(4, FRAMES))
    assert not next(item for item in store.refinements(info.id) if item.kind == LANDMARKS).current
    assert refine(store, info) >= len(before)
    after = things(store)
    assert all(set(sightings) <= set(after[key]) for key, sightings in before.items())
    heads = store.keyframe_heads(info.id)
    store.delete_keyframes([head.id for head in heads if head.frame_index == 0])
    assert not next(item for item in store.refinements(info.id) if item.kind == LANDMARKS).current
    left = things(store)
    assert all(sighting[:2] != ("visit", 0) for sightings in left.values() for sighting in sightings)
    refine(store, info)
    assert set(things(store)) <= set(after)


def test_a_recording_that_was_moved_has_landmarks_in_its_new_map(tmp_path: Path) -> None:
    """Its objects were sightings of landmarks of the map that it came from."""
    with open_store(f"sqlite:///{tmp_path}/m.sqlite3", create=True) as store:
        room, own = ingest(store, [0], "room"), ingest(store, [3, 4], "own")
        refine(store, own)
        poses = dict(zip(*store.poses(own.id), strict=True))
        moved = MovedRecording(store.status(own.id)[0].recording_id, own.id, "second", np.eye(4))
        move(store.engine, Move(OperationKind.ALIGN, room.id, poses, poses, (moved,)))
        rows = refine(store, room)
        assert {name for sightings in things(store).values() for name, *_ in sightings} == {"visit", "second"}
        before = things(store)
        assert refine(store, own) == 0
        assert things(store) == before
        assert table(store, "SELECT map_id, COUNT(*) FROM landmarks GROUP BY map_id") == [(room.id, rows)]


def test_a_deleted_map_leaves_nothing(store: Store) -> None:
    info = ingest(store, range(3))
    refine(store, info)
    store.delete_map(info.id)
    for name in ("landmarks", "landmark_sightings", "landmark_views", "landmark_relations", "map_gravity"):
        assert table(store, f"SELECT COUNT(*) FROM {name}") == [(0,)], name


def test_up_that_somebody_knows_is_kept(store: Store) -> None:
    info = ingest(store, range(3))
    refine(store, info)
    estimated = load_gravity(store.engine, info.id)
    assert estimated is not None
    assert estimated.up == pytest.approx((0, 0, 1), abs=0.02)
    assert not estimated.given
    give_up(store.engine, info.id, (0.0, 1.0, 0.0))
    refine(store, info, force=True)
    told = load_gravity(store.engine, info.id)
    assert told is not None
    assert told.up == (0.0, 1.0, 0.0)
    assert told.given
    give_up(store.engine, info.id, None)
    with store.engine.begin() as connection:  # as if poses had been estimated, and turned upright
        upright = "pose_source = 'estimated', world = 'first_keyframe', upright = 1"
        connection.execute(text(f"UPDATE pose_sources SET {upright}"))
    refine(store, info, force=True)
    known = load_gravity(store.engine, info.id)
    assert known is not None
    assert known.up == (0.0, 0.0, 1.0)
    assert not known.given
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE pose_sources SET world = 'recording', pose_source = 'recorded'"))
    refine(store, info, force=True)
    assert load_gravity(store.engine, info.id) == estimated


def test_views_for_people(store: Store) -> None:
    info = ingest(store, range(FRAMES))
    refine(store, info)
    rows = table(store, "SELECT map, category, state, last_recording FROM landmark_list")
    assert {row[0] for row in rows} == {"room"}
    assert {row[3] for row in rows} == {"visit"}
    query = "SELECT category FROM landmark_relations_named WHERE kind = 'on' AND other_category = 'dining table'"
    assert {row[0] for row in table(store, query)} == {"bottle", "bowl", "cup", "laptop", "wine glass"}


def test_ids_go_to_whoever_shares_most() -> None:
    kept = keep_ids({1: 7, 2: 7, 3: 7, 4: 8, 5: 9}, [[1, 9], [2, 3, 4], [5, 6], [11]])
    assert kept.ids == (None, 7, 9, None)
    assert kept.merged == {8: 1}


def test_damaged_rows_are_left_out_aloud(store: Store) -> None:
    info = ingest(store, range(4))
    said: list[str] = []
    told = Store(store.engine, said.append)
    whole = refine(told, info)
    heads = {head.frame_index: head.id for head in store.keyframe_heads(info.id)}
    with store.engine.begin() as connection:
        broken = {"key": heads[1], "bytes": b"no picture"}
        connection.execute(text("UPDATE keyframe_images SET depth = :bytes WHERE keyframe_id = :key"), broken)
        connection.execute(
            text("UPDATE objects SET mask = :bytes WHERE keyframe_id = :key AND ordinal = 0"),
            {"key": heads[2], "bytes": b"no mask"},
        )
    assert 0 < refine(told, info, force=True) <= whole
    assert any("keyframe_images.depth" in line for line in said)
    assert any("objects.mask" in line for line in said)
    shown = {sighting[1] for sightings in things(store).values() for sighting in sightings}
    assert shown == {0, 3}
    known = {head.id: head.frame_index for head in store.keyframe_heads(info.id)}
    (camera,) = store.cameras(info.id)
    landmark, keyframe, boxes = sighting_boxes(store.engine, info.id, camera)
    rows = sum(len(sightings) for sightings in things(store).values())
    assert landmark.tolist() == sorted(landmark.tolist())
    assert {known[one] for one in keyframe.tolist()} == shown
    assert boxes.shape == (rows, 4)
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE objects SET x1 = 1e9 WHERE keyframe_id = :key"), {"key": heads[3]})
    left = sighting_boxes(store.engine, info.id, camera)
    assert {known[one] for one in left[1].tolist()} == {0}
    assert (boxes[:, 2:] >= boxes[:, :2]).all()
    assert len(sighting_boxes(store.engine, info.id, replace(camera, fx=camera.fx + 1))[0]) == 0  # took none
