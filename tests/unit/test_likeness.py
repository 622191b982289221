"""Patches of a keyframe, compared where a pose puts them in the query."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semdb.geometry import pixels_to_normalized
from semdb.localization.likeness import likeness_share
from semdb.localization.views import KeyframeView, View
from semdb.types import Camera, ImageArray

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
DEPTH_M = 2.0
STEP = 20  # pixels between the points
GRID = np.mgrid[40:200:STEP, 40:280:STEP]


def wall(seed: int = 0) -> ImageArray:
    """A wall 2 m in front of the camera: smooth noise."""
    noise = np.random.default_rng(seed).standard_normal((240, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def view(grey: ImageArray | None) -> View:
    """Keypoints on a grid over the wall."""
    xy = np.stack([GRID[1].ravel(), GRID[0].ravel()], axis=1).astype(np.float32)
    normalised = pixels_to_normalized(CAMERA, xy)
    points = (np.column_stack([normalised, np.ones(len(xy))]) * DEPTH_M).astype(np.float32)
    count = len(xy)
    return View(
        camera=CAMERA,
        seen_xy=xy,
        xy=normalised,
        size=np.full(count, 20.0, np.float32),
        descriptors=np.zeros((count, 4), np.float32),
        classes=np.full(count, -1, np.int32),
        signs=np.zeros(count, np.int8),
        points=points,
        source=np.arange(count, dtype=np.int32),
        grey=grey,
    )


def share(query: ImageArray | None, keyframe: ImageArray | None, shift_px: float = 0.0) -> float | None:
    """Of the wall as `keyframe` shows it in `query`, seen from where it stands `shift_px` further left."""
    own = view(keyframe)
    pose = np.eye(4)
    pose[0, 3] = shift_px * DEPTH_M / CAMERA.fx
    known = KeyframeView(1, own, np.eye(4), np.eye(4), own.points.astype(float))
    moved = own.points - pose[:3, 3]
    pixels = moved[:, :2] / moved[:, 2:] * 260.0 + [CAMERA.cx, CAMERA.cy]
    rows = np.arange(len(own), dtype=np.int32)
    return likeness_share(replace(own, grey=query), known, pose, rows, pixels.astype(float))


def test_the_same_wall_looks_alike() -> None:
    assert share(wall(), wall()) == 1.0


def test_a_wall_seen_from_beside_is_found_where_the_pose_puts_it() -> None:
    beside = np.roll(wall(), -12, axis=1)
    assert share(beside, wall(), 12.0) == pytest.approx(1.0, abs=0.02)
    assert share(beside, wall(), 14.0) == pytest.approx(1.0, abs=0.02)  # the pose may be two pixels off
    found = share(beside, wall(), 0.0)
    assert found is not None
    assert found < 0.05


def test_the_mirrored_wall_is_another() -> None:
    found = share(np.ascontiguousarray(wall()[:, ::-1]), wall())
    assert found is not None
    assert found < 0.05


def test_darker_and_flatter_is_no_difference() -> None:
    assert share((wall() * 0.3 + 20).astype(np.uint8), wall()) == 1.0


@pytest.mark.parametrize("sigma", [2.0, 4.0])
@pytest.mark.parametrize("query_is_blurred", [True, False])
def test_a_blurred_image_of_the_wall_looks_alike(sigma: float, query_is_blurred: bool) -> None:
    blurred = cv2.GaussianBlur(wall(), (0, 0), sigma).astype(np.uint8)
    pair = (blurred, wall()) if query_is_blurred else (wall(), blurred)
    found = share(*pair)
    assert found is not None
    assert found > 0.9
    other = share(blurred, wall(seed=1))
    assert other is not None
    assert other < 0.1


def test_nothing_is_said_where_nothing_can_be_compared() -> None:
    assert share(None, wall()) is None
    assert share(wall(), None) is None
    flat = np.full((240, 320), 90, np.uint8)
    assert share(wall(), flat) is None
