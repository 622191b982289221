"""Recordings of phones and of other tools: poses, depth and colour are those of the room that was rendered."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import FrameError, RecordingError
from semdb.geometry import pose_error
from semdb.recordings import Recording, decode_depth, open_recording, parse_camera
from semdb.recordings.options import ReadOptions
from semdb.recordings.own_depth import DepthCamera, confident, in_color, near_edge, resized
from semdb.types import Camera
from tests.unit.recording_formats import (
    DEPTH,
    PHONE,
    UPRIGHT,
    write_nice_slam,
    write_polycam,
    write_record3d,
    write_redwood,
    write_scannet_folder,
    write_sens,
    write_stray,
)
from tests.unit.recording_miniatures import pose, render


def assert_frames(
    recording: Recording,
    indexes: dict[int, int],
    *,
    colour: float,
    depth: float,
    known: float,
    pose_tolerance: float = 1e-6,
) -> None:
    """`indexes` is frame index -> number of the pose. Errors: mean grey levels, metres; share of known depth."""
    assert [entry.index for entry in recording.entries] == list(indexes)
    assert recording.dropped == ()
    for entry in recording.entries:
        number = indexes[entry.index]
        frame = recording.read(entry)
        camera = recording.camera_of(entry)
        image, z = render(camera, pose(number))
        assert np.abs(frame.image.astype(float) - image).mean() <= colour
        assert frame.depth is not None
        assert frame.world_from_camera is not None
        valid = np.isfinite(frame.depth)
        assert valid.mean() >= known
        # coarse depth is off where two walls meet
        assert np.abs(frame.depth - z)[valid].max() <= depth
        assert np.percentile(np.abs(frame.depth - z)[valid], 80) <= 1e-3
        assert max(pose_error(frame.world_from_camera, pose(number))) < pose_tolerance
        assert frame.depth_bytes is not None
        # what is stored decodes to what was looked at
        again = decode_depth(frame.depth_bytes, "stored", frame.depth_scale or 0, (camera.width, camera.height))
        np.testing.assert_array_equal(again, frame.depth)


def opened(path: Path) -> tuple[Recording | None, str]:
    """The recording, or the message of the one error that is allowed."""
    try:
        return open_recording(path), ""
    except RecordingError as error:
        return None, str(error)


def test_stray_scanner(tmp_path: Path) -> None:
    recording = open_recording(write_stray(tmp_path / "scan"))
    assert (recording.format, recording.name, recording.camera) == ("stray_scanner", "scan", PHONE)
    # a border of half a depth pixel is not seen, nor the last column of depth
    assert_frames(recording, {i: i for i in range(5)}, colour=6, depth=0.08, known=0.9)
    frame = recording.read(recording.entries[0])
    assert frame.timestamp_ns == 10_000_000_000
    assert frame.depth is not None
    assert np.isnan(frame.depth[:, -5:]).all()
    assert not np.isnan(frame.depth[10:-10, 10:-10]).any()


def test_frames_of_a_video_can_be_asked_for_in_any_order(tmp_path: Path) -> None:
    recording = open_recording(write_stray(tmp_path / "scan"))
    in_order = [recording.read_image(entry) for entry in recording.entries]
    for i in (3, 1, 4, 0, 0):
        np.testing.assert_array_equal(recording.read_image(recording.entries[i]), in_order[i])


@pytest.mark.parametrize("archive", [True, False])
def test_record3d(tmp_path: Path, archive: bool) -> None:
    recording = open_recording(write_record3d(tmp_path / "room.r3d", archive=archive))
    assert (recording.format, recording.name) == ("record3d", "room")
    assert recording.camera_of(recording.entries[3]) == Camera(160, 120, 133.0, 133.0, 79.0, 60.5)
    assert_frames(recording, {i: i for i in range(4)}, colour=3, depth=0.06, known=0.9)
    assert [entry.timestamp_ns for entry in recording.entries[:2]] == [0, 33_333_333]


def test_record3d_upright(tmp_path: Path) -> None:
    recording = open_recording(write_record3d(tmp_path / "room.r3d", camera=UPRIGHT))
    assert_frames(recording, {i: i for i in range(4)}, colour=3, depth=0.06, known=0.9)


def test_polycam_takes_what_was_corrected(tmp_path: Path) -> None:
    recording = open_recording(write_polycam(tmp_path / "room"))
    assert recording.format == "polycam"
    assert recording.notes == ()
    assert_frames(recording, {i: i for i in range(4)}, colour=0, depth=0.06, known=0.9)
    assert recording.entries[1].timestamp_ns == 1_001_000_000_000
    assert recording.entries[1].name == "keyframes/corrected_images/1001000000.png"


def test_polycam_without_corrections_says_so(tmp_path: Path) -> None:
    recording = open_recording(write_polycam(tmp_path / "room", corrected=False))
    assert "not optimised" in recording.notes[0]
    assert_frames(recording, {i: i for i in range(4)}, colour=0, depth=0.06, known=0.9)


def test_sens_file_and_folder_with_one(tmp_path: Path) -> None:
    file = write_sens(tmp_path / "scene0000_00" / "scene0000_00.sens")
    for path in (file, file.parent):
        recording = open_recording(path)
        assert (recording.format, recording.name, recording.total_frames) == ("scannet", "scene0000_00", 4)
        # the depth camera is 2 cm to the right: 2 cm of the left border are not seen
        assert_frames(recording, {i: i for i in range(4)}, colour=3, depth=0.06, known=0.85, pose_tolerance=1e-4)


def test_sens_with_a_lost_pose(tmp_path: Path) -> None:
    recording = open_recording(write_sens(tmp_path / "room.sens", lost=2))
    assert [entry.index for entry in recording.entries] == [0, 1, 3]
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [("frame 2", "its pose was lost")]


def test_sens_cut_off_anywhere_reads_what_is_there_or_says_why(tmp_path: Path) -> None:
    whole = write_sens(tmp_path / "room.sens", n=3)
    data = whole.read_bytes()
    for length in [*range(0, 340, 17), *range(340, len(data), 997)]:
        whole.write_bytes(data[:length])
        recording, message = opened(whole)
        if recording is None:
            assert str(whole) in message
            continue
        assert "truncated" in recording.notes[0]
        assert len(list(recording.frames())) == len(recording.entries) < 3


def test_scannet_folder(tmp_path: Path) -> None:
    recording = open_recording(write_scannet_folder(tmp_path / "scene0000_00"))
    assert (recording.format, recording.camera) == ("scannet", PHONE)
    assert_frames(recording, {i: i for i in range(4)}, colour=0, depth=0.06, known=0.9)


def test_replica_as_nice_slam_has_it(tmp_path: Path) -> None:
    recording = open_recording(write_nice_slam(tmp_path / "replica" / "room0"))
    assert (recording.format, recording.depth_scale, recording.camera) == ("nice_slam", 6553.5, PHONE)
    assert_frames(recording, {i: i for i in range(4)}, colour=3, depth=1e-4, known=1)
    (tmp_path / "replica" / "cam_params.json").unlink()
    with pytest.raises(RecordingError, match="4 of 4 images have 160x120 pixels, none the 1200x680"):
        open_recording(tmp_path / "replica" / "room0")
    given = open_recording(tmp_path / "replica" / "room0", parse_camera("130,130,79,60.5"))
    assert "taken for a rendering of Replica" in given.notes[0]


def test_redwood(tmp_path: Path) -> None:
    folder = write_redwood(tmp_path / "loft")
    recording = open_recording(folder)
    assert (recording.format, recording.depth_scale, recording.camera) == ("redwood", 1000, PHONE)
    assert_frames(recording, {i + 1: i for i in range(4)}, colour=0, depth=6e-4, known=1)
    (folder / "trajectory.log").write_text("0 0 1\n1 0 0 0\n")
    with pytest.raises(RecordingError, match=r"trajectory.log: has 2 lines; blocks of five are needed"):
        open_recording(folder)
    (folder / "trajectory.log").unlink()
    assert "no trajectory .log" in open_recording(folder).notes[0]


WRITERS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "stray": (write_stray, "odometry.csv"),
    "record3d": (lambda path: write_record3d(path, archive=False), "metadata"),
    "polycam": (write_polycam, "keyframes/corrected_cameras/1001000000.json"),
    "scannet": (write_scannet_folder, "pose/1.txt"),
    "nice_slam": (write_nice_slam, "traj.txt"),
    "redwood": (write_redwood, "trajectory.log"),
}


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_an_option_mends_inverted_poses(tmp_path: Path, name: str) -> None:
    """Reading right files as inverted gives the inverse of what was read: the option reaches every reader."""
    write, _ = WRITERS[name]
    folder = write(tmp_path / "a" / "room")
    right = open_recording(folder).entries
    wrong = open_recording(folder, options=ReadOptions(poses_are="camera_from_world", axes="opencv")).entries
    plain = open_recording(folder, options=ReadOptions(axes="opencv")).entries
    for one, other, file in zip(right, wrong, plain, strict=True):
        assert one.world_from_camera is not None
        assert file.world_from_camera is not None
        assert other.world_from_camera is not None
        np.testing.assert_allclose(other.world_from_camera @ file.world_from_camera, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("name", sorted(WRITERS))
@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe\x00\x01", b"{}", b"[1, 2", b"nan " * 20, b"1 2 3\n" * 5, b'{"w": 1e400}']
)
def test_a_broken_list_is_one_error_or_dropped_frames(tmp_path: Path, name: str, content: bytes) -> None:
    write, file = WRITERS[name]
    folder = write(tmp_path / "a" / "room")
    (folder / file).write_bytes(content)
    recording, message = opened(folder)
    if recording is None:
        assert str(folder) in message
    else:
        assert len(recording.entries) < recording.total_frames or recording.notes


def test_missing_and_broken_parts_of_phones(tmp_path: Path) -> None:
    scan = write_stray(tmp_path / "scan")
    (scan / "depth" / "000002.png").unlink()
    (scan / "confidence" / "000001.png").write_bytes(b"no image")
    recording = open_recording(scan)
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [("frame 2", "no depth image")]
    assert len(list(recording.frames())) == 3
    assert "000001.png: is not an image" in recording.decode_failures[0].reason
    (scan / "rgb.mp4").write_bytes(b"no video")
    with pytest.raises(RecordingError, match=r"rgb.mp4: is no video that can be decoded"):
        open_recording(scan)
    archive = write_record3d(tmp_path / "room.r3d", archive=False)
    (archive / "rgbd" / "1.depth").write_bytes(b"bvx2broken")
    (archive / "rgbd" / "2.jpg").write_bytes(b"")
    (archive / "rgbd" / "3.conf").unlink()
    recording = open_recording(archive)
    assert [frame.index for frame in recording.frames()] == [0, 3]
    metadata = json.loads((archive / "metadata").read_text())
    (archive / "metadata").write_text(json.dumps(metadata | {"poses": metadata["poses"][:2]}))
    assert [(frame.name, frame.reason) for frame in open_recording(archive).dropped] == [
        ("rgbd/2.jpg", "no pose"),
        ("rgbd/3.jpg", "no pose"),
    ]
    (tmp_path / "other.r3d").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(RecordingError, match=r"other.r3d: is no .r3d archive"):
        open_recording(tmp_path / "other.r3d")


def test_medium_confidence_counts_away_from_edges() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, 4:] = 3.0
    sure = np.ones((6, 8), np.uint8)
    kept = confident(depth, sure)
    assert np.isnan(kept[:, 3:5]).all()
    assert np.isfinite(kept[:, :3]).all()
    assert np.isfinite(kept[:, 5:]).all()
    assert np.isfinite(confident(depth, sure * 2)).all()
    assert np.isnan(confident(depth, sure * 0)).all()
    assert near_edge(depth).sum() == 12


def test_coarse_depth_is_exact_on_planes_and_invents_nothing_at_edges() -> None:
    camera, own = PHONE, DEPTH
    _, z = render(own, pose(2))
    _, exact = render(camera, pose(2))
    found = in_color(z, DepthCamera(own, np.eye(4)), camera)
    depth = np.where(found.values > 0, found.values / found.scale, np.nan)
    inside = np.isfinite(depth)
    assert inside.mean() > 0.93  # all but the border
    # exact but where two walls meet
    assert np.percentile(np.abs(depth - exact)[inside], 90) < 2e-4
    step = np.full(z.shape, 1.0, np.float32)
    step[:, 20:] = 2.0
    values = in_color(step, DepthCamera(own, np.eye(4)), camera).values
    assert set(np.unique(values).tolist()) == {0, 5000, 10000}
    assert (values[60, 76:84] == 0).any()


def test_resized_cameras_see_the_same() -> None:
    small = resized(PHONE, 40, 30)
    # the corner between the first four pixels of colour is the middle between pixels of the small image too
    assert small.fx == PHONE.fx / 4
    assert small.cx == pytest.approx((PHONE.cx + 0.5) / 4 - 0.5)


def test_depth_of_another_size_is_refused(tmp_path: Path) -> None:
    folder = write_record3d(tmp_path / "room", archive=False)
    metadata = json.loads((folder / "metadata").read_text())
    (folder / "metadata").write_text(json.dumps(metadata | {"dw": 7}))
    recording = open_recording(folder)
    with pytest.raises(FrameError, match="has 4800 pixels, which is no known size of depth"):
        recording.read(recording.entries[0])
