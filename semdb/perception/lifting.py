"""3D points of keypoints from a depth image.

A plane in space has an inverse depth that is linear in (undistorted) pixels, and structured-light sensors have a
noise that is constant in inverse depth (its depth noise grows with z squared; Khoshelham and Elberink, Sensors
12(2), 2012). So the depth at a keypoint is that of a linear fit of inverse depth over a small window: without bias
on slanted surfaces, at the sub-pixel position, and with a third (3x3) or a fifth (5x5) of one pixel's noise where
pixels are independent.
"""

from __future__ import annotations

import numpy as np

from semdb.geometry import pixels_to_normalized
from semdb.types import BoolArray, Camera, Float32Array, FloatArray

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
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth > 0, 1 / depth, np.nan).astype(np.float32)
    inverse[~np.isfinite(inverse)] = np.nan
    local: FloatArray = np.full(len(xy), np.nan)
    for half, needed in _WINDOWS:
        rows = np.flatnonzero(np.isnan(local))
        local[rows] = local_inverse_depth(inverse, xy[rows], (camera.fx, camera.fy), half, needed)
    rays = pixels_to_normalized(camera, xy)
    points[:, :2] = rays / local[:, None]
    points[:, 2] = 1 / local
    points[~np.isfinite(points).all(axis=1)] = np.nan
    return points


def local_inverse_depth(
    inverse: Float32Array, xy: Float32Array, focal: tuple[float, float], half: int, needed: int
) -> FloatArray:
    """Inverse depth ``[n]`` at pixel positions `xy` ``[n, 2]`` from a linear fit over a square window.

    `inverse` ``[H, W]`` is 1/m, NaN where missing; the window is ``2 * half + 1`` pixels wide, centred on the
    nearest pixel; `focal` is fx, fy in pixels. NaN where fewer than `needed` pixels are valid, or the window
    is not one smooth surface.
    """
    values, dx, dy = _windows(inverse, xy, half)
    valid = np.isfinite(values)
    enough = np.count_nonzero(valid, axis=1) >= needed
    filled = np.where(valid, values, 0.0)
    fit = _fit_linear(filled, valid, dx, dy, enough)
    predicted = fit[:, :1] + fit[:, 1:2] * dx + fit[:, 2:] * dy
    middle = fit[:, 0]
    with np.errstate(invalid="ignore"):
        residual = np.where(valid, np.abs(filled - predicted), 0.0).max(axis=1)
        slope = np.hypot(fit[:, 1] * focal[0], fit[:, 2] * focal[1])
        smooth = (residual <= RESIDUAL_LIMIT + RESIDUAL_SHARE * middle) & (slope <= SLOPE_LIMIT * middle)
    return np.where(enough & smooth & (middle > 0), middle, np.nan)


def _windows(inverse: Float32Array, xy: Float32Array, half: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values ``[n, k]`` of the window about each position and the offsets of its pixels from it, both ``[n, k]``."""
    height, width = inverse.shape
    position = np.asarray(xy, dtype=np.float64)
    nearest = np.rint(np.nan_to_num(position, nan=-1e6, posinf=-1e6, neginf=-1e6)).astype(np.intp)
    dv, du = (offset.ravel() for offset in np.mgrid[-half : half + 1, -half : half + 1])
    u, v = nearest[:, :1] + du, nearest[:, 1:] + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    values: FloatArray = inverse[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    values[~inside] = np.nan
    return values, u - position[:, :1], v - position[:, 1:]


def _fit_linear(values: FloatArray, valid: BoolArray, dx: FloatArray, dy: FloatArray, enough: BoolArray) -> FloatArray:
    """Coefficients ``[n, 3]`` (value at the position, slopes in x and y) of a least-squares fit per row."""
    weight = valid.astype(np.float64)
    basis = np.stack([weight, weight * dx, weight * dy], axis=1)  # [n, 3, k]
    normal = basis @ basis.transpose(0, 2, 1)
    right = basis @ values[:, :, None]
    normal[~enough] = np.eye(3)  # no fit is wanted there, and it must not be singular
    # Valid pixels in two lines leave a slope nearly open: a little weight on zero slope keeps the solution finite.
    normal += 1e-9 * np.eye(3)
    return np.asarray(np.linalg.solve(normal, right)[:, :, 0], dtype=np.float64)
