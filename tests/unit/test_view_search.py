"""Poses from which the whole of a query looks like what a keyframe saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import pose_error
from semdb.localization.predicted_view import PlacedView, small_view
from semdb.localization.view_search import SearchOptions, search_views
from semdb.localization.view_search_kernels import correlation
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
OPTIONS = SearchOptions()


def pose_of(x: float, y: float, z: float, turn_deg: float) -> FloatArray:
    pose, turn = np.eye(4), np.radians(turn_deg)
    pose[0, 0], pose[0, 2], pose[2, 0], pose[2, 2] = np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)
    pose[:3, 3] = x, y, z
    return pose


def corner(pose: FloatArray) -> tuple[ImageArray, Float32Array]:
    """Two plain walls that meet, x = 1.5 and z = 2.5, on a dark floor, y = 1.2; a board on the one behind."""
    v, u = np.mgrid[:240, :320].astype(np.float64)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1) @ pose[:3, :3].T
    at = pose[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.array([1.5, 1.2, 2.5]) - at) / rays
    reach[reach <= 0] = np.inf
    wall, depth = reach.argmin(axis=-1), reach.min(axis=-1)
    points = at + rays * depth[..., None]
    grey = np.choose(wall, [190.0, 90.0, 215.0])
    board = (wall == 2) & (np.abs(points[..., 0] - 0.1) < 0.5) & (np.abs(points[..., 1] + 0.1) < 0.4)
    grey[board] = 60
    return grey.astype(np.uint8), depth.astype(np.float32)


def placed(number: int, pose: FloatArray) -> PlacedView:
    grey, depth = corner(pose)
    return PlacedView(number, pose, small_view(CAMERA, grey, depth))


@pytest.mark.parametrize("truth", [(0.3, 0.05, -0.3, 26.0), (-0.35, 0.0, 0.2, -20.0), (0.0, 0.0, 0.0, 0.0)])
def test_a_plain_place_is_found_from_aside(truth: tuple[float, float, float, float]) -> None:
    pose = pose_of(*truth)
    query = small_view(CAMERA, corner(pose)[0])
    found = search_views(query, [placed(1, pose_of(0, 0, 0, 0)), placed(2, pose_of(0, 0, 0, 90))], OPTIONS)
    metres, degrees = pose_error(found[0], pose)
    assert metres < 0.2
    assert degrees < 4
    assert 1 <= len(found) <= OPTIONS.kept


def test_nothing_is_found_where_nothing_is_to_be_seen() -> None:
    keyframe = placed(1, pose_of(0, 0, 0, 0))
    plain = small_view(CAMERA, np.full((240, 320), 200, np.uint8))
    assert search_views(plain, [keyframe], OPTIONS) == []
    assert search_views(plain, [], OPTIONS) == []
    bare = replace(keyframe, view=replace(keyframe.view, depth=None))
    assert search_views(small_view(CAMERA, corner(pose_of(0, 0, 0, 0))[0]), [bare], OPTIONS) == []


def test_what_is_brighter_correlates_as_well_and_little_overlap_counts_less() -> None:
    view = small_view(CAMERA, *corner(pose_of(0, 0, 0, 0)))
    assert view.depth is not None
    v, u = (part.ravel() for part in np.mgrid[2 : view.grey.shape[0] - 2 : 4, 2 : view.grey.shape[1] - 2 : 4])
    z = view.depth[v, u].astype(float)
    fx, fy, cx, cy = view.intrinsics
    points, values = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], -1), view.grey[v, u]
    assert correlation(points, values, 1, view.grey, view.intrinsics, np.eye(4)) == pytest.approx(1, abs=1e-4)
    assert correlation(points, values * np.float32(0.5), 1, view.grey, view.intrinsics, np.eye(4)) > 0.999
    aside = correlation(points, values, 1, view.grey, view.intrinsics, pose_of(0, 0, 0, 50))
    assert aside < 0.8
    assert correlation(points, values, 1, view.grey, view.intrinsics, pose_of(0, 0, 0, 180)) == -1
