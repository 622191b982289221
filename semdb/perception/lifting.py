"""3D points of keypoints from a depth image.

A plane in space has an inverse depth that is linear in (undistorted) pixels, and structured-light sensors have a
noise that is constant in inverse depth (its depth noise grows with z squared; Khoshelham and Elberink, Sensors
12(2), 2012). So the depth at a keypoint is that of a linear fit of inverse depth over a small window: without bias
on slanted surfaces, at the sub-pixel position, and with a third (3x3) or a fifth (5x5) of one pixel's noise where
pixels are independent.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np

from semdb.geometry import pixels_to_normalized
from semdb.perception._depth import fit_inverse_depth
from semdb.types import Camera, Float32Array, FloatArray

# Inverse depth, 1/m. On a Kinect the largest residual of a 5x5 window is 0.0025 in the median, from 0.5 to 5 m
# alike; the limit is twice that, which is 2 cm at 2 m and 12 cm at 5 m.
RESIDUAL_LIMIT = 0.005
RESIDUAL_SHARE = 0.003  # of the inverse depth itself: for sensors whose error grows with z, and curved surfaces
# Tangent of the angle between surface normal and ray, 83 degrees: beyond it is an edge, or a surface on which a
# pixel's error of position moves the point by more than its depth is good for.
SLOPE_LIMIT = 8.0
_WINDOWS = ((2, 15), (1, 6))  # half width, valid pixels needed; the smaller one serves keypoints close to an edge


def lift(camera: Camera, depth: Float32Array | None, xy: Float32Array) -> Float32Array:
    """Camera-frame points float32 ``[n, 3]`` metres of pixel positions `xy` ``[n, 2]`` as seen (distorted).

    `depth` ``[H, W]`` is metres along z, registered to the image; values not finite or not positive are missing.
    A point is NaN where there is no `depth`, too little of it around the keypoint, or a depth edge.
    """
    points = np.full((len(xy), 3), np.nan, dtype=np.float32)
    if depth is None or not len(xy):
        return points
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    local: FloatArray = np.full(len(xy), np.nan)
    for half, needed in _WINDOWS:
        fit_inverse_depth(
            depth, xy, camera.fx, camera.fy, half, needed, RESIDUAL_LIMIT, RESIDUAL_SHARE, SLOPE_LIMIT, local
        )
    rays = pixels_to_normalized(camera, xy)
    points[:, :2] = rays / local[:, None]
    points[:, 2] = 1 / local
    points[~np.isfinite(points).all(axis=1)] = np.nan
    return points
