"""`semdb align`: visits of one rendered room come into one frame, other rooms do not."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from semdb.api import Answer, Database
from semdb.cli.main import app
from semdb.database.moving import move
from semdb.database.pose_records import Move, OperationKind
from semdb.errors import DatabaseError, NotFoundError, UsageError
from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp
from semdb.recordings import open_recordings
from semdb.recordings.base import Recording
from semdb.types import FloatArray
from tests.integration.opened import Opening, opener
from tests.rooms import SMALL, environment, render

MOTION = pose_from(so3_exp([0.4, -1.0, 2.0]), [7.0, -3.0, 1.5])
WALK = replace(SMALL, frames=40, lap_frames=40)
SPARSE = replace(WALK, frames=14, lap_frames=13)  # about every third frame of it


def part(path: Path, name: str, chosen: slice, motion: FloatArray = MOTION) -> Recording:
    """Some frames of a recording, in a frame of their own."""
    [found] = open_recordings(path)
    entries = [replace(entry, world_from_camera=motion @ entry.world_from_camera) for entry in found.entries[chosen]]
    return replace(found, name=name, entries=tuple(entries))


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("rooms")
    return {
        "room": render(folder / "room", WALK),
        "alike": render(folder / "alike", replace(SPARSE, alike=True)),
        "furniture": render(folder / "furniture", replace(SPARSE, furniture_seed=5)),
    }


@pytest.fixture(scope="module")
def filled(rooms: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> str:
    """A map of every other frame of a room, the others in a frame of their own, and rooms to be confused with it."""
    url = f"sqlite:///{tmp_path_factory.mktemp('align') / 'semdb.sqlite3'}"
    with opener(url, tmp_path_factory.mktemp("cache")) as opening:
        db = opening()
        fill(db, rooms)
        for name in ("alike", "furniture"):
            db.ingest(part(rooms[name], name, slice(None)), map=name, stride=1, check=False)
    return url


def fill(db: Database, rooms: dict[str, Path], frames: int = 40) -> None:
    db.ingest(part(rooms["room"], "first", slice(0, frames, 3), np.eye(4)), map="room", stride=1, check=False)
    db.ingest(part(rooms["room"], "second", slice(1, frames, 4)), map="own", stride=1, check=False)


@pytest.fixture
def db(filled: str, tmp_path: Path) -> Iterator[Database]:
    """A copy that a test may change."""
    copy = tmp_path / "semdb.sqlite3"
    copy.write_bytes(Path(filled.removeprefix("sqlite:///")).read_bytes())
    with opener(f"sqlite:///{copy}", tmp_path / "cache") as opening:
        yield opening()


def errors(db: Database, map: str, recording: str, motion: FloatArray, truth: dict[int, FloatArray]) -> FloatArray:
    return np.array([pose_error(motion @ truth[one.id], one.world_from_camera) for one in db.keyframes(map, recording)])


def ask(db: Database, folder: Path, number: int) -> Answer:
    image = sorted((folder / "rgb").iterdir())[number]
    return db.localize(image, map="room", like=folder)


def poses(db: Database, map: str, recording: str) -> dict[int, FloatArray]:
    return {one.id: one.world_from_camera for one in db.keyframes(map, recording)}


def test_a_second_visit_comes_back_on_every_server(open_db: Opening, rooms: dict[str, Path]) -> None:
    db = open_db()
    fill(db, rooms)
    before = poses(db, "own", "second")
    asked = ask(db, rooms["room"], 2)
    assert asked.localized
    report = db.align("second", map="room")
    assert report.convinced
    assert report.operation > 0
    assert (report.agreeing, report.rival) == (10, 0)
    found = errors(db, "room", "second", invert_pose(MOTION), before)
    assert np.median(found[:, 0]) < 0.002
    assert found[:, 0].max() < 0.005
    assert found[:, 1].max() < 0.2
    assert [(one.name, one.keyframes) for one in db.recordings("room")] == [("first", 14), ("second", 10)]
    assert db.recordings("own") == []
    links = db.loops("room")
    assert [link.kind for link in links] == ["session"] * len(links)
    assert len(links) == 10
    # what was open before follows, and the map that was left is empty
    again = ask(db, rooms["room"], 1)
    assert again.localized
    assert any(one.recording == "second" for one in again.candidates)
    db.undo_align("second")
    after = poses(db, "own", "second")
    assert after.keys() == before.keys()
    for key, pose in before.items():
        np.testing.assert_allclose(after[key], pose, atol=1e-12)


@pytest.mark.parametrize("name", ["alike", "furniture"])
def test_a_room_that_looks_alike_is_refused_both_ways(db: Database, name: str) -> None:
    before = poses(db, name, name), poses(db, "room", "first")
    for recording, there in ((name, "room"), ("first", name)):
        report = db.align(recording, map=there)
        assert not report.convinced, report
        assert report.operation == 0
    after = poses(db, name, name), poses(db, "room", "first")
    assert all(np.array_equal(b[key], a[key]) for b, a in zip(before, after, strict=True) for key in b)


def test_the_command(filled: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "semdb.sqlite3"
    copy.write_bytes(Path(filled.removeprefix("sqlite:///")).read_bytes())
    for name, value in environment(f"sqlite:///{copy}", SEMDB_CACHE_DIR=str(tmp_path)).items():
        monkeypatch.setenv(name, value)

    def run(*arguments: str) -> Result:
        return CliRunner().invoke(app, ["align", *arguments])

    dry = run("second", "--map", "room", "--dry-run")
    assert dry.exit_code == 0, dry.stderr
    assert dry.stdout.count("second/") == 10
    assert "would move from own to room; nothing is changed" in dry.stdout
    assert "shift m" in dry.stdout
    tried = run("second", "--map", "room", "--dry-run", "--joint", "--json")
    shown = json.loads(tried.stdout)
    assert (shown["convinced"], shown["moved"]) == (True, False)
    assert 0 < shown["map_shift_m"] < 0.005
    apart = [one["shift_m"] for one in shown["keyframes"]]  # MOTION, of this recording
    assert np.median(apart) > 0.5
    refused = run("alike", "--map", "room")
    assert refused.exit_code == 1
    assert "not moved: " in refused.stdout
    assert "nothing is changed" in refused.stdout
    named = run("second", "--map", "room", "--name", "first")
    assert named.exit_code == 2
    assert "the map 'room' has a recording 'first' already: give this one another name with --name" in named.stderr
    done = run("second", "--map", "room", "--name", "evening", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["convinced"], found["moved"], found["agreeing"]) == (True, True, 10)
    assert {one["verdict"] for one in found["keyframes"]} == {"localized"}
    assert "evening" in CliRunner().invoke(app, ["status"]).stdout
    back = run("evening", "--undo")
    assert back.exit_code == 0, back.stderr
    assert "took back: second is in the map own again, its poses are what they were" in back.stdout
    again = run("second", "--undo")
    assert again.exit_code == 2
    assert "nothing has moved the recording 'second', or all of it was taken back" in again.stderr
    assert run("second").exit_code == 2
    assert "--undo takes no --name" in run("second", "--undo", "--name", "x").stderr


def test_maps_are_merged_and_the_map_may_move_too(db: Database) -> None:
    before = poses(db, "own", "second")
    report = db.align(map="room", source_map="own", joint=True)
    assert report.convinced
    assert report.map_shift_m < 0.005
    assert np.median(errors(db, "room", "second", invert_pose(MOTION), before)[:, 0]) < 0.003
    db.undo_align(map="room")
    assert len(poses(db, "own", "second")) == 10


def test_recordings_that_moved_with_the_map_are_taken_back_before_it(db: Database, rooms: dict[str, Path]) -> None:
    db.ingest(part(rooms["room"], "third", slice(2, 40, 5)), map="own", stride=1, check=False)
    there = {name: poses(db, "own", name) for name in ("second", "third")}
    first = poses(db, "room", "first")
    assert db.align(map="room", source_map="own", joint=True).convinced
    moved = poses(db, "room", "first")
    assert any(np.abs(moved[key] - first[key]).max() > 1e-6 for key in first)
    carries, other = "second", "third"
    with pytest.raises(UsageError, match=f"same step .--joint. as '{other}': take that back first"):
        db.undo_align(carries)
    assert all(np.array_equal(pose, moved[key]) for key, pose in poses(db, "room", "first").items())
    db.undo_align(other)
    db.undo_align(carries)
    for name, before in {**there}.items():
        assert all(np.allclose(pose, before[key]) for key, pose in poses(db, "own", name).items())
    assert all(np.allclose(pose, first[key]) for key, pose in poses(db, "room", "first").items())


def test_a_map_that_is_refined_while_it_is_aligned_with_is_noticed(open_db: Opening, rooms: dict[str, Path]) -> None:
    """Between looking and moving another process moves the map's keyframes: nothing of the alignment is written."""
    db = open_db()
    fill(db, rooms, 20)
    before = poses(db, "own", "second")
    store = db._store()
    kept = {one.id: one.world_from_camera for one in db.keyframes("room")}
    shift = pose_from(np.eye(3), [0.2, 0.0, 0.0])
    map_id = next(info.id for info in store.maps() if info.name == "room")

    def refined(what: str, done: int, total: int) -> None:
        if done == total:
            move(store.engine, Move(OperationKind.REFINE, map_id, kept, {key: shift @ p for key, p in kept.items()}))

    with pytest.raises(DatabaseError, match="was deleted or moved meanwhile, nothing is changed: run it again"):
        db.align("second", map="room", progress=refined)
    assert all(np.array_equal(pose, before[key]) for key, pose in poses(db, "own", "second").items())
    assert db.align("second", map="room").convinced


def test_an_estimated_map_bends_more_than_a_recorded_one(db: Database, tmp_path: Path) -> None:
    recorded = db.align("second", map="room", joint=True, dry_run=True)
    with closing(sqlite3.connect(tmp_path / "semdb.sqlite3")) as file, file:
        file.execute("UPDATE pose_sources SET pose_source = 'estimated'")
    estimated = db.align("second", map="room", joint=True, dry_run=True)
    assert recorded.convinced
    assert estimated.convinced
    assert estimated.map_shift_m > 2 * recorded.map_shift_m > 0


def test_what_cannot_be_aligned(db: Database) -> None:
    with pytest.raises(NotFoundError, match="there is no map 'hall'"):
        db.align("second", map="hall")
    with pytest.raises(NotFoundError, match="there is no recording 'third'"):
        db.align("third", map="room")
    with pytest.raises(UsageError, match="is in the map 'room' already"):
        db.align("first", map="room")
    with pytest.raises(UsageError, match="say what to align"):
        db.align(map="room")
    with pytest.raises(UsageError, match="say what to take back"):
        db.undo_align()
    db.align("second", map="room")
    with pytest.raises(UsageError, match="the map 'own' holds no recording"):
        db.align(map="room", source_map="own")
    with pytest.raises(UsageError, match="the map 'own' holds no keyframe"):
        db.align("second", map="own")
