"""Frames from memory become a recording like any other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.recordings import open_recording
from semdb.recordings.memory import DEPTH_SCALE, SOURCE, check_frame, make_frame, recording_of
from semdb.types import FROM_MEMORY, Camera, Frame, InstanceMasks

CAMERA = (30.0, 30.0, 15.5, 11.5)


def frame(index: int, **changes: Any) -> Frame:
    rng = np.random.default_rng(index)
    pose = np.eye(4)
    pose[0, 3] = index
    given: dict[str, Any] = {
        "image": rng.integers(0, 256, (24, 32, 3), dtype=np.uint8),
        "camera": CAMERA,
        "depth": rng.uniform(0.4, 6.0, (24, 32)).astype(np.float32),
        "world_from_camera": pose,
        "timestamp_ns": index * 10**8,
    }
    return make_frame(index, **(given | changes))


def test_frames_of_a_recording_come_back_as_they_are(room: Path) -> None:
    """What readers of files give goes through memory unchanged: the same bytes, depth, masks, poses, camera."""
    source = open_recording(room)
    with recording_of(source.frames(), "again") as recording:
        assert (recording.name, recording.format, recording.source) == ("again", FROM_MEMORY, SOURCE)
        assert (recording.total_frames, len(recording.entries)) == (24, 24)
        assert (recording.camera, recording.depth_scale) == (source.camera, source.depth_scale)
        assert recording.categories == source.categories or set(recording.categories or {}) <= set(source.categories)
        for entry, original in zip(recording.entries, source.entries, strict=True):
            found, wanted = recording.read(entry), source.read(original)
            for name in ("index", "name", "timestamp_ns", "camera", "image_bytes", "depth_bytes", "depth_scale"):
                assert getattr(found, name) == getattr(wanted, name), name
            np.testing.assert_array_equal(found.image, wanted.image)
            np.testing.assert_array_equal(found.depth, wanted.depth)
            np.testing.assert_array_equal(found.world_from_camera, wanted.world_from_camera)
            np.testing.assert_array_equal(found.instances.labels, wanted.instances.labels)
        folder = recording.path
        assert folder.is_dir()
    assert not folder.exists()


def test_arrays_are_kept_without_loss_and_depth_in_steps_of_a_fifth_of_a_millimetre() -> None:
    frames = [frame(index) for index in (0, 2, 5)]
    frames.append(frame(7, depth=None))
    with recording_of(iter(frames), "live") as recording:
        assert recording.depth_scale == DEPTH_SCALE == 5000
        for entry, given in zip(recording.entries, frames, strict=True):
            found = recording.read(entry)
            np.testing.assert_array_equal(found.image, given.image)
            if given.depth is None:
                assert found.depth is None
            else:
                np.testing.assert_allclose(found.depth, given.depth, atol=1.001e-4)
            assert found.camera == Camera(32, 24, *CAMERA)


def test_millimetres_are_exact() -> None:
    raw = np.random.default_rng(0).integers(200, 9000, (24, 32), dtype=np.uint16)
    given = frame(0, depth=raw, depth_scale=1000)
    with recording_of([given], "live", depth_scale=1000) as recording:
        np.testing.assert_array_equal(recording.read(recording.entries[0]).depth, given.depth)


def test_depth_that_is_too_far_is_missing_and_said() -> None:
    far = np.full((24, 32), 5.0, np.float32)
    far[0, 0] = 14.0
    with recording_of([frame(0), frame(1, depth=far)], "live") as recording:
        depth = recording.read(recording.entries[1]).depth
        assert np.isnan(depth[0, 0])
        assert np.isfinite(depth[0, 1])
        [note] = recording.notes
        assert note.startswith("1 frames have depth beyond 13.1 m")
    with recording_of([frame(1, depth=far)], "live", depth_scale=1000) as recording:
        assert recording.read(recording.entries[0]).depth[0, 0] == pytest.approx(14.0)
        assert recording.notes == ()


def test_cameras_may_differ() -> None:
    """As those of a telephone that focuses."""
    with recording_of([frame(0), frame(1, camera=(31, 31, 15.5, 11.5))], "live") as recording:
        cameras = [recording.read(entry).camera.fx for entry in recording.entries]
    assert cameras == [30, 31]


def test_frames_without_a_pose_and_out_of_order_are_taken() -> None:
    with recording_of([frame(3), frame(1, world_from_camera=None)], "live") as recording:
        assert [entry.index for entry in recording.entries] == [1, 3]
        assert recording.entries[0].world_from_camera is None


def test_a_frame_that_cannot_be_used_is_dropped_and_named() -> None:
    lost = replace(frame(1), world_from_camera=np.full((4, 4), np.nan))
    blind = replace(frame(2), depth=np.ones((3, 3), np.float32))
    with recording_of([frame(0), lost, blind, frame(3)], "live") as recording:
        assert [entry.index for entry in recording.entries] == [0, 3]
        assert recording.total_frames == 4
        reasons = {dropped.name: dropped.reason for dropped in recording.dropped}
    assert "not finite" in reasons["frame 1"]
    assert "[3, 3]" in reasons["frame 2"]


def endless(broken: Frame) -> Iterator[Frame]:
    while True:
        yield broken


def test_where_no_frame_is_usable_nobody_waits_for_the_end_of_a_live_camera() -> None:
    floats = replace(frame(0), image=np.zeros((24, 32, 3), np.float32))
    with pytest.raises(RecordingError, match=r"none of 10 frames can be used; the first: .*float32"):
        recording_of(endless(floats), "live").__enter__()
    with pytest.raises(RecordingError, match="live: none of 0 frames can be used"):
        recording_of([], "live").__enter__()


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (frame(0), "a frame with the index 0 came before"),
        (replace(frame(1), depth_bytes=b"png", depth_scale=None), "no depth_scale"),
        (replace(frame(1), depth_bytes=b"png", depth_scale=1000.0), "1000.0.* of the frames before .5000.0"),
        (replace(frame(1), instances=InstanceMasks(np.ones((24, 32), np.uint16), {1: "cup"})), "is 'cup'.*'chair'"),
    ],
)
def test_frames_that_contradict_each_other_are_refused(second: Frame, words: str) -> None:
    first = replace(frame(0), instances=InstanceMasks(np.ones((24, 32), np.uint16), {1: "chair"}))
    with pytest.raises(RecordingError, match=words):
        recording_of([first, second], "live").__enter__()


@pytest.mark.parametrize("value", [np.zeros((24, 32, 3), np.uint8), "a.png", None, {"image": 1}])
def test_what_is_no_frame_is_refused(value: Any) -> None:
    with pytest.raises(UsageError, match=r"frames are of semdb.Frame \(semdb.make_frame makes one\)"):
        check_frame(value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"index": -1}, "index=-1"),
        ({"index": 1.5}, "index=1.5"),
        ({"index": True}, "index=True"),
        ({"timestamp_ns": 1.5}, "timestamp_ns=1.5: a whole number of nanoseconds"),
        ({"camera": Camera(640, 480, 500, 500, 320, 240)}, "the image is 32x24, but its camera 640x480"),
        ({"instances": InstanceMasks(np.ones((24, 32), np.uint8), {1: "cup"})}, "uint16"),
        ({"instances": InstanceMasks(np.ones((24, 32), np.uint16), {2: "cup"})}, "no class for the label 1"),
    ],
)
def test_a_frame_with_something_wrong_says_what(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(FrameError, match=words):
        check_frame(replace(frame(1), **changes))


def test_numpy_integers_are_integers() -> None:
    found = check_frame(replace(frame(1), index=np.int64(4), timestamp_ns=np.uint64(7)))
    assert (found.index, found.timestamp_ns) == (4, 7)
    assert type(found.index) is int


def test_progress_and_an_error_of_the_source_leave_nothing(tmp_path: Path) -> None:
    def broken() -> Iterator[Frame]:
        yield frame(0)
        raise ConnectionError("the camera is gone")

    told: list[tuple[int, int]] = []
    with pytest.raises(ConnectionError):
        recording_of(broken(), "live", folder=tmp_path, progress=lambda *at: told.append(at)).__enter__()
    assert told == [(1, 0)]
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(RecordingError, match=r"frame 0: cannot be kept in .*: No space left on device; TMPDIR names"):
        recording_of([frame(0)], "live", folder=tmp_path).__enter__()
    assert list(tmp_path.iterdir()) == []
