"""Lens models that semdb has not, as cameras that it has: five coefficients where they fit, else images made straight.

Rational lenses (k1, k2, p1, p2, k3 to k6, OpenCV's order) and equidistant ones (Kannala and Brandt, OpenCV's fisheye,
k1 to k4) come from ROS, kapture and COLMAP. Within an image many of them are described by the five coefficients to a
fraction of a pixel; a wide fisheye is not, and its images are resampled to a pinhole camera when they are decoded.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from semdb.types import Camera, Float32Array, FloatArray, ImageArray

GOOD_FIT_PX = 0.1  # what keypoints are good for
WIDEST = np.radians(110)  # of the pinhole that a fisheye's images are resampled to, corner to corner
GRID = 33


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens as files give it: `model` is "pinhole", "radial" (up to 8 coefficients) or "fisheye" (4)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "pinhole"
    coefficients: tuple[float, ...] = ()

    def seen(self, xy: FloatArray) -> FloatArray:
        """Pixels ``[n, 2]`` of undistorted normalised coordinates ``[n, 2]``."""
        bend = _fisheye if self.model == "fisheye" else _radial
        found = bend(self.coefficients, xy)
        return np.asarray(found * (self.fx, self.fy) + (self.cx, self.cy))

    def straight(self, pixels: FloatArray) -> FloatArray:
        """Undistorted normalised coordinates ``[n, 2]`` of `pixels` ``[n, 2]``; NaN where there are none."""
        targets = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        xy = _fisheye_start(self.coefficients, targets) if self.model == "fisheye" else targets.copy()
        with np.errstate(all="ignore"):
            for _ in range(100):  # a fixed point: how far the target is missed is subtracted
                xy = xy - (self.seen(xy) - pixels) / (self.fx, self.fy)
            missed = np.abs(self.seen(xy) - pixels).max(axis=1)
        return np.where((missed < 1e-3)[:, None], xy, np.nan)


def _radial(coefficients: tuple[float, ...], xy: FloatArray) -> FloatArray:
    """OpenCV's model: radial polynomials above and below the line, and tangential terms."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *([0.0] * 8))[:8]
    x, y = xy.T
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    seen_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    seen_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([seen_x, seen_y])


def _bent(coefficients: tuple[float, ...], theta: FloatArray) -> FloatArray:
    """The angle at which a fisheye sees one of `theta` radians."""
    k1, k2, k3, k4 = (*coefficients, *([0.0] * 4))[:4]
    t2 = theta * theta
    return np.asarray(theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))


def _fisheye(coefficients: tuple[float, ...], xy: FloatArray) -> FloatArray:
    """Kannala and Brandt's model."""
    radius = np.hypot(*xy.T)
    bent = _bent(coefficients, np.arctan(radius))
    return np.asarray(xy * np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)[:, None])


def _fisheye_start(coefficients: tuple[float, ...], targets: FloatArray) -> FloatArray:
    """Undistorted coordinates of `targets`, by Newton's method in the angle; NaN from 90 degrees on."""
    wanted = np.hypot(*targets.T)
    theta = wanted.copy()
    for _ in range(20):
        step = 1e-6
        slope = (_bent(coefficients, theta + step) - _bent(coefficients, theta - step)) / (2 * step)
        theta = theta - (_bent(coefficients, theta) - wanted) / np.where(np.abs(slope) > 1e-3, slope, 1.0)
    radius = np.where((theta >= 0) & (theta < np.pi / 2), np.tan(np.clip(theta, 0, 1.57)), np.nan)
    return np.asarray(targets * np.where(wanted > 1e-9, radius / np.maximum(wanted, 1e-9), 1.0)[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class Straightener:
    """Makes images of a lens straight: where each pixel of the pinhole camera lies in the image, x and y ``[H, W]``."""

    x: Float32Array
    y: Float32Array

    def color(self, image: ImageArray) -> ImageArray:
        """Colour ``[H, W, 3]``, interpolated linearly; black where the lens saw nothing."""
        return np.asarray(cv2.remap(image, self.x, self.y, cv2.INTER_LINEAR), dtype=np.uint8)

    def depth(self, values: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
        """Depth ``[H, W]`` 16-bit: the nearest pixel's."""
        return np.asarray(cv2.remap(values, self.x, self.y, cv2.INTER_NEAREST), dtype=np.uint16)


def as_camera(lens: Lens) -> tuple[Camera, Straightener | None, str | None]:
    """A camera for `lens`, what makes its images straight where that is needed, and a note where it is not exact."""
    plain = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
    if not any(lens.coefficients):
        return plain, None, None
    if lens.model != "fisheye" and len(lens.coefficients) <= 5:
        return Camera(*_intrinsics(lens), tuple(lens.coefficients)), None, None
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, GRID), np.linspace(0, lens.height - 1, GRID))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    xy = lens.straight(pixels)
    camera, error = _fit(lens, pixels, xy)
    if camera is not None and error <= GOOD_FIT_PX:
        return camera, None, f"the {_name(lens)} lens is described by five coefficients, to {error:.2g} pixels"
    camera, straightener = _straighten(lens, xy)
    note = f"the {_name(lens)} lens has no model in semdb: images are resampled to a pinhole, f {camera.fx:.1f}"
    return camera, straightener, note


def _intrinsics(lens: Lens) -> tuple[int, int, float, float, float, float]:
    return lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy


def _name(lens: Lens) -> str:
    return "fisheye" if lens.model == "fisheye" else "rational"


def _fit(lens: Lens, pixels: FloatArray, xy: FloatArray) -> tuple[Camera | None, float]:
    """The camera with five coefficients that sees `xy` most as the lens does, and its largest error in pixels."""
    if not np.isfinite(xy).all():
        return None, np.inf
    from scipy.optimize import least_squares

    def missed(parameters: FloatArray) -> FloatArray:
        fx, fy, cx, cy, *coefficients = parameters
        return np.asarray((_radial(tuple(coefficients), xy) * (fx, fy) + (cx, cy) - pixels).ravel())

    start = np.array([lens.fx, lens.fy, lens.cx, lens.cy, 0, 0, 0, 0, 0])
    found = least_squares(missed, start, x_scale=[100, 100, 100, 100, 0.1, 0.1, 0.01, 0.01, 0.1]).x
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(value) for value in found)
    r2 = np.linspace(0, float((xy * xy).sum(axis=1).max()), 64)
    if min(fx, fy) <= 0 or not (1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0).all():
        return None, np.inf  # it would fold the image
    camera = Camera(lens.width, lens.height, fx, fy, cx, cy, (k1, k2, p1, p2, k3))
    return camera, float(np.abs(missed(found)).max())


def _straighten(lens: Lens, xy: FloatArray) -> tuple[Camera, Straightener]:
    """A pinhole camera of the same size that sees what the lens saw, up to `WIDEST`."""
    known = xy[np.isfinite(xy).all(axis=1)]
    limit = np.tan(WIDEST / 2)
    radius = min(limit, float(np.hypot(*known.T).max(initial=0.1)))
    focal = float(np.hypot(lens.width, lens.height) / 2 / radius)
    camera = Camera(lens.width, lens.height, focal, focal, (lens.width - 1) / 2, (lens.height - 1) / 2)
    v, u = np.mgrid[: lens.height, : lens.width]
    rays = (np.column_stack([u.ravel(), v.ravel()]) - (camera.cx, camera.cy)) / focal
    places = lens.seen(rays).reshape(lens.height, lens.width, 2).astype(np.float32)
    return camera, Straightener(np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1]))
