"""Rotations, poses and cameras: what must hold for all of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.geometry import (
    back_project,
    invert_pose,
    normalized_to_pixels,
    pixels_to_normalized,
    pose_distances,
    pose_error,
    pose_from,
    project,
    project_to_so3,
    quat_wxyz_from_rotation,
    rotation_angle_deg,
    rotation_from_quat_wxyz,
    rotations_from_quats_wxyz,
    slerp_wxyz,
    so3_exp,
    so3_log,
    transform_points,
)
from semdb.types import Camera, FloatArray

CAMERA = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))  # freiburg1

coordinate = st.floats(-10, 10, allow_nan=False)
direction = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 1e-3)
rotation_vectors = st.builds(lambda axis, angle: axis / np.linalg.norm(axis) * angle, direction, st.floats(0, 3.1415))
poses = st.builds(
    lambda turn, place: pose_from(so3_exp(turn), np.array(place)), rotation_vectors, st.tuples(*[coordinate] * 3)
)


@given(rotation_vectors)
def test_log_undoes_exp(turn: FloatArray) -> None:
    rotation = so3_exp(turn)
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert so3_log(rotation) == pytest.approx(turn, abs=1e-7)
    assert rotation_angle_deg(rotation) == pytest.approx(np.degrees(np.linalg.norm(turn)), abs=1e-6)


@given(direction, st.floats(1e-16, 1e-6))
def test_small_turns_keep_their_digits(axis: FloatArray, angle: float) -> None:
    turn = axis / np.linalg.norm(axis) * angle
    assert so3_log(so3_exp(turn)) == pytest.approx(turn, abs=1e-17, rel=1e-6)


@given(rotation_vectors)
def test_a_quaternion_is_a_rotation(turn: FloatArray) -> None:
    rotation = so3_exp(turn)
    q = quat_wxyz_from_rotation(rotation)
    assert np.linalg.norm(q) == pytest.approx(1.0)
    assert np.abs(rotation_from_quat_wxyz(q) - rotation).max() < 1e-9
    assert np.abs(rotations_from_quats_wxyz(np.stack([q, -q])) - rotation).max() < 1e-9


@given(rotation_vectors, rotation_vectors, st.floats(0, 1))
def test_slerp_turns_evenly(first: FloatArray, second: FloatArray, fraction: float) -> None:
    a, b = so3_exp(first), so3_exp(second)
    between = rotation_from_quat_wxyz(slerp_wxyz(quat_wxyz_from_rotation(a), quat_wxyz_from_rotation(b), fraction))
    whole = rotation_angle_deg(a.T @ b)
    if whole < 179.9:  # beyond, the shorter way is not determined
        assert rotation_angle_deg(a.T @ between) == pytest.approx(fraction * whole, abs=1e-5)
        assert rotation_angle_deg(between.T @ b) == pytest.approx((1 - fraction) * whole, abs=1e-5)


@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9), rotation_vectors)
def test_the_nearest_rotation_is_one(noise: list[float], turn: FloatArray) -> None:
    rotation = so3_exp(turn)
    found = project_to_so3(rotation + 0.02 * np.reshape(noise, (3, 3)))
    assert np.abs(found @ found.T - np.eye(3)).max() < 1e-12
    assert rotation_angle_deg(found.T @ rotation) < 5


@given(poses, poses)
def test_poses_form_a_group(a: FloatArray, b: FloatArray) -> None:
    assert np.abs(a @ invert_pose(a) - np.eye(4)).max() < 1e-9
    points = np.array([[1.0, 2.0, 3.0], [-0.5, 0.0, 9.0]])
    assert transform_points(b, transform_points(a, points)) == pytest.approx(transform_points(b @ a, points), abs=1e-9)
    assert transform_points(invert_pose(a), transform_points(a, points)) == pytest.approx(points, abs=1e-9)


@given(poses, poses, poses)
def test_errors_do_not_depend_on_the_world_frame(a: FloatArray, b: FloatArray, world: FloatArray) -> None:
    metres, degrees = pose_error(a, b)
    assert pose_error(b, a) == pytest.approx((metres, degrees), abs=1e-6)
    assert pose_error(world @ a, world @ b) == pytest.approx((metres, degrees), abs=1e-5)
    assert pose_error(a, a) == pytest.approx((0, 0), abs=1e-6)
    assert pose_distances(a, np.stack([b, a])) == pytest.approx([metres / 0.3 + degrees / 15, 0], abs=1e-6)


@settings(deadline=None)  # the first call loads what it needs
@given(st.lists(st.tuples(st.floats(0, 639), st.floats(0, 479), st.floats(0.3, 8)), min_size=1, max_size=20))
def test_pixels_and_points_of_a_distorting_camera(seen: list[tuple[float, float, float]]) -> None:
    pixels, depth = np.array(seen)[:, :2], np.array(seen)[:, 2]
    assert normalized_to_pixels(CAMERA, pixels_to_normalized(CAMERA, pixels)) == pytest.approx(pixels, abs=1e-3)
    points = back_project(CAMERA, pixels, depth)
    assert points[:, 2] == pytest.approx(depth)
    assert project(CAMERA, points) == pytest.approx(pixels, abs=1e-3)
