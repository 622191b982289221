"""What `semdb.connect` answers is what `semdb.open` answers, bit for bit."""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import semdb
from semdb.api import Answer, Database
from semdb.door.tracked import Tracked
from semdb.door.values import Keyframe, SeenObject
from semdb.errors import DatabaseError, FrameError, NotFoundError, UsageError
from semdb.service.settings import ServeSettings
from semdb.types import Frame
from tests.conftest import REPOSITORY
from tests.integration.opened import Opening, opener, same
from tests.integration.test_docs import blocks
from tests.serving import Served, running


@pytest.fixture(scope="module")
def served(offices: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A service of this process on two maps: one of masks that come with images, one of networks."""
    folder = tmp_path_factory.mktemp("asked")
    shutil.copytree(offices, folder, dirs_exist_ok=True)
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        auto = dict.fromkeys(("detector", "encoder", "features"), "auto")
        roots = ServeSettings(ingest_roots=str(room.parent), sql_rows=5, rate=0)
        with running(opening(**auto), roots) as found:
            yield found


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def db(served: Served, said: list[str]) -> Iterator[semdb.RemoteDatabase]:
    with semdb.connect(served.url, say=said.append) as connected:
        yield connected


def equal_objects(one: SeenObject, other: SeenObject) -> bool:
    def bits(thing: SeenObject) -> Any:
        places = [None if value is None else value.tobytes() for value in (thing.position, thing.extent)]
        return thing.category, thing.score, thing.box.tobytes(), *places, thing.id, thing.size, thing.packed

    return bits(one) == bits(other)


def equal(one: Answer, other: Answer) -> bool:
    assert one.world_from_camera is None or other.world_from_camera is not None
    if one.world_from_camera is not None and one.covariance is not None:
        assert np.array_equal(one.world_from_camera, other.world_from_camera)  # type: ignore[arg-type]
        assert np.array_equal(one.covariance, other.covariance)  # type: ignore[arg-type]
    assert len(one.objects) == len(other.objects)
    assert all(map(equal_objects, one.objects, other.objects))
    return same(one, other)


def equal_keyframes(one: Keyframe, other: Keyframe) -> bool:
    names = ("id", "map", "recording", "frame_index", "timestamp_ns", "camera")
    return [getattr(one, name) for name in names] == [getattr(other, name) for name in names] and np.array_equal(
        one.world_from_camera, other.world_from_camera
    )


def test_images_files_and_frames(
    served: Served, db: semdb.RemoteDatabase, frames: list[Frame], room: Path, said: list[str]
) -> None:
    own = served.database
    found = db.localize(frames[6], map="office", name="x")
    assert found.localized
    assert equal(found, own.localize(frames[6], map="office", name="x"))
    image = frames[13].image
    first, second = db.localize([image, frames[0].image], map="a/b")
    assert all(map(equal, (first, second), own.localize([image, frames[0].image], map="a/b")))
    assert said == ["camera of the images: that of the map's keyframes (--camera or --like name another)"]
    file = sorted((room / "rgb").iterdir())[5]  # with the masks and camera of the recording that it belongs to
    assert equal(db.localize(file), own.localize(file))
    with_depth = {"depth": frames[7].depth, "camera": frames[7].camera, "map": "a/b", "name": "d"}
    assert equal(db.localize(frames[7].image, **with_depth), own.localize(frames[7].image, **with_depth))
    like = {
        "like": "stairs",
        "map": "a/b",
        "name": "l",
        "depth": np.nan_to_num(frames[7].depth * 5000).astype(np.uint16),
    }
    assert equal(db.localize(frames[7].image, **like), own.localize(frames[7].image, **like))
    assert len(said) == 2
    assert db.localize(frames[6], map="office", masks=False).objects[0].size == (0, 0)
    with pytest.raises(ValueError, match="no picture"):
        found.picture()


def same_tracks(found: list[Tracked], wanted: list[Tracked]) -> bool:
    def bits(one: Tracked) -> Any:
        arrays = (one.world_from_camera, one.covariance, one.map_from_odom)
        return [None if array is None else array.tobytes() for array in arrays], replace(
            one, world_from_camera=None, covariance=None, map_from_odom=None, latency_ms=0.0
        )

    plain = [
        [name for name in Tracked.__slots__ if getattr(bits(a)[1], name) != getattr(bits(b)[1], name)]
        for a, b in zip(found, wanted, strict=True)
    ]
    assert plain == [[]] * len(found)
    return [bits(one)[0] for one in found] == [bits(one)[0] for one in wanted]


def test_cameras_are_tracked(served: Served, db: semdb.RemoteDatabase, frames: list[Frame], room: Path) -> None:
    own = served.database
    odometry = [None if number == 1 else frame.world_from_camera for number, frame in enumerate(frames[5:11])]

    def tracked(base: Any, shown: list[Any], **options: Any) -> list[Tracked]:
        tracker = base.tracker(**options)
        return [
            tracker.update(one, odometry=known, time_s=0.1 * number)
            for number, (one, known) in enumerate(zip(shown, odometry[: len(shown)], strict=True))
        ]

    shown: list[Any] = list(frames[5:11])
    found = tracked(db, shown, map="office")
    assert same_tracks(found, tracked(own, shown, map="office"))
    assert [str(one.state) for one in found][-3:] == ["tracking"] * 3
    pictures = [frame.image for frame in shown[:3]]
    numbers = {"map": "a/b", "camera": frames[0].camera}
    assert same_tracks(tracked(db, pictures, **numbers), tracked(own, pictures, **numbers))
    like = {"map": "a/b", "like": "stairs"}
    assert same_tracks(tracked(db, pictures, **like), tracked(own, pictures, **like))
    with db.tracker("a/b") as one, pytest.raises(UsageError, match="rigid pose"):
        one.update(pictures[0], odometry=np.zeros((3, 3)))
    asked: dict[str, Any] = {"map": "office", "every": 4, "query_depth": True}
    assert same_tracks(list(db.track_recording(room, **asked)), list(own.track_recording(room, **asked)))
    with db.tracker("office") as one:
        one.update(frames[5])
        served.service.sessions._live.clear()  # as after a minute, or of another process
        late = one.update(frames[6])
        assert (str(late.source), late.map) == ("relocalised", "office")
        served.service.secret = b"another one, as after a restart"
        assert str(one.update(frames[7]).source) == "relocalised"
    for ask in (lambda base: base.tracker("attic"), lambda base: base.tracker(), lambda base: base.tracker(like="x")):
        with pytest.raises(semdb.SemdbError) as local:
            ask(own)
        with pytest.raises(type(local.value)):
            ask(db)


def test_recordings(served: Served, db: semdb.RemoteDatabase, room: Path) -> None:
    asked: dict[str, Any] = {"map": "office", "every": 9, "query_depth": True}
    found, wanted = list(db.localize_recording(room, **asked)), list(served.database.localize_recording(room, **asked))
    assert len(found) == len(wanted) > 1
    assert all(map(equal, found, wanted))


def test_what_is_there(served: Served, db: semdb.RemoteDatabase) -> None:
    own = served.database
    db.check()
    assert db.maps() == own.maps()
    assert (db.map("a/b"), db.models("office")) == (own.map("a/b"), own.models("office"))
    assert (db.recordings(), db.recordings("a/b")) == (own.recordings(), own.recordings("a/b"))
    assert db.recording("stairs") == own.recording("stairs")
    assert (db.tables(), db.loops()) == (own.tables(), [])
    listed, wanted = db.keyframes("office"), own.keyframes("office")
    assert len(listed) == len(wanted)
    assert all(map(equal_keyframes, listed, wanted))
    ids = [one.id for one in listed]
    assert [one.id for one in db.keyframes("office", "room", after=ids[0], limit=2)] == ids[1:3]
    assert [one.id for one in db.keyframes(ids=[ids[2], ids[0], ids[2]])] == [ids[0], ids[2]]
    keyframe, local = db.keyframe(ids[2]), own.keyframe(ids[2])
    assert equal_keyframes(keyframe, local)
    assert keyframe.kept == {}
    assert np.array_equal(keyframe.image, local.image)
    assert np.array_equal(keyframe.depth, local.depth, equal_nan=True)  # type: ignore[arg-type]
    assert all(map(equal_objects, keyframe.objects, local.objects))
    assert keyframe.categories == local.categories
    for name in ("xy", "size", "angle", "response", "laplacian", "descriptors"):
        one, other = getattr(keyframe.keypoints.features, name), getattr(local.keypoints.features, name)
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    assert np.array_equal(keyframe.keypoints.points, local.keypoints.points, equal_nan=True)
    assert np.array_equal(keyframe.keypoints.object_index, local.keypoints.object_index)
    assert np.array_equal(keyframe.picture(), local.picture())


def test_rows_and_things(served: Served, db: semdb.RemoteDatabase) -> None:
    statement = "SELECT recording, frame_index FROM keyframe_objects ORDER BY 2, 1 LIMIT 3"
    with db.sql(statement) as rows, served.database.sql(statement) as wanted:
        assert (rows.columns, list(rows)) == (wanted.columns, list(wanted))
    with pytest.raises(DatabaseError, match="no more than these 5 rows"):
        list(db.sql(statement.replace("3", "50")))
    for what in ("SELEC 1", "DELETE FROM maps"):
        with pytest.raises((UsageError, DatabaseError)) as local:
            list(served.database.sql(what))
        with pytest.raises(type(local.value)):
            db.sql(what)
    found = db.find("chair", map="office", origin=(0, 0, 0), seen_after=0)
    assert found.as_dict() == served.database.find("chair", map="office", origin=(0, 0, 0), seen_after=0).as_dict()
    with pytest.raises(UsageError, match=r"semdb\.open only"):
        _ = found.sql
    with pytest.raises(NotFoundError):
        db.changes("room", "attic", "office")


def test_errors_are_those_of_the_library(served: Served, db: semdb.RemoteDatabase, frames: list[Frame]) -> None:
    image = frames[0].image
    for ask in (
        lambda base: base.map("attic"),
        lambda base: base.keyframe(10**6),
        lambda base: base.localize(image, map="attic"),
        lambda base: base.localize(image[:64], map="a/b"),
        lambda base: base.localize(b"no image", map="a/b"),
        lambda base: base.localize("none.png", map="a/b"),
        lambda base: base.localize(image.astype(float)),
        lambda base: base.localize(image, map="a/b", camera=(1, 2, 3)),
        lambda base: base.localize(image, map="a/b", like="attic"),
        lambda base: base.find("chair", map="attic"),
        lambda base: base.delete(map="attic"),
        lambda base: base.recording("attic"),
    ):
        with pytest.raises(semdb.SemdbError) as local:
            ask(served.database)
        with pytest.raises(semdb.SemdbError) as remote:
            ask(db)
        assert type(remote.value) is type(local.value), (local.value, remote.value)
    without_masks = {"map": "office", "camera": frames[0].camera, "name": "photo"}
    assert equal(db.localize(image, **without_masks), served.database.localize(image, **without_masks))
    unread: list[FrameError] = []
    answers = list(db.localize_each([b"none", image], map="a/b", unreadable=unread.append))
    assert (len(answers), len(unread), answers[0].image) == (1, 1, "image 1")


def test_ingesting_and_deleting(served: Served, db: semdb.RemoteDatabase, room: Path, frames: list[Frame]) -> None:
    told: list[tuple[str, int, int]] = []

    def progress(*line: Any) -> None:
        told.append(line)

    [sent] = db.ingest(room, map="sent", stride=12, progress=progress)
    [by_path] = db.ingest("room", map="by path", stride=12, name="r", upload=False)
    assert (sent.recording, sent.planned, sent.stored, by_path.recording) == ("room", 2, 2, "r")
    assert {line[0] for line in told} >= {"packing room", "sending room.zip"}
    [from_memory] = db.ingest(iter(frames[::8]), map="a/b", name="live", keyframes=2)
    assert from_memory.stored == 2
    with served.database.sql("SELECT 1") as rows:
        assert list(rows) == [(1,)]
    for one, other in zip(db.keyframes("sent"), db.keyframes("by path"), strict=True):
        assert np.array_equal(one.image, other.image)
        assert np.array_equal(one.world_from_camera, other.world_from_camera)
    first = db.keyframes("sent")[0].id
    assert db.delete(keyframes=[first]).keyframes == 1
    assert db.delete(recording="live").keyframes == 2
    assert db.delete(map="sent").keyframes == 1
    assert db.delete(map="by path", confirm=lambda would: would.keyframes == 2).recordings == 1
    assert [info.name for info in db.maps()] == ["office", "a/b"]
    with pytest.raises(UsageError, match="below the folders"):
        db.ingest("/etc", map="x", upload=False)


def test_asyncio(served: Served, frames: list[Frame]) -> None:
    async def ask() -> None:
        async with semdb.connect_async(served.url) as db:
            maps, answer, keyframes = await asyncio.gather(
                db.maps(), db.localize(frames[6], map="office", name="x"), db.keyframes("office", limit=1)
            )
            assert maps == served.database.maps()
            assert equal(answer, served.database.localize(frames[6], map="office", name="x"))
            keyframe = await db.load(keyframes[0], "image")
            assert list(keyframe.kept) == ["image"]
            images = [frames[0].image, frames[13].image]
            async with await db.tracker("office") as tracker:
                assert (tracker.map, (await tracker.update(frames[6])).image) == ("office", frames[6].name)
            names = [one.image async for one in db.localize_each(images, map="a/b")]
            assert names == ["image 0", "image 1"]

    asyncio.run(ask())


def test_the_program_of_the_page(
    served: Served, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """docs/python.md, with the address of this service."""
    first, second = blocks(REPOSITORY / "docs" / "python.md", ("py",))
    shutil.copy(sorted((room / "rgb").iterdir())[5], tmp_path / "photo.png")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SEMDB_TOKEN", raising=False)
    for program in (first, second):
        assert "http://robots.example:8765" in program
        own = program.replace("http://robots.example:8765", served.url).replace('"office"', '"a/b"')
        exec(compile(own, "page", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("localized [")
    assert "chair" in printed[1]
    assert printed[2].startswith("localized")


def test_twenty_clients_at_once(served: Served, frames: list[Frame]) -> None:
    wanted = json.dumps(_plain(served.database.localize(frames[6], map="office", name="x")))
    ends = time.monotonic() + 2

    def client(_: int) -> int:
        done = 0
        with semdb.connect(served.url) as db:
            while not done or time.monotonic() < ends:
                assert json.dumps(_plain(db.localize(frames[6], map="office", name="x"))) == wanted
                done += 1
        return done

    with ThreadPoolExecutor(20) as pool:
        assert sum(pool.map(client, range(20))) >= 20


def _plain(answer: Answer) -> dict[str, Any]:
    found = answer.as_dict()
    del found["timing_ms"]
    return found


def test_on_a_server(open_db: Opening, room: Path, frames: list[Frame]) -> None:
    database: Database = open_db()
    database.ingest(room, map="office", stride=12)
    with running(database, ServeSettings()) as served, semdb.connect(served.url) as db:
        found = db.localize(frames[13], map="office", name="x")
        assert equal(found, database.localize(frames[13], map="office", name="x"))
        assert all(map(equal_keyframes, db.keyframes("office"), database.keyframes("office")))
        tracks = []
        for base in (db, database):
            tracker = base.tracker("office")
            tracks.append([tracker.update(frame, time_s=0.1 * number) for number, frame in enumerate(frames[12:15])])
        assert same_tracks(*tracks)
        assert [str(one.state) for one in tracks[0]][-1] == "tracking"
