"""Surfaces of an image with depth: points, normals and grey values, a few thousand, for dense alignment."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semdb.geometry import normalized_to_pixels
from semdb.geometry.sensor import depth_noise
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

ACROSS = 160  # pixels of the finest level
LEVELS = 2
DETAIL = 7  # pixels across the surroundings
MOST_DETAIL = 30.0  # of 255: single edges are not to decide alone
JUMP = 0.04  # of depth: more between neighbours is an edge


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One resolution of an image without distortion. `depth` metres, NaN where it is not known or jumps."""

    intrinsics: FloatArray  # fx, fy, cx, cy
    depth: Float32Array  # [h, w]
    grey: Float32Array  # [h, w]
    detail: Float32Array  # [h, w] grey less its surroundings: what is texture, and not light
    variance: Float32Array  # [h, w] of depth, m^2
    points: FloatArray  # [n, 3] camera frame, where there is a normal
    normals: FloatArray  # [n, 3]
    point_variance: FloatArray  # [n]
    point_grey: FloatArray  # [n]
    point_detail: FloatArray  # [n]


Surfaces = tuple[Level, ...]  # fine to coarse


def surfaces_of(camera: Camera, depth: Float32Array, grey: ImageArray) -> Surfaces | None:
    """The levels of an image ``[H, W]`` with `depth` ``[H, W]``; None where too little depth is known."""
    from semdb.localization.surface_kernels import reduce_depth

    found = []
    first = max(1, round(camera.width / ACROSS))
    for step in (first << level for level in range(LEVELS)):
        height, width = camera.height // step, camera.width // step
        if height < 8 or width < 8:
            break
        small = np.empty((height, width), np.float32)
        reduce_depth(np.ascontiguousarray(depth, np.float32), step, JUMP, small)
        part = grey[: height * step, : width * step].astype(np.float32)
        brightness = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.float32)
        middle = (step - 1) / 2
        seen = Camera(
            width, height, camera.fx / step, camera.fy / step,
            (camera.cx - middle) / step, (camera.cy - middle) / step, camera.distortion,
        )  # fmt: skip
        found.append(_level(seen, small, brightness))
    return tuple(found) if found and len(found[-1].points) >= 50 else None


def _level(camera: Camera, depth: Float32Array, grey: Float32Array) -> Level:
    from semdb.localization.surface_kernels import normals_of

    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    height, width = depth.shape
    v, u = np.mgrid[:height, :width].astype(np.float64)
    x, y = (u - cx) / fx, (v - cy) / fy
    if any(camera.distortion):
        at = normalized_to_pixels(camera, np.column_stack([x.ravel(), y.ravel()])).reshape(height, width, 2)
        at = np.nan_to_num(at, nan=-1e4).astype(np.float32)
        depth = np.asarray(cv2.remap(depth, at, None, cv2.INTER_NEAREST, borderValue=float("nan")), np.float32)
        grey = np.asarray(cv2.remap(grey, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)
    normals = np.empty((height, width, 3))
    normals_of(depth, fx, fy, cx, cy, JUMP, normals)
    variance = depth_noise(depth) ** 2
    whole = np.isfinite(normals[..., 0])
    points = np.stack([x * depth, y * depth, depth.astype(np.float64)], axis=-1)[whole]
    grey = cv2.GaussianBlur(grey, (3, 3), 0.8)
    detail = np.clip(grey - cv2.boxFilter(grey, -1, (DETAIL, DETAIL)), -MOST_DETAIL, MOST_DETAIL)
    return Level(
        intrinsics=np.array([fx, fy, cx, cy]),
        depth=np.ascontiguousarray(depth),
        grey=np.ascontiguousarray(grey),
        detail=np.ascontiguousarray(detail),
        variance=variance.astype(np.float32),
        points=points,
        normals=normals[whole],
        point_variance=variance[whole],
        point_grey=grey[whole].astype(np.float64),
        point_detail=detail[whole].astype(np.float64),
    )
