"""Depth from a camera of its own, coarser than colour or beside it: registered to colour when it is decoded.

What is stored of a frame then is depth as the colour camera sees it, at `SCALE` units a metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semdb.recordings.base import RawDepth
from semdb.types import BoolArray, Camera, Float32Array, FloatArray

SCALE = 5000.0  # 0.2 mm, up to 13.1 m
FULL_WIDTH = 640  # of the images that the usual step between neighbours is meant for
USUAL_STEP = 0.03
EDGE = 0.05  # of the depth: neighbours that differ by more are on either side of an edge


@dataclass(frozen=True, slots=True, eq=False)
class DepthCamera:
    """Where depth comes from: `color_from_depth` ``[4, 4]`` is its pose in the colour camera."""

    camera: Camera
    color_from_depth: FloatArray


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the same image in `width` x `height` pixels; the centre of the first pixel is (0, 0)."""
    sx, sy = width / camera.width, height / camera.height
    cx, cy = (camera.cx + 0.5) * sx - 0.5, (camera.cy + 0.5) * sy - 0.5
    return Camera(width, height, camera.fx * sx, camera.fy * sy, cx, cy, camera.distortion)


def in_color(depth: Float32Array, source: DepthCamera, camera: Camera) -> RawDepth:
    """Depth ``[h, w]`` metres (NaN invalid) of `source` as `camera` sees it."""
    from semdb.recordings.registration import register_to

    step = USUAL_STEP * max(1.0, FULL_WIDTH / depth.shape[1])  # coarser pixels are further apart
    return as_raw(register_to(depth, source.camera, source.color_from_depth, camera, step))


def as_raw(depth: Float32Array, scale: float = SCALE) -> RawDepth:
    """Depth ``[H, W]`` metres as 16-bit values; what is NaN, not positive or too far is invalid."""
    with np.errstate(invalid="ignore"):
        units = np.rint(depth * np.float32(scale))
        known = (units >= 1) & (units < 65535)
    return RawDepth(np.where(known, units, 0).astype(np.uint16), scale)


def confident(depth: Float32Array, confidence: npt.NDArray[np.uint8]) -> Float32Array:
    """Depth ``[h, w]`` metres of ARKit where its confidence (0 low, 1 medium, 2 high) allows it, else NaN.

    Medium confidence counts away from depth edges only: at edges it is a mixture of both sides.
    """
    keep = (confidence >= 2) | ((confidence == 1) & ~near_edge(depth))
    return np.where(keep, depth, np.float32(np.nan))


def near_edge(depth: Float32Array) -> BoolArray:
    """Pixels ``[h, w]`` with a neighbour (of eight) whose depth differs by more than 5 %, or has none."""
    padded = np.pad(depth, 1, mode="edge")
    rows, columns = depth.shape
    windows = [padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3)]
    with np.errstate(invalid="ignore"):
        nearest, farthest = np.min(windows, axis=0), np.max(windows, axis=0)
        return np.asarray(~(farthest - nearest <= EDGE * nearest))
