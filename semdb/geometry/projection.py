"""Pinhole projection and back-projection with OpenCV's distortion model. Arrays in, arrays out; float64."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.types import Camera, FloatArray


def project(camera: Camera, points: npt.ArrayLike) -> FloatArray:
    """Pixels ``[n, 2]`` (with distortion) of camera-frame `points` ``[n, 3]`` metres; NaN at or behind z = 0."""
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(p[:, 2:] > 0, p[:, :2] / p[:, 2:], np.nan)
    return normalized_to_pixels(camera, xy)


def _distort(coefficients: tuple[float, ...], x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distorted coordinates, each ``[n]``."""
    k1, k2, p1, p2, k3 = (*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return xd, yd


def normalized_to_pixels(camera: Camera, xy: FloatArray) -> FloatArray:
    """Pixels ``[n, 2]`` of undistorted normalised coordinates ``[n, 2]`` (OpenCV's distortion model)."""
    x, y = xy[:, 0], xy[:, 1]
    if any(camera.distortion):
        x, y = _distort(camera.distortion, x, y)
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)


def pixels_to_normalized(camera: Camera, pixels: npt.ArrayLike) -> FloatArray:
    """Undistorted normalised coordinates ``[n, 2]`` of `pixels` ``[n, 2]`` as seen, by Newton's method.

    NaN where the distortion model cannot be inverted (outside the image of a strongly distorted lens).
    """
    p = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    targets = (p - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    if not any(camera.distortion):
        return targets
    from semdb.geometry.undistort import undistort  # numba takes half a second to import

    coefficients = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    xy = np.empty_like(targets)
    undistort(tuple(map(float, coefficients)), targets, xy)  # type: ignore[no-untyped-call]
    return xy


def back_project(camera: Camera, pixels: npt.ArrayLike, depth: npt.ArrayLike) -> FloatArray:
    """Camera-frame points ``[n, 3]`` of `pixels` ``[n, 2]`` as seen at `depth` ``[n]`` metres (z, not range)."""
    z = np.asarray(depth, dtype=np.float64)
    return np.column_stack([pixels_to_normalized(camera, pixels) * z[:, None], z])
