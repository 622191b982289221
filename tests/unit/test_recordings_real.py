"""The real recordings beside the checkout: counts, first poses, and depth that agrees between frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.geometry import back_project, invert_pose, project, quat_wxyz_from_rotation, transform_points
from semdb.ingestion.keyframes import select_keyframes
from semdb.recordings import Recording, open_recording
from semdb.recordings.images import decode_depth
from semdb.types import Float32Array, FloatArray, Frame, ImageArray

pytestmark = pytest.mark.shared


@pytest.fixture(scope="module")
def kitchen(shared_dir: Path) -> Recording:
    return open_recording(shared_dir / "recordings" / "7scenes_redkitchen")


@pytest.fixture(scope="module")
def desk(shared_dir: Path) -> Recording:
    return open_recording(shared_dir / "recordings" / "tum_rgbd_dataset_freiburg1_rpy")


def test_red_kitchen_is_recognised(kitchen: Recording) -> None:
    assert (kitchen.format, kitchen.name) == ("seven_scenes", "7scenes_redkitchen-seq-01")
    assert (kitchen.total_frames, len(kitchen.entries), kitchen.dropped, kitchen.notes) == (250, 250, (), ())
    assert [entry.index for entry in kitchen.entries] == list(range(0, 1000, 4))
    assert kitchen.trajectory_length() == pytest.approx(6.89, abs=0.01)
    first = kitchen.entries[0].world_from_camera
    assert first is not None
    np.testing.assert_allclose(first[:3, 3], [-0.31654, 0.00936, 0.30248], atol=1e-5)
    np.testing.assert_allclose(first[:3, :3].T @ first[:3, :3], np.eye(3), atol=1e-12)


def test_freiburg1_rpy_is_recognised(desk: Recording) -> None:
    assert (desk.format, desk.name) == ("tum", "tum_rgbd_dataset_freiburg1_rpy")
    assert (desk.total_frames, len(desk.entries), desk.dropped, desk.notes) == (121, 121, (), ())
    assert desk.camera.distortion == (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    assert desk.entries[0].timestamp_ns == 1305031229528748000
    first = desk.entries[0].world_from_camera
    assert first is not None
    np.testing.assert_allclose(first[:3, 3], [1.29943, 0.68809, 1.57389], atol=1e-5)
    quat_wxyz = quat_wxyz_from_rotation(first[:3, :3])
    lines = [line.split() for line in (desk.path / "groundtruth.txt").read_text().splitlines()[3:]]
    nearest = min(lines, key=lambda line: abs(float(line[0]) - 1305031229.528748))
    x, y, z, w = (float(value) for value in nearest[4:])
    assert abs(quat_wxyz @ [w, x, y, z]) > 0.9999


def matched_pixels(first: Frame, second: Frame) -> tuple[FloatArray, FloatArray]:
    """SIFT matches [n, 2] twice that obey epipolar geometry."""
    sift = cv2.SIFT_create(800)
    (k1, d1), (k2, d2) = (
        sift.detectAndCompute(cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY), None) for f in (first, second)
    )
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(d1, d2, k=2)
    good = [a for a, b in pairs if a.distance < 0.7 * b.distance]
    one = np.array([k1[match.queryIdx].pt for match in good])
    two = np.array([k2[match.trainIdx].pt for match in good])
    _, mask = cv2.findFundamentalMat(one, two, cv2.FM_RANSAC, 2.0, 0.999)
    return one[mask.ravel() > 0], two[mask.ravel() > 0]


def reprojection_errors(
    recording: Recording,
    depths: list[Float32Array],
    poses: list[FloatArray],
    matches: list[tuple[FloatArray, FloatArray]],
) -> FloatArray:
    """Pixels between matches and the points of the first frame of each pair seen in the second, both ways."""
    errors = []
    for i, (one, two) in enumerate(matches):
        for a, b, pixels, seen in ((2 * i, 2 * i + 1, one, two), (2 * i + 1, 2 * i, two, one)):
            u, v = np.rint(pixels).astype(int).T
            z = depths[a][v, u]
            valid = np.isfinite(z)
            points = back_project(recording.camera, pixels[valid], z[valid])
            moved = transform_points(invert_pose(poses[b]) @ poses[a], points)
            errors.append(np.linalg.norm(project(recording.camera, moved) - seen[valid], axis=1))
    return np.concatenate(errors)


def frame_pairs(recording: Recording, starts: range, step: int) -> list[Frame]:
    return [recording.read(recording.entries[i]) for start in starts for i in (start, start + step)]


def test_freiburg1_depth_and_poses_agree_between_frames(desk: Recording) -> None:
    frames = frame_pairs(desk, range(0, 60, 10), 1)
    matches = [matched_pixels(frames[i], frames[i + 1]) for i in range(0, len(frames), 2)]
    depths = [frame.depth for frame in frames if frame.depth is not None]
    poses = [frame.world_from_camera for frame in frames if frame.world_from_camera is not None]
    errors = reprojection_errors(desk, depths, poses, matches)
    assert len(errors) > 400
    assert np.median(errors) < 6


def rim_distance(depth: Float32Array, image: ImageArray) -> float:
    """Mean pixels (10 at most) from the foreground rims of depth steps above 0.2 m to the nearest colour edge."""
    edges = cv2.Canny(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 60, 150)
    distance = np.minimum(cv2.distanceTransform(255 - edges, cv2.DIST_L2, 3), 10)
    known = np.nan_to_num(depth)
    rim = (known > 0) & (cv2.dilate(known, np.ones((3, 3))) - known > 0.2)
    inside = np.zeros_like(rim)
    inside[50:-50, 60:-60] = True
    return float(distance[rim & inside].mean())


def test_registration_moves_depth_edges_to_colour_edges(kitchen: Recording) -> None:
    registered, raw = [], []
    for entry in kitchen.entries[5:250:35]:
        frame = kitchen.read(entry)
        assert frame.depth is not None
        registered.append(rim_distance(frame.depth, frame.image))
        assert frame.depth_bytes is not None
        raw.append(rim_distance(decode_depth(frame.depth_bytes, "raw", 1000, (640, 480)), frame.image))
    assert np.mean(raw) > 4.5
    assert np.mean(registered) < 0.85 * np.mean(raw)


def test_red_kitchen_depth_and_poses_agree_between_frames(kitchen: Recording) -> None:
    frames = frame_pairs(kitchen, range(5, 245, 40), 8)
    matches = [matched_pixels(frames[i], frames[i + 1]) for i in range(0, len(frames), 2)]
    depths = [frame.depth for frame in frames if frame.depth is not None]
    poses = [frame.world_from_camera for frame in frames if frame.world_from_camera is not None]
    errors = reprojection_errors(kitchen, depths, poses, matches)
    assert len(errors) > 800
    assert np.median(errors) < 5


def test_keyframes_of_the_real_recordings(kitchen: Recording, desk: Recording) -> None:
    every_fifth = replace(kitchen, entries=kitchen.entries[::5])  # each call decodes all depth
    for recording, n in ((every_fifth, 25), (desk, 40)):
        chosen = [entry.index for entry in select_keyframes(recording, count=n)]
        assert len(set(chosen)) == n
        assert chosen == sorted(chosen)
    assert 4 <= len(desk.entries) / len(select_keyframes(desk)) <= 30
