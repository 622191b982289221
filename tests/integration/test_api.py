"""`semdb.open`: what programs do with a database, on every server."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import semdb
from semdb.api import Database
from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.errors import DatabaseError, NotFoundError, SchemaError, SemdbError, UsageError
from semdb.types import Frame
from tests.integration.opened import STRIDE, Opening, close_to


def test_recordings_become_rows_and_images_poses(open_db: Opening, room: Path, frames: list[Frame]) -> None:
    db = open_db()
    [summary] = db.ingest(room, map="office", stride=STRIDE)
    assert (summary.map_name, summary.recording, summary.stored) == ("office", "room", 6)
    [info] = db.maps()
    assert (info.name, info.keyframes, info.recordings) == ("office", 6, 1)
    assert [model.name for model in db.models("office")] == ["recorded", "gist", "surf"]
    [recording] = db.recordings("office")
    assert (recording.name, recording.keyframes) == ("room", 6)
    assert db.recording("room") == recording

    asked = frames[6]
    found = db.localize(asked, map="office")
    close_to(found, asked)
    assert (str(found.verdict), found.map, found.stage) == ("localized", "office", "filtered")
    assert 0.5 < found.confidence <= 1
    assert np.shape(found.covariance) == (6, 6)
    assert 0 < found.sigma_m < 0.05
    assert 0 < found.sigma_deg < 1
    assert set(found.timing_ms) >= {
        "decode",
        "detect",
        "encode",
        "features",
        "filter",
        "rank",
        "match",
        "pose",
        "total",
    }
    assert {thing.category for thing in found.objects} <= set(asked.instances.categories.values())
    biggest = max(found.objects, key=lambda thing: thing.mask.sum())
    assert biggest.mask.shape == (240, 320)
    assert biggest.position is not None
    assert np.linalg.norm(biggest.position - found.position) < 8
    assert "localized" in repr(found)
    assert found.candidates[0].recording == "room"
    with pytest.raises(ValueError, match="read-only"):
        found.world_from_camera[0, 3] = 0
    with pytest.raises(AttributeError):
        found.verdict = "failed"

    if db.url.startswith("sqlite"):  # a server has an account for it: tests/integration/test_readonly.py
        counted = db.sql("SELECT category, COUNT(*) AS n FROM keyframe_objects GROUP BY category")
        assert counted.columns == ("category", "n")
        assert sum(number for _, number in counted) == recording.objects
        [row] = db.sql("SELECT name, state FROM recordings").dicts()
        assert row == {"name": "room", "state": "complete"}
        with pytest.raises(UsageError, match="only queries"):
            db.sql("DELETE FROM maps")


def test_an_answer_and_a_keyframe_show_themselves(
    open_file: Opening, room: Path, frames: list[Frame], tmp_path: Path
) -> None:
    db = open_file()
    db.ingest(room, map="office", stride=STRIDE)
    for thing in (db.localize(frames[6]), db.keyframes("office")[1]):
        shown = cv2.imdecode(np.frombuffer(thing._repr_png_(), np.uint8), cv2.IMREAD_COLOR_RGB)
        assert shown.shape[0] > 700
        assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 1000
        saved = cv2.imread(str(thing.save(tmp_path / "a.png")), cv2.IMREAD_COLOR_RGB)
        np.testing.assert_array_equal(saved, shown)
    assert db.keyframes("office")[1].save(str(tmp_path / "a.JPG")).read_bytes().startswith(b"\xff\xd8")
    with pytest.raises(UsageError, match=r"are written as \.png or \.jpg"):
        db.keyframes("office")[1].save(tmp_path / "a.webp")


def test_keyframes_are_read_when_they_are_asked_for(open_db: Opening, room: Path, frames: list[Frame]) -> None:
    db = open_db()
    db.ingest(room, map="office", stride=STRIDE)
    listed = db.keyframes("office")
    assert [keyframe.frame_index for keyframe in listed] == [0, 4, 8, 12, 16, 20]
    assert [one.id for one in db.keyframes("office", "room", after=listed[1].id, limit=2)] == [
        listed[2].id,
        listed[3].id,
    ]
    keyframe, frame = db.keyframe(listed[2].id), frames[8]
    assert (keyframe.map, keyframe.recording, keyframe.camera) == ("office", "room", frame.camera)
    assert keyframe.timestamp_ns == frame.timestamp_ns
    np.testing.assert_allclose(keyframe.world_from_camera, frame.world_from_camera, atol=1e-12)
    np.testing.assert_array_equal(keyframe.image, frame.image)
    np.testing.assert_array_equal(keyframe.depth, frame.depth)
    assert keyframe.image is keyframe.image
    assert len(keyframe.keypoints) > 100
    labels = frame.instances.labels
    for thing in keyframe.objects:
        [label] = np.unique(labels[thing.mask])
        assert frame.instances.categories[int(label)] == thing.category
        assert thing.id is not None
    assert f"keyframe {keyframe.id}: room frame 8" in repr(keyframe)
    with pytest.raises(NotFoundError, match="no keyframe 99999"):
        db.keyframe(99999)
    with pytest.raises(NotFoundError, match="no recording 'attic'"):
        db.keyframes("office", "attic")
    with pytest.raises(NotFoundError, match="no map 'attic'"):
        db.keyframes("attic")
    db.delete(keyframes=[listed[0].id])
    with pytest.raises(NotFoundError):
        _ = listed[0].objects


def test_status_retry_refine_delete(open_db: Opening, room: Path) -> None:
    db = open_db()
    db.ingest(room, map="office", stride=STRIDE)
    db.ingest(room, map="attic", stride=8)
    status = db.status("office")
    assert [(item.map, item.keyframes) for item in status.recordings] == [("office", 6)]
    assert status.failed == ()
    assert "secret" not in status.url
    assert db.status().refinements == ()
    results = db.refine("office", steps=["classes"])
    assert [(result.kind, result.computed, result.current) for result in results] == [("classes", True, True)]
    assert [item.kind for item in db.status().refinements] == ["classes"]
    assert [number for _, number in db.retry()] == [0, 0]
    assert db.workers() == []
    assert db.unsent() == 0
    with pytest.raises(UsageError, match="each have a recording 'room'"):
        db.delete(recording="room")
    with pytest.raises(NotFoundError, match="no keyframe 99999"):
        db.delete(keyframes=[99999])
    with pytest.raises(UsageError, match="say what to delete"):
        db.delete()
    with pytest.raises(UsageError, match="either keyframes or"):
        db.delete(keyframes=[1], map="office")
    with pytest.raises(UsageError, match="--step"):
        db.refine(steps=["magic"])
    assert db.delete(keyframes=[db.keyframes("office")[0].id]).keyframes == 1
    assert db.delete(recording="room", map="office").keyframes == 5
    assert db.delete(map="attic").recordings == 1
    assert [info.name for info in db.maps()] == ["office"]


def test_a_closed_database_says_so(open_file: Opening, frames: list[Frame]) -> None:
    db = open_file()
    db.close()
    db.close()
    for ask in (
        db.maps,
        lambda: db.localize(frames[0]),
        lambda: db.sql("SELECT 1"),
        lambda: db.ingest(iter(frames), name="x"),
        lambda: db.keyframe(1),
    ):
        with pytest.raises(UsageError, match=r"closed: open it again with semdb\.open"):
            ask()


def test_opening_says_what_is_wrong(tmp_path: Path, mariadb_url: str) -> None:
    missing = f"sqlite:///{tmp_path / 'none.sqlite3'}"
    with semdb.open(missing) as db:
        with pytest.raises(SchemaError, match="there is no database"):
            db.maps()
        with pytest.raises(SemdbError, match="nowhere"):
            db.ingest("nowhere")
    assert list(tmp_path.iterdir()) == []
    for url, error, words in (
        ("postgres://x/y", UsageError, "not supported"),
        ("office.sqlite3", UsageError, "use sqlite:///FILE"),
        ("mysql+pymysql://ann:secret@127.0.0.1:9/semdb", DatabaseError, "does not answer"),
        (mariadb_url, SchemaError, "semdb init"),
    ):
        with pytest.raises(error, match=words) as caught:
            semdb.open(url)
        assert "secret" not in str(caught.value)
    for settings, words in (
        ({"threads": 0}, "threads=0: "),
        ({"device": "gpu"}, "device=gpu: "),
        ({"detectr": "recorded"}, "there is no setting 'detectr'; settings are database_url, "),
    ):
        with pytest.raises(UsageError, match=words):
            semdb.open(missing, **settings)


def test_init_makes_and_upgrades_the_schema(empty_url: str) -> None:
    settings = semdb.api.database.Settings(database_url=empty_url)
    with Database(settings) as db:
        first, second = db.init(), db.init()
        assert (first.before, first.now) == (None, schema.HEAD)
        assert (second.before, second.now, second.collation) == (schema.HEAD, schema.HEAD, None)
        assert db.maps() == []
    engine = make_engine(empty_url)
    assert schema.current_revision(engine) == schema.HEAD
    engine.dispose()


def test_what_is_assumed_is_said_to_the_logger(
    database_url: str, room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    copy = sorted((room / "rgb").iterdir())[6]
    with semdb.open(database_url, threads=1, cache_dir=tmp_path) as db:
        db.ingest(room, stride=STRIDE)
        db.localize(copy)
    lines = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "room: SEMDB_DETECTOR is not set: the masks that come with the recording are the detections" in lines
    assert f"camera of the images: that of the recording {room} they belong to" in lines
