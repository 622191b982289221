"""Split into keyframes and queries, and the reference that knows the right keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.errors import FrameError, UsageError
from semdb.evaluation.baselines import (
    SiftReference,
    estimate_pose,
    nearest_in_pose,
    points_at,
    ratio_matches,
)
from semdb.evaluation.protocols import evenly_spaced, split_paper
from semdb.geometry import invert_pose, pose_distances, pose_error, pose_from, project, so3_exp, transform_points
from semdb.types import Camera, FloatArray, Frame, Verdict

CAMERA = Camera(320, 240, 260.0, 262.0, 159.5, 119.5)


@dataclass(frozen=True)
class Entry:
    index: int
    world_from_camera: FloatArray | None


def entries(count: int, without_pose: tuple[int, ...] = ()) -> list[Entry]:
    return [Entry(i, None if i in without_pose else np.eye(4)) for i in range(count)]


def test_queries_are_the_posed_frames_that_are_no_keyframes() -> None:
    frames = entries(10, without_pose=(3,))
    queries = split_paper(frames, [frames[0], frames[5]])
    assert [query.index for query in queries] == [1, 2, 4, 6, 7, 8, 9]


def test_max_queries_is_exact_or_all() -> None:
    frames = entries(250)
    assert len(split_paper(frames, frames[::10], 75)) == 75
    assert len(split_paper(frames, frames[::10], 9999)) == 225
    few = split_paper(frames, frames[::10], 5)
    assert [query.index for query in few] == [1, 63, 125, 187, 249]


def test_no_query_left_and_bad_count_are_errors() -> None:
    frames = entries(3)
    with pytest.raises(UsageError, match="fewer --keyframes"):
        split_paper(frames, frames)
    with pytest.raises(UsageError, match="--max-queries 0"):
        split_paper(frames, [], 0)


@given(total=st.integers(0, 400), count=st.integers(1, 450))
def test_evenly_spaced_positions(total: int, count: int) -> None:
    positions = evenly_spaced(total, count)
    assert len(positions) == min(total, count)
    assert len(set(positions)) == len(positions)
    assert positions == sorted(positions)
    if count > 1 and total > 1:
        assert (positions[0], positions[-1]) == (0, total - 1)
        gaps = np.diff(positions)
        assert gaps.max() - gaps.min() <= 1


def test_distance_adds_metres_and_degrees() -> None:
    poses = np.stack(
        [
            pose_from(np.eye(3), [0.6, 0, 0]),  # 2
            pose_from(so3_exp([0, np.radians(15), 0]), [0, 0, 0]),  # 1
            pose_from(so3_exp([0, np.radians(7.5), 0]), [0.03, 0, 0]),  # 0.6
        ]
    )
    assert pose_distances(np.eye(4), poses) == pytest.approx([2.0, 1.0, 0.6])
    assert nearest_in_pose(np.eye(4), poses, 2) == [2, 1]
    assert nearest_in_pose(np.eye(4), poses) == [2, 1, 0]


def test_ratio_test_keeps_clear_matches_only() -> None:
    keyframe = np.eye(4, dtype=np.float32)
    between = np.array([1, 0.95, 0, 0], np.float32)
    query = np.stack([keyframe[2], between / np.linalg.norm(between)])
    assert ratio_matches(query, keyframe).tolist() == [[0, 2]]
    assert ratio_matches(query, keyframe[:1]).shape == (0, 2)


def test_points_at_depth_edges_and_holes_are_nan() -> None:
    depth = np.full((240, 320), 2.0, np.float32)
    depth[:, 200:] = 3.0
    depth[100, 50] = np.nan
    points = points_at(np.array([[20, 20], [200, 60], [50, 100], [300, 200]], np.float32), depth, CAMERA)
    assert np.isfinite(points).all(axis=1).tolist() == [True, False, False, True]
    assert points[0] == pytest.approx([(20 - 159.5) / 260 * 2, (20 - 119.5) / 262 * 2, 2.0])


def test_pose_of_exact_pairs_of_a_distorted_lens_with_outliers() -> None:
    camera = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    rng = np.random.default_rng(0)
    truth = pose_from(so3_exp([0.2, -0.3, 0.1]), [0.5, -0.2, 1.0])
    local = np.column_stack([rng.uniform(-0.8, 0.8, 200), rng.uniform(-0.6, 0.6, 200), rng.uniform(1.5, 3, 200)])
    xy = project(camera, local).astype(np.float32)
    xy[:60] += rng.uniform(40, 90, (60, 2)).astype(np.float32)
    pose, inliers = estimate_pose(camera, xy, transform_points(truth, local))
    assert pose is not None
    metres, degrees = pose_error(pose, truth)
    assert metres < 1e-3
    assert degrees < 0.02
    assert inliers[60:].all()
    assert inliers[:60].sum() <= 2


def test_too_few_pairs_have_no_pose() -> None:
    pose, inliers = estimate_pose(CAMERA, np.zeros((3, 2), np.float32), np.ones((3, 3)))
    assert pose is None
    assert inliers.tolist() == [False] * 3


def wall(world_from_camera: FloatArray, index: int) -> Frame:
    """A textured wall at z = 2 in the world, seen from `world_from_camera`."""
    noise = np.random.default_rng(5).integers(0, 256, (150, 200), np.uint8)
    texture = cv2.GaussianBlur(cv2.resize(noise, (800, 600), interpolation=cv2.INTER_CUBIC), (0, 0), 1.0)
    texture_from_world = np.array([[200.0, 0, 400], [0, 200.0, 300], [0, 0, 1]])  # 200 pixels per metre
    camera_from_world = invert_pose(world_from_camera)
    camera_from_plane = np.column_stack(
        [camera_from_world[:3, 0], camera_from_world[:3, 1], 2 * camera_from_world[:3, 2] + camera_from_world[:3, 3]]
    )
    image = cv2.warpPerspective(
        texture, CAMERA.matrix @ camera_from_plane @ np.linalg.inv(texture_from_world), (320, 240)
    )
    v, u = np.mgrid[0:240, 0:320]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u, float)], axis=-1)
    depth = (2 - world_from_camera[2, 3]) / (rays @ world_from_camera[2, :3])
    return Frame(index, f"{index}.png", None, np.repeat(image[..., None], 3, 2), depth.astype(np.float32), CAMERA,
                 world_from_camera)  # fmt: skip


def test_sift_reference_finds_a_rendered_view() -> None:
    keyframes = [wall(pose_from(np.eye(3), [x, 0, 0]), i) for i, x in enumerate((-0.4, -0.2, 0.0, 0.2, 0.4, 0.9))]
    truth = pose_from(so3_exp([0.02, 0.1, 0.03]), [0.1, 0.05, -0.1])
    reference = SiftReference([("wall", keyframe) for keyframe in keyframes], map_name="wall")
    answer = reference.localize(wall(truth, 99))
    assert answer.verdict is Verdict.LOCALIZED
    assert answer.world_from_camera is not None
    metres, degrees = pose_error(answer.world_from_camera, truth)
    assert metres < 0.01
    assert degrees < 0.2
    assert sorted(candidate.frame_index for candidate in answer.candidates) == [0, 1, 2, 3, 4]
    assert sum(candidate.inliers for candidate in answer.candidates) == answer.inliers > 100
    assert (answer.keyframes_matched, answer.map_name) == (5, "wall")
    assert answer.query_xy is not None
    assert len(answer.query_xy) == max(candidate.inliers for candidate in answer.candidates)


def test_sift_reference_fails_on_an_image_without_texture() -> None:
    frame = wall(np.eye(4), 0)
    grey = replace(frame, index=9, image=np.full_like(frame.image, 128))
    answer = SiftReference([("wall", frame)]).localize(grey)
    assert (answer.verdict, answer.world_from_camera, answer.inliers) == (Verdict.FAILED, None, 0)


def test_sift_reference_says_what_is_missing() -> None:
    frame = wall(np.eye(4), 0)
    with pytest.raises(UsageError, match="at least one keyframe"):
        SiftReference([])
    with pytest.raises(FrameError, match=r"0\.png.*depth"):
        SiftReference([("wall", replace(frame, depth=None))])
    with pytest.raises(FrameError, match="true pose"):
        SiftReference([("wall", frame)]).localize(replace(frame, world_from_camera=None))
