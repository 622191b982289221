"""`semdb refine --frames`: what frames beside the keyframes show, kept and used."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import semdb
from semdb.cli.main import app
from semdb.database.frame_views import FrameHead, FrameRow, load_frame_heads, load_frames, write_frame_views
from semdb.database.store import Store, open_store
from semdb.errors import RecordingError, UsageError
from semdb.evaluation.runner import EvaluateOptions, evaluate
from semdb.geometry import pose_error
from semdb.ingestion.frames import add_frames
from semdb.localization.images import make_localizer
from semdb.localization.localizer import Localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.perception.describe import Describer, describer_from_specs
from semdb.recordings import open_recording
from semdb.settings import Settings
from semdb.types import Verdict

KEYFRAMES = 3


@pytest.fixture(scope="module")
def url(room: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    made = f"sqlite:///{tmp_path_factory.mktemp('frames') / 'semdb.sqlite3'}"
    with semdb.open(made, detector="recorded", encoder="gist", features="surf", threads=1) as db:
        db.ingest(room, map="room", keyframes=KEYFRAMES)
        assert [(one.frames > 2, one.keyframes) for one in db.add_frames(room)] == [(True, KEYFRAMES)]
    return made


@pytest.fixture
def store(url: str) -> Store:
    return open_store(url)


def describer() -> Describer:
    return describer_from_specs("recorded", "gist", "surf", Settings(threads=1))


def localizer(store: Store, frames: int) -> Localizer:
    return make_localizer(store, store.find_map("room"), "sql", LocalizerOptions(frames=frames))


def test_frames_lie_where_they_were_and_are_used(room: Path, store: Store) -> None:
    recording = open_recording(room)
    entries = {entry.index: entry for entry in recording.entries}
    ids, poses = localizer(store, 2).cache.poses()
    heads = load_frame_heads(store.engine, 1)
    used = {head.frame_index for head in heads}
    assert used.isdisjoint(head.frame_index for head in store.keyframe_heads(1))
    for head in heads:
        placed = poses[ids.index(head.keyframe_id)] @ head.keyframe_from_camera
        metres, degrees = pose_error(placed, entries[head.frame_index].world_from_camera)
        assert metres < 1e-6
        assert degrees < 1e-4
        assert head.camera == recording.camera
    free = [entry for entry in recording.entries if entry.index not in used]
    keyframes = {head.frame_index for head in store.keyframe_heads(1)}
    support = {0: 0, 2: 0}
    for entry in [entry for entry in free if entry.index not in keyframes][:4]:
        frame = recording.read(entry)
        found = describer().describe(frame.image, None, frame.camera, frame.instances)
        for count in support:
            answer = localizer(store, count).localize(found)
            assert all(candidate.keyframe_id > 0 for candidate in answer.candidates)
            assert answer.best_keyframe_id is None or answer.best_keyframe_id in ids
            support[count] += answer.inliers
            if count:
                assert answer.verdict is Verdict.LOCALIZED
                assert pose_error(answer.world_from_camera, entry.world_from_camera)[0] < 0.03
    assert support[2] > 1.2 * support[0]


def test_again_the_same_rows_and_none_of_those_that_are_left_out(room: Path, store: Store) -> None:
    recording, info = open_recording(room), store.find_map("room")
    before = load_frames(store.engine, load_frame_heads(store.engine, 1))
    out = before[0].head.frame_index
    added = add_frames(store, info, recording, describer(), without=[out])
    assert out not in {head.frame_index for head in load_frame_heads(store.engine, 1)}
    again = add_frames(store, info, recording, describer())
    after = load_frames(store.engine, load_frame_heads(store.engine, 1))
    assert again.frames == len(after) == len(before)
    assert added.keyframes == KEYFRAMES
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one.keypoints.features.descriptors, other.keypoints.features.descriptors)
        np.testing.assert_array_equal(one.keypoints.points, other.keypoints.points)
        assert one.grey == other.grey


def test_a_map_without_them_answers_as_before(room: Path, store: Store) -> None:
    recording = open_recording(room)
    frame = recording.read(recording.entries[1])
    found = describer().describe(frame.image, None, frame.camera, frame.instances)
    without = localizer(store, 0).localize(found)
    heads = load_frame_heads(store.engine, 1)
    rows = load_frames(store.engine, heads)
    write_frame_views(store.engine, 1, [])
    nothing = localizer(store, 2).localize(found)
    write_frame_views(store.engine, 1, rows)
    np.testing.assert_array_equal(without.world_from_camera, nothing.world_from_camera)
    np.testing.assert_equal(dict(without.evidence), dict(nothing.evidence))


def test_what_is_no_recording_of_the_map_is_named(room: Path, store: Store, tmp_path: Path) -> None:
    recording, info = open_recording(room), store.find_map("room")
    with pytest.raises(UsageError, match="holds no keyframe of a recording 'other'"):
        add_frames(store, info, replace(recording, name="other"), describer())
    moved = []
    for number, entry in enumerate(recording.entries):
        pose = np.array(entry.world_from_camera)
        pose[0, 3] += 0.1 * number
        moved.append(replace(entry, world_from_camera=pose))
    with pytest.raises(RecordingError, match="otherwise in the map than the recording says"):
        add_frames(store, info, replace(recording, entries=tuple(moved)), describer())
    bare = tuple(replace(entry, world_from_camera=None) for entry in recording.entries)
    with pytest.raises(RecordingError, match="brings no pose of frame"):
        add_frames(store, info, replace(recording, entries=bare), describer())
    scaled = replace(recording, depth_scale=1234.0)
    with pytest.raises(RecordingError, match=r"depth scale.* are not those that the map 'room' was ingested with"):
        add_frames(store, info, scaled, describer())
    later = tuple(replace(entry, timestamp_ns=entry.timestamp_ns + 1) for entry in recording.entries)
    with pytest.raises(RecordingError, match="this is another recording"):
        add_frames(store, info, replace(recording, entries=later), describer())
    other = replace(recording, entries=recording.entries[:1])
    with pytest.raises(RecordingError, match="another recording of that name"):
        add_frames(store, info, other, describer())
    assert load_frame_heads(store.engine, 1)


def test_a_damaged_row_is_left_out(room: Path, store: Store, caplog: pytest.LogCaptureFixture) -> None:
    rows = load_frames(store.engine, load_frame_heads(store.engine, 1))
    head = rows[0].head
    broken = FrameRow(
        FrameHead(head.keyframe_id, head.frame_index, np.eye(4), head.camera, 1), rows[0].keypoints, b"no"
    )
    write_frame_views(store.engine, 1, [broken])
    recording = open_recording(room)
    frame = recording.read(recording.entries[head.frame_index])
    found = describer().describe(frame.image, None, frame.camera, frame.instances)
    assert localizer(store, 2).localize(found).verdict is not None
    assert "frame_views.grey of keyframe" in caplog.text
    write_frame_views(store.engine, 1, rows)


def test_a_frame_that_has_become_a_keyframe_is_not_there_twice(room: Path, url: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy.sqlite3"
    shutil.copy(url.removeprefix("sqlite:///"), copy)
    with semdb.open(f"sqlite:///{copy}", detector="recorded", encoder="gist", features="surf", threads=1) as db:
        db.ingest(room, map="room", keyframes=KEYFRAMES + 3)
    with open_store(f"sqlite:///{copy}") as store, open_store(url) as before:
        keyframes = {head.frame_index for head in store.keyframe_heads(1)}
        old = {head.frame_index for head in load_frame_heads(before.engine, 1)}
        assert len(keyframes) == KEYFRAMES + 3
        assert keyframes & old
        assert {head.frame_index for head in load_frame_heads(store.engine, 1)} == old - keyframes


def test_a_map_that_is_open_takes_what_it_has_added(room: Path, url: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy.sqlite3"
    shutil.copy(url.removeprefix("sqlite:///"), copy)
    with open_store(f"sqlite:///{copy}") as store:
        write_frame_views(store.engine, 1, [])
    entry = open_recording(room).entries[5]
    with semdb.open(f"sqlite:///{copy}", detector="recorded", encoder="gist", features="surf", threads=1) as db:
        before = db.localize(room / entry.name, map="room").inliers
        db.add_frames(room)
        assert db.localize(room / entry.name, map="room").inliers > 1.2 * before


def test_a_map_that_is_open_elsewhere_takes_them_at_the_next_query(room: Path, url: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy.sqlite3"
    shutil.copy(url.removeprefix("sqlite:///"), copy)
    with open_store(f"sqlite:///{copy}") as store:
        rows = load_frames(store.engine, load_frame_heads(store.engine, 1))
        write_frame_views(store.engine, 1, [])
        entry = open_recording(room).entries[5]
        with semdb.open(f"sqlite:///{copy}", detector="recorded", encoder="gist", features="surf", threads=1) as db:
            before = db.localize(room / entry.name, map="room").inliers
            write_frame_views(store.engine, 1, rows)  # another program
            assert db.localize(room / entry.name, map="room").inliers > 1.2 * before
            write_frame_views(store.engine, 1, [])
            assert db.localize(room / entry.name, map="room").inliers == before
            assert [step.kind for step in db.status().refinements] == []


def test_frames_that_cannot_be_read_are_named(room: Path, url: str, tmp_path: Path) -> None:
    shutil.copytree(room, tmp_path / room.name)
    shutil.copy(url.removeprefix("sqlite:///"), tmp_path / "copy.sqlite3")
    with open_store(f"sqlite:///{tmp_path / 'copy.sqlite3'}") as store:
        recording = open_recording(tmp_path / room.name)
        free = {entry.index for entry in recording.entries} - {head.frame_index for head in store.keyframe_heads(1)}
        broken = next(entry for entry in recording.entries if entry.index == min(free))
        assert broken.depth_path is not None
        broken.depth_path.write_bytes(broken.depth_path.read_bytes()[:200])
        added = add_frames(store, store.find_map("room"), recording, describer())
        assert added.frames
        assert [broken.depth_path.name in line for line in added.failed] == [True]
        assert min(free) not in {head.frame_index for head in load_frame_heads(store.engine, 1)}


def test_frames_of_other_descriptors_are_left_out(room: Path, store: Store) -> None:
    recording = open_recording(room)
    frame = recording.read(recording.entries[1])
    found = describer().describe(frame.image, None, frame.camera, frame.instances)
    rows = load_frames(store.engine, load_frame_heads(store.engine, 1))
    features = [one.keypoints.features for one in rows]
    short = [replace(one, descriptors=np.ascontiguousarray(one.descriptors[:, :32])) for one in features]
    broken = [
        replace(row, keypoints=replace(row.keypoints, features=one)) for row, one in zip(rows, short, strict=True)
    ]
    write_frame_views(store.engine, 1, broken)
    without, answer = (localizer(store, count).localize(found) for count in (0, 2))
    write_frame_views(store.engine, 1, rows)
    np.testing.assert_array_equal(answer.world_from_camera, without.world_from_camera)


def test_a_copy_of_a_map_has_them_and_smaller_keyframes_leave_them(url: str, tmp_path: Path) -> None:
    with semdb.open(url) as db:
        db.export("semdb", "room", tmp_path / "out")
    made = f"sqlite:///{tmp_path / 'other.sqlite3'}"
    with semdb.open(made) as db:
        db.import_map(tmp_path / "out", map="copy")
        db.compact("copy")
    with open_store(url) as store, open_store(made) as copy:
        own = load_frames(store.engine, load_frame_heads(store.engine, 1))
        theirs = load_frames(copy.engine, load_frame_heads(copy.engine, 1))
        assert [one.head.frame_index for one in own] == [one.head.frame_index for one in theirs]
        for one, other in zip(own, theirs, strict=True):
            assert one.grey == other.grey
            np.testing.assert_array_equal(one.keypoints.points, other.keypoints.points)


def test_the_command(room: Path, url: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy.sqlite3"
    shutil.copy(url.removeprefix("sqlite:///"), copy)
    run = CliRunner().invoke(app, ["refine", "--frames", str(room), "--database-url", f"sqlite:///{copy}"])
    assert run.exit_code == 0, run.output
    assert f"frames beside {KEYFRAMES} keyframes" in run.output
    again = ["refine", "--frames", f"file://{room}", "--database-url", f"sqlite:///{copy}"]
    assert CliRunner().invoke(app, again, env={"SEMDB_CACHE_DIR": str(tmp_path / "cache")}).output == run.output
    for words, said in ((["--name", "other"], "'other'"), (["--camera", "200,200,159.5,119.5"], "its camera")):
        asked = ["refine", "--frames", str(room), "--map", "room", "--database-url", f"sqlite:///{copy}", *words]
        run = CliRunner().invoke(app, asked)
        assert run.exit_code != 0
        assert said in str(run.exception) + run.output
    run = CliRunner().invoke(app, ["refine", "--name", "room", "--database-url", f"sqlite:///{copy}"])
    assert run.exit_code == 2
    assert "--name: only with --frames" in run.output
    for extra in (["--step", "points"], ["--up", "0,0,1"], ["--force"]):
        run = CliRunner().invoke(app, ["refine", "--frames", str(room), "--database-url", f"sqlite:///{copy}", *extra])
        assert run.exit_code == 2
    with open_store(f"sqlite:///{copy}") as store:
        heads = load_frame_heads(store.engine, 1)
        gone = heads[0].keyframe_id
        store.delete_keyframes([gone])
        left = load_frame_heads(store.engine, 1)
        assert {head.keyframe_id for head in left} == {head.keyframe_id for head in heads} - {gone}


def test_the_row_of_evaluations_has_frames_that_are_far_from_queries(room: Path, tmp_path: Path) -> None:
    settings = Settings(detector="recorded", encoder="gist", database_url=f"sqlite:///{tmp_path}/x", threads=1)
    methods = ("semdb", "semdb-frames")
    own, frames = evaluate([room], settings, EvaluateOptions(methods, keyframes=(3,), max_queries=3))
    assert (own.method, frames.method) == methods
    assert own.localized <= frames.localized == 3
    inliers = [sum(query.inliers for query in result.per_query) for result in (own, frames)]
    assert inliers[1] > inliers[0]
    with pytest.raises(UsageError, match="has none to add: ask fewer"):
        evaluate([room], settings, EvaluateOptions(methods[1:], keyframes=(3,), max_queries=12))
