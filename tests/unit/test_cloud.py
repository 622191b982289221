"""Coloured points of a map."""

from __future__ import annotations

import numpy as np

from semdb.pictures.cloud import cloud_of, points_of_depth, points_of_keypoints, spread
from semdb.types import Camera

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)


def test_points_of_depth_are_where_they_are_seen() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = np.nan, 0, 99
    image = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    pose = np.eye(4)
    pose[:3, 3] = (1, 2, 3)
    points, colours = points_of_depth(image, depth, CAMERA, pose, 48)
    assert points.shape == (45, 3)
    np.testing.assert_allclose(points[0], [1 + (3 - 3.5) / 5, 2 - 2.5 / 5, 5])
    assert colours[0].tolist() == image[0, 3].tolist()
    assert len(points_of_depth(image, depth, CAMERA, pose, 12)[0]) == 12


def test_keypoints_without_a_place_are_left_out() -> None:
    image = np.full((6, 8, 3), 7, np.uint8)
    xy = np.array([[1, 1], [99, 99]], np.float32)
    points, colours = points_of_keypoints(image, xy, np.array([[np.nan] * 3, [0, 0, 1]], np.float32), np.eye(4))
    assert (points.tolist(), colours.tolist()) == ([[0, 0, 1]], [[7, 7, 7]])


def test_a_cloud_has_at_most_so_many_points_spread_evenly_and_is_always_the_same() -> None:
    random = np.random.default_rng(1)
    parts = [(random.uniform(0, 4, (5000, 3)).astype(np.float32), np.zeros((5000, 3), np.uint8)) for _ in range(3)]
    cloud = cloud_of(parts, 1000)
    assert 500 < len(cloud.points) <= 1000
    assert cloud.keyframes == 3
    np.testing.assert_array_equal(cloud.points, cloud_of(parts, 1000).points)
    np.testing.assert_allclose(cloud.points[:200].mean(axis=0), [2, 2, 2], atol=0.3)
    packed = cloud.packed()
    count = len(cloud.points)
    assert len(packed) == 32 + 9 * count
    low, step = np.frombuffer(packed, "<f4", 6, 8).reshape(2, 3)
    grid = np.frombuffer(packed, "<u2", 3 * count, 32).reshape(-1, 3)
    assert np.frombuffer(packed, "<u4", 2).tolist() == [count, 3]
    np.testing.assert_allclose(low + grid * step, cloud.points, atol=1e-4)


def test_a_cloud_of_nothing() -> None:
    assert len(cloud_of([], 10).packed()) == 32
    one = cloud_of([(np.ones((1, 3), np.float32), np.ones((1, 3), np.uint8))], 10)
    assert np.frombuffer(one.packed(), "<f4", 3, 8).tolist() == [1, 1, 1]


def test_spread_takes_poses_that_lie_apart() -> None:
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 10, 100) ** 2
    chosen = spread(poses, 5)
    assert (len(chosen), chosen[0], chosen[-1]) == (5, 0, 99)
    assert np.diff(poses[chosen, 0, 3]).min() > 15
    assert spread(poses[:3], 5) == [0, 1, 2]
