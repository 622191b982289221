"""Databases of RTAB-Map: calibration, compressions of depth, optimised poses against odometry."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import RecordingError
from semdb.geometry import pose_error
from semdb.recordings import open_recording
from semdb.recordings.rtabmap_calibration import parse_calibration
from tests.unit.recording_formats import PHONE, RtabmapPlan, rtabmap_camera_pose, write_rtabmap
from tests.unit.recording_miniatures import pose, render


@pytest.mark.parametrize("calibration", ["models", "floats"])
@pytest.mark.parametrize(
    ("depth", "factor", "error"), [("rvl", 1, 6e-4), ("png", 1, 6e-4), ("float", 1, 1.1e-4), ("rvl", 4, 0.06)]
)
def test_nodes_become_frames(tmp_path: Path, depth: str, factor: int, error: float, calibration: str) -> None:
    plan = RtabmapPlan(depth=depth, depth_factor=factor, calibration=calibration)
    recording = open_recording(write_rtabmap(tmp_path / "home.db", plan))
    assert (recording.format, recording.name, recording.total_frames) == ("rtabmap", "home", 4)
    assert recording.contents[0] == "RTAB-Map 0.23.8, 4 optimised poses"
    assert [entry.index for entry in recording.entries] == [1, 2, 3, 4]
    for i, frame in enumerate(recording.frames()):
        image, z = render(PHONE, pose(i))
        assert np.abs(frame.image.astype(float) - image).mean() < 3
        assert frame.depth is not None
        assert frame.world_from_camera is not None
        assert np.isfinite(frame.depth).mean() > (0.99 if factor == 1 else 0.9)
        assert np.nanmax(np.abs(frame.depth - z)) <= error
        assert max(pose_error(frame.world_from_camera, pose(i))) < 1e-4  # float32 in the file
        assert frame.timestamp_ns == (100 + i) * 10**9
        assert frame.camera == PHONE


def test_without_optimised_poses_it_is_odometry_and_said(tmp_path: Path) -> None:
    path = write_rtabmap(tmp_path / "home.db", RtabmapPlan(optimised=False))
    assert "odometry, which drifts; opened" in open_recording(path).notes[0]
    with sqlite3.connect(path) as connection:
        connection.executemany("INSERT INTO Link VALUES (?, ?, ?, x'', x'')", [(1, 2, 0), (4, 1, 1), (1, 4, 1)])
    recording = open_recording(path)
    assert "odometry, which drifts, and the 1 loop closure(s) in Link are not used" in recording.notes[0]
    assert len(recording.entries) == 4


def test_nodes_that_are_not_in_the_optimised_map_are_dropped(tmp_path: Path) -> None:
    path = write_rtabmap(tmp_path / "home.db")
    with sqlite3.connect(path) as connection:
        connection.execute("INSERT INTO Node SELECT 9, map_id, weight, stamp, pose, label FROM Node WHERE id = 1")
        connection.execute("INSERT INTO Data SELECT 9, image, depth, calibration FROM Data WHERE id = 1")
        connection.execute("UPDATE Data SET calibration = x'00' WHERE id = 2")
        connection.execute("UPDATE Data SET image = NULL WHERE id = 3")
        connection.execute("UPDATE Node SET weight = -1 WHERE id = 4")
    recording = open_recording(path)
    assert [entry.index for entry in recording.entries] == [1]
    reasons = {frame.name: frame.reason for frame in recording.dropped}
    assert reasons.pop("node 2").startswith("has a calibration of 1 bytes that is not known")
    assert reasons == {"node 3": "no image", "node 9": "is not in the optimised map"}


def test_cameras_side_by_side_are_frames_of_their_own(tmp_path: Path) -> None:
    recording = open_recording(write_rtabmap(tmp_path / "home.db", RtabmapPlan(cameras=2)))
    assert [entry.name for entry in recording.entries][:2] == ["node 1 camera 0", "node 1 camera 1"]
    assert len(recording.entries) == recording.total_frames == 8
    for number, frame in enumerate(recording.frames()):
        truth = rtabmap_camera_pose(number // 2, number % 2)
        image, z = render(PHONE, truth)
        assert np.abs(frame.image.astype(float) - image).mean() < 3
        assert frame.depth is not None
        assert frame.world_from_camera is not None
        assert np.nanmax(np.abs(frame.depth - z)) <= 6e-4
        assert max(pose_error(frame.world_from_camera, truth)) < 1e-4


def test_nodes_with_more_and_with_fewer_cameras_have_numbers_of_their_own(tmp_path: Path) -> None:
    path, other = write_rtabmap(tmp_path / "home.db", RtabmapPlan(cameras=2)), write_rtabmap(tmp_path / "one.db")
    with sqlite3.connect(path) as connection:
        connection.execute("ATTACH ? AS one", (str(other),))
        connection.execute("DELETE FROM main.Data WHERE id = 2")
        connection.execute("INSERT INTO main.Data SELECT * FROM one.Data WHERE id = 2")
    recording = open_recording(path)
    assert [entry.index for entry in recording.entries] == [2, 3, 4, 6, 7, 8, 9]
    assert [frame.index for frame in recording.frames()] == [2, 3, 4, 6, 7, 8, 9]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE Admin SET version = '0.10.4'", "was written by RTAB-Map 0.10.4; what is read is 0.11.10 and newer"),
        (
            "UPDATE Admin SET opt_poses = x'00112233445566778899aabbccddeeff'",
            "the optimised poses in Admin cannot be read",
        ),
        ("DELETE FROM Data", "has no nodes with data"),
    ],
)
def test_databases_that_cannot_be_read(tmp_path: Path, change: str, message: str) -> None:
    path = write_rtabmap(tmp_path / "home.db")
    with sqlite3.connect(path) as connection:
        connection.execute(change)
    with pytest.raises(RecordingError, match=message):
        open_recording(path)


def test_a_damaged_image_is_a_frame_that_cannot_be_decoded(tmp_path: Path) -> None:
    path = write_rtabmap(tmp_path / "home.db", RtabmapPlan(depth="rvl"))
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE Data SET image = substr(image, 1, 500) WHERE id = 2")
        connection.execute("UPDATE Data SET depth = CAST(substr(depth, 1, 200) AS BLOB) WHERE id = 3")
        connection.execute("UPDATE Data SET depth = image WHERE id = 4")
    recording = open_recording(path)
    assert [frame.index for frame in recording.frames()] == [1]
    reasons = [failure.reason for failure in recording.decode_failures]
    assert "node 2: the file ends too early" in reasons[0]
    assert "RVL stream does not give the pixels" in reasons[1]
    assert "is no depth image" in reasons[2]


def test_a_database_of_a_user_that_is_cut_off_is_still_one(shared_dir: Path, tmp_path: Path) -> None:
    whole = (shared_dir / "peers" / "rtabmap" / "rtab_henry.db").read_bytes()
    (tmp_path / "cut.db").write_bytes(whole[:215_000])
    with pytest.raises(RecordingError, match=r"cut\.db: cannot be read as a database of RTAB-Map: "):
        open_recording(tmp_path / "cut.db")


def test_a_database_of_a_user(shared_dir: Path) -> None:
    recording = open_recording(shared_dir / "peers" / "rtabmap" / "rtab_henry.db")
    assert recording.contents == (
        "RTAB-Map 0.21.1, 1 optimised poses",
        "Node: 1",
        "Link: 0",
        "Feature: 997",
        "Word: 310",
    )
    [frame] = recording.frames()
    assert frame.image.shape == (720, 1280, 3)
    assert frame.depth is not None
    assert np.isfinite(frame.depth).mean() > 0.5
    assert frame.camera.fx == pytest.approx(639.2545)
    assert frame.world_from_camera is not None


def test_calibrations_that_are_none() -> None:
    for data in (b"", b"\0" * 71, b"\0" * 72, b"\xff" * 400):
        with pytest.raises(ValueError, match="calibration"):
            parse_calibration(data)
