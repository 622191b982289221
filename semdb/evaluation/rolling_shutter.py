"""Keypoints of an image that was read out row by row while the camera turned, brought to the time of its middle row.

COLMAP knows no such camera. But the turn of a camera is known from its recorded poses, and what a turn does to a pixel
does not depend on how far away the point is. So only one number is unknown, the time from the first row to the last,
and structure from motion itself tells it: with the right one the images agree best.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from semdb.evaluation.colmap import HALF_PIXEL, PosedImages, SiftImage, image_points
from semdb.geometry import normalized_to_pixels, pixels_to_normalized, pose_from, project, so3_log, transform_points
from semdb.types import Camera, FloatArray

LOSS_PX = 1.0  # Cauchy, as in the bundle adjustment
STEP_S = 1e-3  # of the numerical derivative by the readout time
MAX_GAP_S = 0.3  # between poses that tell how the camera turned in the middle
OVERSTEP = 2.5  # the points that the step holds follow the images: by itself it goes 0.4 of the way
MIN_POINTS = 12  # of an image that has a say


def rates_between(poses: FloatArray, times_s: FloatArray) -> FloatArray:
    """How a camera turns at each of its `poses` ``[n, 4, 4]``, ``[n, 3]`` in radians a second.

    `times_s` ``[n]`` ascend. From the pose before to the one after, in the camera's frame; zero where
    these are more than 0.3 s apart.
    """
    rates = np.zeros((len(poses), 3))
    for i in range(len(poses)):
        before, after = max(i - 1, 0), min(i + 1, len(poses) - 1)
        passed = times_s[after] - times_s[before]
        if 0 < passed <= MAX_GAP_S:
            rates[i] = so3_log(poses[before, :3, :3].T @ poses[after, :3, :3]) / passed
    return rates


def unrolled(
    xy: FloatArray, points: FloatArray, camera: Camera, rate: FloatArray, readout_s: float
) -> tuple[FloatArray, FloatArray]:
    """Pixels ``[k, 2]`` as COLMAP counts and camera-frame points ``[k, 3]`` as at the time of the middle row.

    `rate` ``[3]`` is how the camera turns, in radians a second in its own frame; `readout_s` the time from the first
    row to the last.
    """
    pixels = np.asarray(xy, np.float64) - HALF_PIXEL
    turn = (pixels[:, 1:] / camera.height - 0.5) * readout_s * rate  # [k, 3], small
    rays = np.column_stack([pixels_to_normalized(camera, pixels), np.ones(len(pixels))])
    turned = _turned(turn, rays)
    moved = normalized_to_pixels(camera, turned[:, :2] / turned[:, 2:]) + HALF_PIXEL
    return np.asarray(moved), _turned(turn, points)


def readout_step(
    model: Any, described: Sequence[SiftImage], posed: PosedImages, rates: FloatArray, readout_s: float
) -> float:
    """By how many seconds the readout time should change from `readout_s`, which `posed` was unrolled with.

    One Gauss-Newton step over the residuals of `model`, with the pose of every image free and the points held, made
    longer by what points that follow would allow.
    """
    along = square = 0.0
    for i, image in enumerate(described):
        rows, world = image_points(model, i + 1)
        if len(rows) < MIN_POINTS:
            continue
        camera = posed.cameras[i]
        inverse = model.images[i + 1].cam_from_world().matrix()
        local = transform_points(pose_from(inverse[:, :3], inverse[:, 3]), world)
        none = np.zeros((len(rows), 3))
        later, _ = unrolled(image.xy[rows], none, camera, rates[i], readout_s + STEP_S)
        now = posed.images[i].xy[rows]
        slope = (later - now) / STEP_S
        residual = now - (project(camera, local) + HALF_PIXEL)
        weight = 1 / np.sqrt(1 + (residual**2).sum(axis=1) / LOSS_PX**2)
        basis = np.linalg.qr((_pose_jacobian(camera, local) * weight[:, None, None]).reshape(-1, 6))[0]
        slope, residual = (slope * weight[:, None]).ravel(), (residual * weight[:, None]).ravel()
        slope -= basis @ (basis.T @ slope)
        along += float(slope @ residual)
        square += float(slope @ slope)
    return -OVERSTEP * along / square if square > 0 else 0.0


def _turned(turn: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors ``[k, 3]`` turned by small rotation vectors ``[k, 3]`` (second order)."""
    once = np.cross(turn, vectors)
    return np.asarray(vectors + once + 0.5 * np.cross(turn, once))


def _pose_jacobian(camera: Camera, local: FloatArray) -> FloatArray:
    """``[k, 2, 6]``: what a step and a turn of the camera do to the pixels of camera-frame points (pinhole)."""
    x, y, z = local.T
    by_point = np.zeros((len(local), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    by_turn = np.cross(np.eye(3)[None], local[:, None, :])  # [k, axis, 3]: axis x point
    return np.concatenate([by_point, np.einsum("kij,kaj->kia", by_point, by_turn)], axis=2)
