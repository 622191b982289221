"""Which way is up, told by surfaces of made-up rooms; where nothing tells it, it is not said."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.geometry import pose_from, so3_exp
from semdb.trajectory.depth_views import DepthView, depth_view
from semdb.trajectory.upright import find_up, level_world, normals_of
from semdb.types import Camera, Float32Array, FloatArray

CAMERA = Camera(320, 240, 260, 260, 160, 120)
UP = np.array([0.0, 0.0, 1.0])


def seen(pose: FloatArray, planes: list[tuple[FloatArray, float]]) -> Float32Array:
    """Depth of the nearest of planes ``n x = d`` in front of a camera."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    rays = np.dstack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)])
    depth = np.full(u.shape, np.inf)
    for normal, offset in planes:
        with np.errstate(divide="ignore"):
            along = (offset - normal @ pose[:3, 3]) / (rays @ pose[:3, :3].T @ normal)
        depth = np.where((along > 0.1) & (along < depth), along, depth)
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)


def box(tilt: FloatArray) -> list[tuple[FloatArray, float]]:
    return [(tilt[:, k], side) for k, side in ((0, 3.0), (0, -3.0), (1, 2.5), (2, -1.4))]


def looking(yaw: float, pitch: float = 0.25, roll: float = 0.0) -> FloatArray:
    """A camera at the origin, z up: it looks along x, turned by angles (rad)."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return pose_from(so3_exp([0, 0, yaw]) @ so3_exp([0, pitch, 0]) @ level @ so3_exp([0, 0, roll]), [0, 0, 0])


def views(poses: list[FloatArray], planes: list[tuple[FloatArray, float]]) -> list[DepthView | None]:
    return [depth_view(CAMERA, seen(pose, planes)) for pose in poses]


def test_normals_of_a_wall_are_those_of_the_wall() -> None:
    found = normals_of(views([looking(0.3, 0.0)], [(np.array([1.0, 0.0, 0.0]), 2.0)])[0])
    assert len(found) == 400
    world = found @ looking(0.3, 0.0)[:3, :3].T
    np.testing.assert_allclose(world, np.tile([-1.0, 0.0, 0.0], (400, 1)), atol=1e-3)


@pytest.mark.parametrize("tilt", [[0.0, 0.0, 0.0], [0.2, -0.15, 1.0], [0.0, 0.5, 0.0]])
def test_up_is_found_in_any_world(tilt: list[float]) -> None:
    poses = [looking(yaw, roll=roll) for yaw, roll in ((0, 0.1), (0.7, -0.2), (1.6, 0.15), (2.4, 0), (-0.8, -0.1))]
    depths = views(poses, box(np.eye(3)))
    world = so3_exp(tilt)
    found = find_up(depths, np.stack([pose_from(world, [1, 2, 3]) @ pose for pose in poses]))
    assert found is not None
    np.testing.assert_allclose(found.direction, world @ UP, atol=0.01)
    assert found.share > 0.9
    assert found.sigma_deg < 1.0


def test_a_wall_alone_and_depth_of_nothing_tell_no_up() -> None:
    poses = [looking(yaw) for yaw in (-0.2, 0.0, 0.2)]
    wall = views(poses, [(np.array([1.0, 0.0, 0.0]), 2.0)])
    assert find_up(wall, np.stack(poses)) is None
    assert find_up([None, None, None], np.stack(poses)) is None


def test_a_camera_held_all_ways_tells_no_up() -> None:
    poses = [looking(0.5, roll=roll) for roll in np.linspace(0, 2 * np.pi, 8, endpoint=False)]
    assert find_up(views(poses, box(np.eye(3))), np.stack(poses)) is None


def test_a_level_world_has_x_where_the_camera_looks() -> None:
    first, up = np.eye(4), np.array([0.1, -1.0, 0.2]) / np.linalg.norm([0.1, -1.0, 0.2])
    turn = level_world(first, up)
    np.testing.assert_allclose(turn[:3, :3] @ up, UP, atol=1e-12)
    np.testing.assert_allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn[:3, :3]) == pytest.approx(1.0)
    assert (turn @ first)[1, 2] == pytest.approx(0.0, abs=1e-12)
    assert (turn @ first)[0, 2] > 0.9
    down = level_world(np.eye(4), np.array([0.0, 0.0, -1.0]))  # it looks straight down
    np.testing.assert_allclose(down[:3, :3] @ [0, 0, -1], UP, atol=1e-12)
    np.testing.assert_allclose(down[:3, :3] @ [0, -1, 0], [1, 0, 0], atol=1e-12)
