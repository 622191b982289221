"""Registration of 7-Scenes depth: exact on surfaces, occlusion-correct at their edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semdb.errors import FrameError
from semdb.geometry import back_project
from semdb.recordings import register_depth
from semdb.recordings.cameras import SEVEN_SCENES_COLOR, SEVEN_SCENES_DEPTH
from semdb.recordings.registration import COLOR_FROM_DEPTH, DEPTH_FROM_COLOR
from semdb.types import Camera, Float32Array, FloatArray

# in the depth camera's frame: a board of 0.6 x 0.5 m at z = 1 before a slanted wall
BOARD_CENTRE = np.array([0.05, -0.02, 1.0])
WALL_NORMAL, WALL_OFFSET = np.array([0.25, -0.2, 1.0]), 2.5


def scene_depth(camera: Camera, depth_from_camera: FloatArray) -> tuple[Float32Array, np.ndarray]:
    """Depth [H, W] of the scene as a camera sees it, and where it sees the board."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(camera, np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    directions, origin = rays @ depth_from_camera[:3, :3].T, depth_from_camera[:3, 3]
    wall = (WALL_OFFSET - WALL_NORMAL @ origin) / (directions @ WALL_NORMAL)
    board = (BOARD_CENTRE[2] - origin[2]) / directions[:, 2]
    hit = origin + directions * board[:, None] - BOARD_CENTRE
    on_board = (np.abs(hit[:, 0]) < 0.3) & (np.abs(hit[:, 1]) < 0.25)
    shape = (camera.height, camera.width)
    return np.where(on_board, board, wall).reshape(shape).astype(np.float32), on_board.reshape(shape)


@pytest.fixture(scope="module")
def views() -> tuple[Float32Array, Float32Array, np.ndarray]:
    depth, _ = scene_depth(SEVEN_SCENES_DEPTH, np.eye(4))
    truth, on_board = scene_depth(SEVEN_SCENES_COLOR, DEPTH_FROM_COLOR)
    return register_depth(depth, "7scenes", SEVEN_SCENES_COLOR), truth, on_board


def test_depth_is_exact_on_planes_and_has_no_cracks(views: tuple[Float32Array, Float32Array, np.ndarray]) -> None:
    registered, truth, on_board = views
    interior = cv2.erode(on_board.astype(np.uint8), np.ones((5, 5))) > 0
    away = cv2.dilate(on_board.astype(np.uint8), np.ones((61, 61))) == 0  # out of the board's shadow
    away[:45], away[-45:], away[:, :60], away[:, -60:] = False, False, False, False  # what the depth camera sees
    for region in (interior, away):
        assert region.sum() > 20_000
        assert np.isfinite(registered[region]).all()
        assert np.abs(registered[region] / truth[region] - 1).max() < 1e-4


def test_no_background_on_the_board_and_nothing_invented_between(
    views: tuple[Float32Array, Float32Array, np.ndarray],
) -> None:
    registered, truth, on_board = views
    valid = np.isfinite(registered)
    inner = cv2.erode(on_board.astype(np.uint8), np.ones((3, 3))) > 0  # the rim of one pixel may be cut
    assert registered[inner & valid].max() < 1.05
    error = np.abs(registered / truth - 1)[valid]
    # one ring of pixels at the silhouette may be on the other side of it; nothing is between the surfaces
    assert (error > 0.001).mean() < 0.01
    between = (registered > 1.1) & (registered < truth.min(where=~on_board, initial=9.0) - 0.01)
    assert between.sum() == 0


def test_the_shadow_beside_the_board_stays_empty(views: tuple[Float32Array, Float32Array, np.ndarray]) -> None:
    registered, _, on_board = views
    rows, columns = np.nonzero(on_board)
    row = (rows.min() + rows.max()) // 2
    empty = np.isnan(registered[row, columns.min() - 40 : columns.max() + 40])
    # baseline 25.6 mm between depths of 1 m and about 2.4 m: some 8 pixels are seen by the colour camera alone
    assert 4 <= empty.sum() <= 14


def test_invalid_depth_stays_invalid() -> None:
    depth = np.full((480, 640), np.nan, np.float32)
    assert np.isnan(register_depth(depth, "7scenes", SEVEN_SCENES_COLOR)).all()
    depth[100:300, 200:400] = 2.0
    depth[200, 300] = np.nan
    registered = register_depth(depth, "7scenes", SEVEN_SCENES_COLOR)
    point = COLOR_FROM_DEPTH[:3, :3] @ [(300 - 320) / 585 * 2, (200 - 240) / 585 * 2, 2] + COLOR_FROM_DEPTH[:3, 3]
    u, v = 525 * point[:2] / point[2] + [320, 240]
    assert np.isnan(registered[round(v), round(u)])
    assert 0.75 < np.isfinite(registered).sum() / (200 * 200) < 0.81  # (525 / 585)^2, less the rim


def test_another_colour_camera_moves_the_pixels() -> None:
    depth, _ = scene_depth(SEVEN_SCENES_DEPTH, np.eye(4))
    plain = register_depth(depth, "7scenes", SEVEN_SCENES_COLOR)
    shifted = register_depth(depth, "7scenes", Camera(640, 480, 525, 525, 330, 240))
    np.testing.assert_allclose(shifted[:, 60:600], plain[:, 50:590], rtol=1e-3)
    curved = register_depth(depth, "7scenes", Camera(640, 480, 525, 525, 320, 240, (0.1, 0, 0, 0, 0)))
    assert np.nanmax(np.abs(curved - plain)[230:250, 310:330]) < 1e-3
    assert np.isfinite(curved).sum() > 1.02 * np.isfinite(plain).sum()  # this lens draws the borders outwards


def test_an_unknown_registration_is_refused() -> None:
    with pytest.raises(FrameError, match="unknown depth registration '8scenes'"):
        register_depth(np.ones((2, 2), np.float32), "8scenes", SEVEN_SCENES_COLOR)
