"""The example of a ROS 2 node: what it makes of messages and answers, without ROS."""

from __future__ import annotations

import importlib.util
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semdb.geometry import so3_exp
from tests.conftest import REPOSITORY

_SPEC = importlib.util.spec_from_file_location("ros2_localizer", REPOSITORY / "examples" / "ros2_localizer.py")
assert _SPEC is not None
assert _SPEC.loader is not None
node: Any = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(node)

# REP 103: the optical frame's x is right (-y of the body), its y down (-z), its z forward (x)
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def message(encoding: str, values: Any, pad: int = 0, big: int = 0) -> SimpleNamespace:
    rows = [row.tobytes() + b"\7" * pad for row in values]
    height, width = values.shape[:2]
    return SimpleNamespace(
        encoding=encoding, height=height, width=width, step=len(rows[0]), data=b"".join(rows), is_bigendian=big
    )


def test_images() -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (4, 5, 3), np.uint8)
    alpha = np.concatenate([rgb, np.full((4, 5, 1), 9, np.uint8)], axis=2)
    assert np.array_equal(node.image_of(message("rgb8", rgb, pad=3)), rgb)
    assert np.array_equal(node.image_of(message("bgr8", rgb[..., ::-1])), rgb)
    assert np.array_equal(node.image_of(message("rgba8", alpha)), rgb)
    assert np.array_equal(node.image_of(message("bgra8", alpha[..., [2, 1, 0, 3]])), rgb)
    grey = node.image_of(message("mono8", rgb[..., 0], pad=1))
    assert grey.shape == (4, 5, 3)
    assert np.array_equal(grey[..., 2], rgb[..., 0])
    with pytest.raises(ValueError, match="bayer_rggb8"):
        node.image_of(message("bayer_rggb8", rgb[..., 0]))


def test_depth() -> None:
    units = np.array([[0, 1000, 65535], [258, 2, 3]], np.uint16)
    for big in (0, 1):
        sent = units.astype(">u2" if big else "<u2")
        found, scale = node.depth_of(message("16UC1", sent, pad=2, big=big))
        assert (found.dtype, found.tolist(), scale) == (np.uint16, units.tolist(), 1000.0)
    metres = np.array([[1.5, np.nan]], np.float32)
    found, scale = node.depth_of(message("32FC1", metres))
    assert np.array_equal(found, metres, equal_nan=True)
    assert scale is None
    with pytest.raises(ValueError, match="rgb8"):
        node.depth_of(message("rgb8", units))


def test_cameras() -> None:
    k = [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
    of = SimpleNamespace
    assert node.camera_of(of(k=k, d=[], distortion_model="")) == (500, 510, 320, 240)
    assert node.camera_of(of(k=k, d=[0.0] * 5, distortion_model="plumb_bob")) == (500, 510, 320, 240)
    lens = [0.1, -0.2, 0.001, 0.002, 0.03]
    assert node.camera_of(of(k=k, d=lens, distortion_model="plumb_bob"))[4:] == tuple(lens)
    assert node.camera_of(of(k=k, d=[*lens, 0, 0, 0], distortion_model="rational_polynomial"))[4:] == tuple(lens)
    for model, numbers in (("equidistant", [0.1] * 4), ("rational_polynomial", [0.1] * 8)):
        with pytest.raises(ValueError, match=model):
            node.camera_of(of(k=k, d=numbers, distortion_model=model))


def test_the_base_of_a_robot_that_looks_along_x() -> None:
    """The camera is 0.2 m ahead of and 1 m above the base, which stands at (2, 3, 0) and looks along the map's y."""
    mounted = np.eye(4)
    mounted[:3, :3], mounted[:3, 3] = OPTICAL, (0.2, 0.0, 1.0)
    base = node.matrix_of((2.0, 3.0, 0.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    camera = base @ mounted
    np.testing.assert_allclose(camera[:3, 3], (2.0, 3.2, 1.0), atol=1e-12)
    np.testing.assert_allclose(camera[:3, 2], (0.0, 1.0, 0.0), atol=1e-12)  # looks along y
    np.testing.assert_allclose(node.base_in_map(camera, mounted), base, atol=1e-12)
    odom = node.matrix_of((-1.0, 0.5, 0.0), (0.0, 0.0, 0.1, 0.9))
    correction = node.map_from_odom(base, odom)
    np.testing.assert_allclose(correction @ odom, base, atol=1e-12)
    message = SimpleNamespace(
        header=SimpleNamespace(),
        pose=SimpleNamespace(pose=SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())),
    )
    covariance = np.arange(36.0).reshape(6, 6)
    filled = node.fill_pose(message, 7, "map", base, covariance)
    at, turn = filled.pose.pose.position, filled.pose.pose.orientation
    np.testing.assert_allclose((at.x, at.y, at.z), (2, 3, 0))
    np.testing.assert_allclose((turn.x, turn.y, turn.z, turn.w), (0, 0, np.sqrt(0.5), np.sqrt(0.5)))
    assert (filled.header.stamp, filled.header.frame_id) == (7, "map")
    assert filled.pose.covariance[:7] == [0, 1, 2, 3, 4, 5, 6]  # row by row
    moved = SimpleNamespace(header=SimpleNamespace(), transform=SimpleNamespace())
    moved.transform.translation, moved.transform.rotation = SimpleNamespace(), SimpleNamespace()
    node.fill_transform(moved, 7, "map", "odom", correction)
    np.testing.assert_allclose(node.matrix_of_transform(moved.transform), correction, atol=1e-12)
    assert moved.child_frame_id == "odom"


def test_the_covariance_of_the_base_is_that_of_many_drawn_poses() -> None:
    rng = np.random.default_rng(1)
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = so3_exp(np.array([0.3, -0.5, 1.1])), (1.0, -2.0, 0.5)
    mounted = np.eye(4)
    mounted[:3, :3], mounted[:3, 3] = OPTICAL, (0.4, 0.1, 1.2)
    spread = rng.normal(size=(6, 6)) * 0.002
    covariance = spread @ spread.T
    base = node.base_in_map(camera, mounted)
    found = node.base_covariance(covariance, camera, base)
    drawn = []
    for change in rng.multivariate_normal(np.zeros(6), covariance, 4000):
        other = camera.copy()
        other[:3, 3] += change[:3]
        other[:3, :3] = so3_exp(change[3:]) @ camera[:3, :3]
        drawn.append([*(node.base_in_map(other, mounted)[:3, 3] - base[:3, 3]), *change[3:]])
    seen = np.cov(np.array(drawn).T)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    assert np.abs((seen - found) / scale).max() < 0.08
