from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.geometry import pixels_to_normalized, project
from semdb.perception.lifting import lift
from semdb.types import Camera

PINHOLE = Camera(160, 120, 131.0, 130.0, 79.5, 59.5)
DISTORTED = Camera(160, 120, 129.3, 129.1, 79.6, 63.8, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
VGA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def rays(camera: Camera) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    xy = pixels_to_normalized(camera, np.column_stack([u.ravel(), v.ravel()]))
    return np.column_stack([xy, np.ones(len(xy))])


def plane_depth(camera: Camera, normal: np.ndarray, distance: float, at: np.ndarray | None = None) -> np.ndarray:
    """Exact depth of the plane ``normal . X = distance`` for every pixel, or at pixel positions `at` ``[n, 2]``."""
    if at is None:
        return (distance / (rays(camera) @ normal)).reshape(camera.height, camera.width)
    xy = pixels_to_normalized(camera, at)
    return np.asarray(distance / (np.column_stack([xy, np.ones(len(xy))]) @ normal))


def tilted(degrees: float, azimuth: float = 30.0) -> np.ndarray:
    t, a = np.radians(degrees), np.radians(azimuth)
    return np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])


def positions(camera: Camera, n: int, seed: int = 0, margin: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([margin, margin], [camera.width - 1 - margin, camera.height - 1 - margin], (n, 2)).astype(
        np.float32
    )


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED, VGA])
@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_planes_are_exact_at_sub_pixel_positions(camera: Camera, tilt: float) -> None:
    normal = tilted(tilt)
    distance = 2.0 * normal[2]  # 2 m along the optical axis
    depth = plane_depth(camera, normal, distance).astype(np.float32)
    depth[(depth <= 0) | (depth > 8)] = np.nan
    xy = positions(camera, 400)
    points = lift(camera, depth, xy)
    truth = plane_depth(camera, normal, distance, xy)
    near = np.isfinite(points[:, 2]) & (truth < 3)
    assert points.dtype == np.float32
    assert near.sum() > 0.97 * (truth[truth > 0] < 3).sum() > 150
    assert np.abs(points[near, 2] - truth[near]).max() < 0.001
    assert np.abs(points[near] @ normal - distance).max() < 0.001
    assert np.abs(project(camera, points[near]) - xy[near]).max() < 1e-3


@settings(max_examples=40, deadline=None)
@given(tilt=st.floats(0, 75), azimuth=st.floats(0, 360), z=st.floats(0.4, 6.0))
def test_any_plane_is_exact_or_missing(tilt: float, azimuth: float, z: float) -> None:
    normal = tilted(tilt, azimuth)
    depth = plane_depth(PINHOLE, normal, z * normal[2]).astype(np.float32)
    xy = positions(PINHOLE, 50, seed=int(azimuth))
    points = lift(PINHOLE, depth, xy)
    truth = plane_depth(PINHOLE, normal, z * normal[2], xy)
    found = np.isfinite(points[:, 2])
    np.testing.assert_allclose(points[found, 2], truth[found], rtol=1e-4)
    if tilt < 30:
        assert found.all()


def test_noise_of_a_kinect_is_averaged_and_accepted() -> None:
    """Its standard deviation grows with z squared; so does what is taken as one surface."""
    rng = np.random.default_rng(1)
    normal = tilted(40)
    for z in (1.0, 2.0, 4.0):
        exact = plane_depth(VGA, normal, z * normal[2])
        noisy = (1 / (1 / exact + rng.normal(0, 1e-3, exact.shape))).astype(np.float32)
        xy = positions(VGA, 2000)
        points = lift(VGA, noisy, xy)
        error = points[:, 2] - plane_depth(VGA, normal, z * normal[2], xy)
        found = np.isfinite(error)
        assert found.mean() > 0.95
        assert np.std(error[found] / points[found, 2] ** 2) < 1e-3 / 4
        assert abs(np.mean(error[found])) < 1e-4 * z * z


def test_the_same_roughness_is_noise_far_away_and_an_edge_close_by() -> None:
    xy = positions(PINHOLE, 200)
    rng = np.random.default_rng(2)
    roughness = rng.normal(0, 0.02, (120, 160))
    assert np.isfinite(lift(PINHOLE, (4.5 + roughness).astype(np.float32), xy)[:, 2]).mean() > 0.95
    assert np.isfinite(lift(PINHOLE, (0.8 + roughness).astype(np.float32), xy)[:, 2]).mean() < 0.05


@pytest.mark.parametrize(("near", "far"), [(0.8, 0.9), (2.0, 2.25), (2.0, 5.0), (1.0, np.inf)])
def test_edges_are_missing_and_do_not_bleed(near: float, far: float) -> None:
    depth = np.full((120, 160), near, dtype=np.float32)
    depth[:, 80:] = far
    on_edge = np.array([[79.5, 60], [79.4, 30], [79.6, 30.5]], dtype=np.float32)
    if np.isfinite(far):
        assert np.isnan(lift(PINHOLE, depth, on_edge)).all()
    beside = np.array([[78, 60], [77.6, 60.4], [70, 20]], dtype=np.float32)
    np.testing.assert_allclose(lift(PINHOLE, depth, beside)[:, 2], near, rtol=1e-6)
    behind = lift(PINHOLE, depth, np.array([[81, 60], [90, 60]], dtype=np.float32))[:, 2]
    np.testing.assert_allclose(behind, far if np.isfinite(far) else np.nan, rtol=1e-6)


def test_a_corner_in_front_is_not_mixed_with_what_is_behind() -> None:
    depth = np.full((120, 160), 3.0, dtype=np.float32)
    depth[40:80, 50:100] = 1.5
    v, u = np.mgrid[30:90:0.7, 40:110:0.7]
    points = lift(PINHOLE, depth, np.column_stack([u.ravel(), v.ravel()]).astype(np.float32))
    found = points[np.isfinite(points[:, 2]), 2]
    assert len(found) > 0.85 * u.size
    assert set(np.round(found, 4)) == {np.float32(1.5), np.float32(3.0)}


def test_missing_depth_is_nan_but_small_holes_are_bridged() -> None:
    depth = plane_depth(PINHOLE, tilted(30), 1.5).astype(np.float32)
    depth[50, 60] = np.nan
    depth[20:30, 20:30] = 0
    depth[80:90, 20:30] = np.nan
    depth[80:90, 100:110] = -1
    xy = np.array([[60, 50], [25, 25], [25, 85], [105, 85]], dtype=np.float32)
    points = lift(PINHOLE, depth, xy)
    assert points[0, 2] == pytest.approx(plane_depth(PINHOLE, tilted(30), 1.5, xy[:1])[0], abs=1e-4)
    assert np.isnan(points[1:]).all()


def test_positions_outside_and_at_the_rim() -> None:
    depth = np.full((120, 160), 2.0, dtype=np.float32)
    xy = np.array([[-5, 10], [200, 10], [80, 1e9], [np.nan, 10], [0, 60], [159, 60], [1, 1]], dtype=np.float32)
    points = lift(PINHOLE, depth, xy)
    assert np.isnan(points[:4]).all()
    np.testing.assert_allclose(points[4:, 2], 2.0, rtol=1e-6)


def test_without_depth_or_keypoints() -> None:
    assert np.isnan(lift(PINHOLE, None, positions(PINHOLE, 7))).all()
    assert lift(PINHOLE, None, positions(PINHOLE, 7)).shape == (7, 3)
    empty = lift(PINHOLE, np.ones((120, 160), dtype=np.float32), np.zeros((0, 2), dtype=np.float32))
    assert empty.shape == (0, 3)
    assert empty.dtype == np.float32


def test_depth_is_not_changed() -> None:
    depth = np.zeros((120, 160), dtype=np.float32)
    depth[:, 50:] = 2
    before = depth.copy()
    lift(PINHOLE, depth, positions(PINHOLE, 5))
    np.testing.assert_array_equal(depth, before)
