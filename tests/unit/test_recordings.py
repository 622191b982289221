"""Every layout is recognised and read; poses, depth and masks are what was rendered."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import RecordingError, UsageError
from semdb.geometry import pose_error, rotation_from_quat_wxyz, slerp_wxyz
from semdb.recordings import open_recording, open_recordings, parse_camera
from semdb.recordings.association import nearest_pairs, parse_pose, parse_time_ns, pose_at, read_trajectory
from semdb.recordings.cameras import ICL_NUIM, ROS_DEFAULT, SEVEN_SCENES_COLOR, TUM_CAMERAS
from semdb.types import Camera
from tests.unit.recording_miniatures import (
    SMALL,
    depth_residuals,
    icl_pose,
    pose,
    render,
    write_camera_json,
    write_icl,
    write_seven_scenes,
    write_tum,
)


def test_tum_frames_have_exact_images_depth_times_and_poses(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path / "walk"))
    assert (recording.format, recording.name, recording.total_frames) == ("tum", "walk", 6)
    assert recording.camera == SMALL
    assert recording.depth_scale == 5000
    assert recording.dropped == ()
    frames = list(recording.frames())
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert [frame.timestamp_ns for frame in frames[:2]] == [100_000_000_000, 100_100_000_000]
    assert frames[2].name == "rgb/100.200000.png"
    image, depth = render(SMALL, pose(2))
    np.testing.assert_array_equal(frames[2].image, image)
    assert frames[2].depth is not None
    np.testing.assert_allclose(frames[2].depth, depth, atol=1.01e-4)  # half a unit of 0.2 mm, rounded
    assert frames[2].world_from_camera is not None
    np.testing.assert_allclose(frames[2].world_from_camera, pose(2), atol=1e-8)
    assert frames[2].image_bytes == (tmp_path / "walk/rgb/100.200000.png").read_bytes()
    assert frames[2].depth_scale == 5000
    assert frames[2].depth_registration == ""


def test_trajectory_length_is_the_sum_of_steps(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path / "walk", n=4))
    assert recording.trajectory_length() == pytest.approx(3 * np.linalg.norm([0.05, 0.03, 0.02]), abs=1e-6)


@pytest.mark.parametrize("name", ["freiburg1", "freiburg2", "freiburg3"])
def test_tum_camera_comes_from_the_folder_name(tmp_path: Path, name: str) -> None:
    camera = TUM_CAMERAS[name]
    folder = write_tum(tmp_path / f"rgbd_dataset_{name}_desk", n=1, camera=camera, camera_json=False)
    recording = open_recording(folder)
    assert recording.camera == camera
    assert recording.notes == ()


def test_tum_camera_of_an_unknown_folder_is_ros_default_and_says_so(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path / "my_walk", n=1, camera=ROS_DEFAULT, camera_json=False))
    assert recording.camera == ROS_DEFAULT
    assert "ROS' default" in recording.notes[0]


def test_camera_json_wins_over_the_name_and_an_explicit_camera_over_both(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "freiburg1_small", n=1)
    assert open_recording(folder).camera == SMALL
    explicit = open_recording(folder, parse_camera("51,52,31,23,0.1,0,0,0,0"))
    assert explicit.camera == Camera(64, 48, 51, 52, 31, 23, (0.1, 0, 0, 0, 0))
    assert explicit.camera.model == "OPENCV"


def test_depth_scale_of_camera_json_is_used(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    write_camera_json(folder, SMALL, depth_scale=2500)
    frame = next(open_recording(folder).frames())
    assert frame.depth is not None
    np.testing.assert_allclose(frame.depth, 2 * render(SMALL, pose(0))[1], atol=2.1e-4)


def test_poses_are_interpolated_between_samples(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    (folder / "groundtruth.txt").write_text(
        "99.990 0 0 0 0 0 0 1\n100.010 0.2 0.4 -0.2 0 0 0.19866933 0.98006658\n"  # 0.4 rad about z
    )
    world_from_camera = open_recording(folder).entries[0].world_from_camera
    assert world_from_camera is not None
    np.testing.assert_allclose(world_from_camera[:3, 3], [0.1, 0.2, -0.1], atol=1e-12)
    c, s = np.cos(0.2), np.sin(0.2)
    np.testing.assert_allclose(world_from_camera[:3, :3], [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-8)


def test_pose_at_takes_the_last_sample_at_the_end_and_nothing_beyond_20_ms(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    trajectory, notes = read_trajectory(tmp_path / "t.txt")
    assert notes == []
    end, gap = pose_at(trajectory, 2_019_000_000)
    assert end is not None
    assert (end[0, 3], gap) == (1.0, 19_000_000)
    assert pose_at(trajectory, 2_021_000_000) == (None, 21_000_000)
    assert pose_at(trajectory, 1_500_000_000) == (None, 500_000_000)


def test_frames_know_how_the_camera_turns_where_the_trajectory_does(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    sines = [np.sin(0.01 * i / 2) for i in range(-4, 5)]  # every 10 ms 0.01 rad about z, around 100 s
    (folder / "groundtruth.txt").write_text(
        "".join(
            f"{100 + 0.01 * i:.3f} 0 0 0 0 0 {s} {np.sqrt(1 - s * s)}\n"
            for i, s in zip(range(-4, 5), sines, strict=True)
        )
    )
    rate = open_recording(folder).entries[0].turn_rate
    assert rate is not None
    np.testing.assert_allclose(rate, [0, 0, 1], atol=1e-6)
    (folder / "groundtruth.txt").write_text("100 0 0 0 0 0 0 1\n")
    assert open_recording(folder).entries[0].turn_rate is None


def test_association_is_one_to_one_and_nearest_first() -> None:
    colour = np.array([0, 10, 100, 200], dtype=np.int64) * 1_000_000
    depth = np.array([9, 95, 106, 230], dtype=np.int64) * 1_000_000
    partner, nearest = nearest_pairs(colour, depth)
    assert partner == [None, 0, 1, None]  # the first loses its only depth image to the nearer second
    assert nearest.tolist() == [9_000_000, 1_000_000, 5_000_000, 30_000_000]


def test_association_gives_the_second_nearest_when_the_nearest_is_taken() -> None:
    partner, _ = nearest_pairs(np.array([10_000_000, 12_000_000]), np.array([12_000_000, 15_000_000]))
    assert partner == [1, 0]


def test_times_are_exact_nanoseconds() -> None:
    assert parse_time_ns("1305031229.528748") == 1305031229528748000
    assert parse_time_ns("1403636579.763555584") == 1403636579763555584
    for text in ("nan", "inf", "noon", "1e12"):
        with pytest.raises(ValueError, match="no time in seconds"):
            parse_time_ns(text)


def test_slerp_of_the_readers_quaternion_order_is_wxyz() -> None:
    turned = slerp_wxyz(np.array([1.0, 0, 0, 0]), np.array([0.0, 0, 0, 1]), 0.5)  # half of 180 degrees about z
    np.testing.assert_allclose(rotation_from_quat_wxyz(turned)[:2, :2], [[0, -1], [1, 0]], atol=1e-12)


def test_masks_make_a_synthetic_recording(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path / "room", n=2, masks=True))
    assert recording.format == "synthetic"
    frame = next(recording.frames())
    assert frame.instances is not None
    assert dict(frame.instances.categories) == {1: "chair", 2: "cup"}
    assert frame.instances.labels.dtype == np.uint16
    assert [int((frame.instances.labels == label).sum()) for label in (1, 2)] == [225, 450]


def test_icl_nuim_poses_are_mirrored_so_that_depth_agrees(tmp_path: Path) -> None:
    recording = open_recording(write_icl(tmp_path / "living_room_traj1_frei_png"), SMALL)
    assert (recording.format, recording.total_frames) == ("icl_nuim", 5)
    assert [entry.index for entry in recording.entries] == [1, 2, 3, 4]
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [
        ("rgb/0.png", "no pose for frame 0 in the ground truth")
    ]
    first, *_, last = recording.frames()
    assert first.timestamp_ns is None
    assert first.depth is not None
    assert last.depth is not None
    assert first.world_from_camera is not None
    assert last.world_from_camera is not None
    assert np.linalg.det(first.world_from_camera[:3, :3]) == pytest.approx(1)
    agree = depth_residuals(SMALL, first.depth, first.world_from_camera, last.depth, last.world_from_camera)
    assert len(agree) > 1500
    assert np.median(agree) < 0.01  # rounding to pixels of 2 cm
    # the poses as written in the file do not fit the images: this is what the reader has to turn
    wrong = depth_residuals(SMALL, first.depth, icl_pose(1), last.depth, icl_pose(4))
    assert np.median(wrong) > 5 * np.median(agree)
    np.testing.assert_allclose(first.world_from_camera[:3, 3], icl_pose(1)[:3, 3] * [1, -1, 1], atol=1e-8)


def test_icl_nuim_camera_has_positive_fy_and_associations_may_be_missing(tmp_path: Path) -> None:
    folder = write_icl(tmp_path / "traj2", n=2, camera=ICL_NUIM)
    with_list = open_recording(folder)
    (folder / "associations.txt").unlink()
    without = open_recording(folder)
    assert with_list.camera == without.camera == Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
    assert [entry.name for entry in with_list.entries] == [entry.name for entry in without.entries] == ["rgb/1.png"]


def test_seven_scenes_scene_and_sequence_folders(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / "kitchen" / "seq-02", suffix="jpg")
    one = open_recording(tmp_path / "kitchen")
    assert (one.name, one.format, one.camera) == ("kitchen-seq-02", "seven_scenes", SEVEN_SCENES_COLOR)
    shutil.copytree(tmp_path / "kitchen" / "seq-02", tmp_path / "kitchen" / "seq-01")
    assert [recording.name for recording in open_recordings(tmp_path / "kitchen")] == [
        "kitchen-seq-01",
        "kitchen-seq-02",
    ]
    assert open_recording(tmp_path / "kitchen" / "seq-01").name == "kitchen-seq-01"
    with pytest.raises(RecordingError, match=r"holds 2 recordings \(seq-01, seq-02\); name one"):
        open_recording(tmp_path / "kitchen")


def test_seven_scenes_pose_is_the_colour_cameras_and_depth_is_registered(tmp_path: Path) -> None:
    recording = open_recording(write_seven_scenes(tmp_path / "seq-01"))
    assert [entry.index for entry in recording.entries] == [0, 4]
    frame = recording.read(recording.entries[1])
    assert (frame.name, frame.timestamp_ns) == ("frame-000004.color.png", None)
    assert (frame.depth_registration, frame.depth_scale) == ("7scenes", 1000)
    assert frame.world_from_camera is not None
    distance, angle = pose_error(frame.world_from_camera, pose(1))
    assert distance < 1e-9
    assert angle < 1e-6
    assert frame.depth is not None
    truth = render(SEVEN_SCENES_COLOR, pose(1))[1]
    error = np.abs(frame.depth - truth)[np.isfinite(frame.depth)]
    assert len(error) > 0.78 * truth.size  # the depth camera sees (525 / 585)^2 = 80 % of the colour image
    assert np.median(error) < 0.0005  # half a unit of 1 mm
    assert (error < 0.01).mean() > 0.99


def test_a_recording_without_poses_or_depth_is_noted_not_dropped(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=2)
    (folder / "depth.txt").unlink()
    (folder / "groundtruth.txt").unlink()
    recording = open_recording(folder)
    assert len(recording.entries) == 2
    assert "no depth.txt" in recording.notes[0]
    assert "no groundtruth.txt" in recording.notes[1]
    frame = next(recording.frames())
    assert frame.depth is None
    assert frame.world_from_camera is None
    assert frame.depth_scale is None
    assert recording.trajectory_length() == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3", "has 3 numbers"),
        ("a,2,3,4", "no number"),
        ("nan,2,3,4", "not finite"),
        ("481.2,-480,319.5,239.5", "must be positive"),
        ("", "no number"),
    ],
)
def test_camera_text_that_makes_no_sense_is_a_usage_error(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse_camera(text, 640, 480)


def test_camera_text_with_distortion() -> None:
    assert parse_camera("1,2,3,4", 640, 480) == Camera(640, 480, 1, 2, 3, 4)
    assert parse_camera("1,2,3,4,.1,.2,.3,.4", 640, 480).distortion == (0.1, 0.2, 0.3, 0.4)
    assert parse_camera("1,2,3,4,.1,.2,.3,.4,.5", 640, 480).distortion == (0.1, 0.2, 0.3, 0.4, 0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": -1}, "'fx' must be positive"),
        ({"cy": "middle"}, "'cy' must be a finite number"),
        ({"width": 64.5}, "whole numbers"),
        ({"distortion": [1]}, "'distortion' must be a list"),
        ({"depth_scale": 0}, "'depth_scale' must be positive"),
    ],
)
def test_camera_json_errors_name_the_key(tmp_path: Path, change: dict[str, object], message: str) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    content = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(content | change))
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(folder)
    assert str(folder / "camera.json") in str(caught.value)


def test_plain_files_give_the_same_bits_as_line_by_line(tmp_path: Path) -> None:
    """Recordings that were planned before are known by the bits of their poses."""
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(2000, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    rows = np.concatenate([rng.normal(size=(2000, 3)), quats], axis=1)
    texts = [" ".join(f"{value:.4f}" for value in row) for row in rows]
    (tmp_path / "groundtruth.txt").write_text("\n".join(f"{n}.5 {text}" for n, text in enumerate(texts)))
    trajectory, notes = read_trajectory(tmp_path / "groundtruth.txt")
    assert notes == []
    assert (trajectory.quat_wxyz == np.stack([parse_pose(text.split())[0] for text in texts])).all()
