"""What a keyframe shows about its inliers, compared where a pose puts it in the query."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semdb.geometry import pixels_to_normalized
from semdb.localization.likeness import likeness_about, likeness_by_depth, small_inverse_depth
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


def share(
    query: ImageArray | None,
    keyframe: ImageArray | None,
    shift_px: float = 0.0,
    seen_shift_px: float | None = None,
    inliers: slice = slice(None),
) -> float | None:
    """Of the wall as `keyframe` shows it in `query`, said to be seen from `shift_px` further left.

    The inliers are seen there, or `seen_shift_px` further.
    """
    own = view(keyframe)
    pose = np.eye(4)
    pose[0, 3] = shift_px * DEPTH_M / CAMERA.fx
    known = KeyframeView(1, own, np.eye(4), np.eye(4), own.points.astype(float))
    moved = own.seen_xy - np.array([shift_px if seen_shift_px is None else seen_shift_px, 0], np.float32)
    chosen = np.arange(len(own), dtype=np.int32)[inliers]
    return likeness_about(replace(own, grey=query, seen_xy=moved), known, pose, chosen, chosen)


def test_the_same_wall_looks_alike() -> None:
    assert share(wall(), wall()) == 1.0


def test_a_wall_seen_from_beside_is_found_where_the_pose_puts_it() -> None:
    beside = np.roll(wall(), -12, axis=1)
    assert share(beside, wall(), 12.0) == pytest.approx(1.0, abs=0.02)
    assert share(beside, wall(), 13.0, 13.0) == pytest.approx(1.0, abs=0.02)  # the pose may be a little off
    found = share(beside, wall(), 0.0)
    assert found is not None
    assert found < 0.05


def test_what_poses_are_off_by_is_read_off_the_inliers() -> None:
    """Recorded poses of the red kitchen disagree by several pixels; the pairs say where things are."""
    beside = np.roll(wall(), -12, axis=1)
    found = share(beside, wall(), 8.0, 12.0)
    assert found is not None
    assert found > 0.95


def test_the_mirrored_wall_is_another() -> None:
    found = share(np.ascontiguousarray(wall()[:, ::-1]), wall())
    assert found is not None
    assert found < 0.05


def test_darker_and_flatter_is_no_difference() -> None:
    assert share((wall() * 0.3 + 20).astype(np.uint8), wall()) == pytest.approx(1.0, abs=0.01)


def test_what_lies_far_from_every_inlier_says_nothing() -> None:
    """The right half of the wall is another one; the inliers are on the left."""
    changed = wall()
    changed[:, 160:] = wall(seed=1)[:, 160:]
    columns = np.arange(GRID[0].size).reshape(GRID[0].shape)[:, :4]
    chosen = np.zeros(GRID[0].size, np.bool_)
    chosen[columns.ravel()] = True
    own = view(wall())
    known = KeyframeView(1, own, np.eye(4), np.eye(4), own.points.astype(float))
    rows = np.flatnonzero(chosen).astype(np.int32)
    assert likeness_about(replace(own, grey=changed), known, np.eye(4), rows, rows) == pytest.approx(1.0, abs=0.01)
    every = np.arange(len(own), dtype=np.int32)
    half = likeness_about(replace(own, grey=changed), known, np.eye(4), every, every)
    assert half is not None
    assert 0.4 < half < 0.65


def test_a_slanted_wall_is_seen_as_it_is() -> None:
    """A floor that falls away from the camera: depth is known at keypoints, and what lies between them follows."""
    own, pose = view(wall()), np.eye(4)
    pose[0, 3] = 0.1
    depth = 1.5 + 2.0 * own.seen_xy[:, 1] / CAMERA.height
    points = np.column_stack([own.xy, np.ones(len(own))]) * depth[:, None]
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
    # the query shows at (x, y) what the keyframe shows at x + fx * 0.1 / depth
    beside = cv2.remap(wall(), column + np.float32(26.0) / (1.5 + 2.0 * row / CAMERA.height), row, cv2.INTER_LINEAR)
    seen = own.seen_xy - np.column_stack([26.0 / depth, np.zeros(len(own))]).astype(np.float32)
    slanted = replace(own, points=points.astype(np.float32))
    rows = np.arange(len(own), dtype=np.int32)
    query, known = replace(own, grey=beside, seen_xy=seen), KeyframeView(1, slanted, np.eye(4), np.eye(4), points)
    found = likeness_about(query, known, pose, rows, rows)
    assert found is not None
    assert found > 0.9


@pytest.mark.parametrize(("sigma", "least"), [(1.0, 0.9), (1.5, 0.6)])
@pytest.mark.parametrize("query_is_blurred", [True, False])
def test_a_blurred_image_of_the_wall_looks_more_alike_than_another_wall(
    sigma: float, least: float, *, query_is_blurred: bool
) -> None:
    blurred = cv2.GaussianBlur(wall(), (0, 0), sigma).astype(np.uint8)
    pair = (blurred, wall()) if query_is_blurred else (wall(), blurred)
    found = share(*pair)
    assert found is not None
    assert found > least
    other = share(blurred, wall(seed=1))
    assert other is not None
    assert other < 0.05


def test_nothing_is_said_where_nothing_can_be_compared() -> None:
    assert share(None, wall()) is None
    assert share(wall(), None) is None
    flat = np.full((240, 320), 90, np.uint8)
    assert share(wall(), flat) is None
    assert share(wall(), wall(), inliers=slice(0, 0)) is None
    assert share(wall(), wall(), 1000.0) is None  # the pose puts all of it beside the image


def depth_share(query: ImageArray, keyframe: ImageArray, inverse: np.ndarray | None, shift_px: float = 0.0) -> object:
    own = replace(view(keyframe), inverse_depth=inverse)
    pose = np.eye(4)
    pose[0, 3] = shift_px * DEPTH_M / CAMERA.fx
    other = replace(view(query), seen_xy=own.seen_xy - np.float32([shift_px, 0]))
    placed = KeyframeView(1, own, np.eye(4), np.eye(4), own.points.astype(np.float64))
    return likeness_by_depth(other, placed, pose, other.seen_xy, own.seen_xy)


def test_with_measured_depth_all_that_is_seen_is_compared() -> None:
    inverse = small_inverse_depth(CAMERA, np.full((240, 320), DEPTH_M, np.float32))
    assert inverse.shape == (120, 160)
    moved = np.roll(wall(), -16, axis=1)
    about, everywhere = depth_share(moved, wall(), inverse, 16.0)  # type: ignore[misc]
    assert about > 0.95
    assert everywhere > 0.95
    about, everywhere = depth_share(wall(1), wall(), inverse)  # type: ignore[misc]
    assert about < 0.1
    half = wall()
    half[150:] = wall(1)[150:]  # below it shows another wall
    about, everywhere = depth_share(half, wall(), inverse)  # type: ignore[misc]
    assert 0.45 < everywhere < 0.75
    assert depth_share(wall(), wall(), None) is None


def test_holes_of_depth_are_filled_and_its_edges_left_out() -> None:
    depth = np.full((240, 320), DEPTH_M, np.float32)
    depth[100:104, 100:104] = np.nan
    depth[:, 200:] = np.nan
    inverse = small_inverse_depth(CAMERA, depth)
    assert inverse[51, 51] == pytest.approx(0.5)
    assert np.isnan(inverse[:, 110:]).all()
    step = np.where(np.arange(320) < 160, 2.0, 4.0).astype(np.float32)[None].repeat(240, axis=0)
    blurred = wall()
    blurred[:, 130:190] = wall(1)[:, 130:190]  # about the edge of depth it is something else
    edge = small_inverse_depth(CAMERA, step)
    assert depth_share(blurred, wall(), edge)[1] > depth_share(blurred, wall(), inverse * 0 + 0.5)[1]  # type: ignore[index]
