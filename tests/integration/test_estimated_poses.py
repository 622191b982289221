"""Recordings without poses become maps: on every server, by workers too, and never beside others unasked."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from semdb.api import Database
from semdb.database.links import list_links, load_covariances
from semdb.database.pose_records import LinkKind, PoseSource, World
from semdb.database.pose_sources import load_planned_poses, recording_poses
from semdb.database.store import open_store
from semdb.errors import RecordingError, UsageError
from semdb.evaluation.trajectory_errors import trajectory_errors
from semdb.ingestion.queue import Workplace
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.recordings import open_recording
from semdb.settings import Settings
from semdb.types import FloatArray
from tests.integration.opened import MODELS, Opening
from tests.rooms import SMALL, render, semdb

WALK = replace(SMALL, frames=24, lap_frames=60)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FloatArray]:
    """A rendered recording that does not say where its camera was, and the truth."""
    folder = render(tmp_path_factory.mktemp("walk") / "walk", WALK)
    truth = np.array([entry.world_from_camera for entry in open_recording(folder).entries])
    (folder / "groundtruth.txt").unlink()
    return folder, truth


def off(db: Database, map: str, truth: FloatArray) -> float:
    """How far keyframes are from the truth after rigid alignment, RMSE in metres."""
    known = sorted(db.keyframes(map), key=lambda one: one.frame_index)
    poses = np.array([one.world_from_camera for one in known])
    indexes = [one.frame_index for one in known]
    return trajectory_errors(poses, truth[indexes], np.array(indexes) / 30).rmse_m


def test_a_map_without_poses_on_every_server(open_db: Opening, walk: tuple[Path, FloatArray]) -> None:
    folder, truth = walk
    said: list[str] = []
    db = open_db(say=said.append)
    [summary] = db.ingest(folder, stride=4)
    assert (summary.pose_source, summary.stored, summary.failed) == ("estimated", 6, {})
    assert any("it brings no poses: they are estimated from images and depth" in line for line in said)
    assert any("24 of 24 frames have an estimated pose" in line and "z is up" in line for line in said)
    assert off(db, "walk", truth) < 0.01
    store = db._store()
    known = recording_poses(store.engine, summary.recording_id)
    assert (known.source, known.world, known.upright) == (PoseSource.ESTIMATED, World.FIRST_KEYFRAME, True)
    assert len(load_planned_poses(store.engine, summary.recording_id)) == 24
    ids = store.keyframe_ids(store.find_map("walk").id)
    covariances = load_covariances(store.engine, ids)
    assert list(covariances) == ids
    assert all(np.sqrt(np.trace(value[:3, :3])) < 0.05 for value in covariances.values())
    [view] = KeyframeCache(store, store.find_map("walk").id).views(ids[-1:])
    assert view.pose_sigma is not None  # the fine step's prior on its pose
    assert 0 < view.pose_sigma[0] < 0.05
    odometry = [link for link in list_links(store.engine) if link.kind is LinkKind.ODOMETRY]
    assert [(link.first, link.second) for link in odometry] == list(pairwise(ids))
    # once more, and with more keyframes: poses are those of the plan
    said.clear()
    [again] = db.ingest(folder)
    assert (again.already_stored, again.stored) == (6, 0)
    [more] = db.ingest(folder, stride=2)
    assert (more.already_stored, more.stored) == (6, 6)
    assert not any("are estimated from" in line for line in said)
    assert off(db, "walk", truth) < 0.01
    frame = {one.id: one.frame_index for one in db.keyframes("walk")}
    steps = [(frame[one.first], frame[one.second]) for one in list_links(store.engine) if one.kind is LinkKind.ODOMETRY]
    assert sorted(steps) == sorted([*pairwise(range(0, 24, 4)), *pairwise(range(0, 24, 2))])
    assert all(abs(link.off_m) < 1e-6 for link in db.loops("walk", odometry=True) if not link.inliers)


def test_workers_take_poses_from_the_plan(open_file: Opening, walk: tuple[Path, FloatArray], tmp_path: Path) -> None:
    folder, truth = walk
    db = open_file()
    sent: list[tuple[int, str, tuple[int, ...]]] = []
    [summary] = db.queue([folder], lambda key, source, frames: sent.append((key, source, tuple(frames))), stride=6)
    assert summary.stored == 0
    assert [frames for _, _, frames in sent] == [(0, 6, 12, 18)]
    settings = Settings(database_url=db.settings.database_url, threads=1, cache_dir=tmp_path, **MODELS)
    outcome = Workplace(settings).do(*sent[0])
    assert (outcome.stored, outcome.failed, outcome.complete) == (4, {}, True)
    assert off(db, "walk", truth) < 0.01
    with open_store(db.settings.database_url) as store:
        assert len([one for one in list_links(store.engine) if one.kind is LinkKind.ODOMETRY]) == 3


def test_frames_are_not_mixed(open_file: Opening, walk: tuple[Path, FloatArray], room: Path) -> None:
    db = open_file()
    db.ingest(room, stride=12, map="m")
    with pytest.raises(UsageError, match=r"the map 'm' holds recordings already.*--align"):
        db.ingest(walk[0], map="m")
    with pytest.raises(RecordingError, match=r"brings no poses; --poses estimated"):
        db.ingest(walk[0], map="w", poses="recorded")
    with pytest.raises(UsageError, match="--poses guessed: known are recorded, estimated, auto"):
        db.ingest(walk[0], map="w", poses="guessed")
    with pytest.raises(UsageError, match="stored already with recorded poses"):
        db.ingest(room, map="m", poses="estimated")
    [summary] = db.ingest(room, stride=12, map="own", name="own", poses="estimated")
    assert summary.pose_source == "estimated"
    with pytest.raises(UsageError, match="the frame of the map 'own' is that of the estimated poses"):
        db.ingest(room, map="own", name="other", stride=12)
    assert [one.name for one in db.recordings("own")] == ["own"]


def test_colour_without_depth_is_one_clear_error(walk: tuple[Path, FloatArray], tmp_path: Path) -> None:
    folder = tmp_path / "colour"
    folder.mkdir()
    for name in ("rgb", "masks"):
        (folder / name).symlink_to(walk[0] / name)
    for name in ("rgb.txt", "camera.json"):
        (folder / name).write_bytes((walk[0] / name).read_bytes())
    done = semdb(
        "ingest", folder, url=f"sqlite:///{tmp_path / 'x.sqlite3'}", SEMDB_DETECTOR="recorded", SEMDB_ENCODER="gist"
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("semdb: ")
    assert "without depth no trajectory is found" in done.stderr
    assert "Traceback" not in done.stderr


def test_ingest_and_align(open_file: Opening, walk: tuple[Path, FloatArray], tmp_path: Path) -> None:
    """A recording without poses goes into a map that has recorded ones."""
    folder, truth = walk
    given = render(tmp_path / "given", replace(WALK, frames=20))
    db = open_file()
    db.ingest(given, map="room", stride=2, check=False)
    [summary] = db.ingest(folder, map="room", name="second", stride=3, align=True)
    assert summary.alignment is not None
    assert summary.alignment.convinced
    assert summary.map_name == "room"
    known = db.keyframes("room", "second")
    errors = [np.linalg.norm(one.world_from_camera[:3, 3] - truth[one.frame_index, :3, 3]) for one in known]
    assert np.median(errors) < 0.01
    [again] = db.ingest(folder, map="room", name="second", stride=3, align=True)
    assert (again.already_stored, again.stored, again.alignment) == (8, 0, None)
    other = render(tmp_path / "other", replace(WALK, room_seed=9))
    [lost] = db.ingest(other, map="room", stride=6, align=True)
    assert lost.alignment is not None
    assert not lost.alignment.convinced
    assert lost.map_name == "other"
    assert [one.name for one in db.recordings("room")] == ["given", "second"]
    with pytest.raises(UsageError, match="--align needs the map to find the recording in"):
        db.ingest(folder, align=True)
