"""Depth and grey values of a frame at a quarter of its size: what its surfaces are made of, when they are asked for."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semdb.localization.surfaces import ACROSS, JUMP, Surfaces, surfaces_of
from semdb.types import Camera, Float32Array, ImageArray


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """A small image with depth, about 100 KiB: `depth` ``[h, w]`` metres (NaN where not known, or it jumps)."""

    camera: Camera
    depth: Float32Array
    grey: ImageArray  # [h, w]

    def surfaces(self) -> Surfaces | None:
        """Points, normals and grey values in two sizes; None where too little depth is known."""
        return surfaces_of(self.camera, self.depth, self.grey)


def surface_view(camera: Camera, depth: Float32Array | None, grey: ImageArray | None) -> SurfaceView | None:
    """The small image of `depth` ``[H, W]`` and `grey` ``[H, W]``; None without one of both."""
    from semdb.localization.surface_kernels import reduce_depth

    if depth is None or grey is None:
        return None
    step = max(1, round(camera.width / ACROSS))
    height, width = camera.height // step, camera.width // step
    small = np.empty((height, width), np.float32)
    reduce_depth(np.ascontiguousarray(depth, np.float32), step, JUMP, small)
    cut = grey[: height * step, : width * step]
    middle = (step - 1) / 2
    seen = Camera(
        width, height, camera.fx / step, camera.fy / step,
        (camera.cx - middle) / step, (camera.cy - middle) / step, camera.distortion,
    )  # fmt: skip
    return SurfaceView(seen, small, np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)))
