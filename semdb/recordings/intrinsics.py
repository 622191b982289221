"""Which intrinsics no camera has, and which are to be doubted: numbers in another unit, order, or of another image."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from semdb.geometry import pixels_to_normalized
from semdb.shown import number
from semdb.types import Camera, FloatArray

SHORTEST, LONGEST = 0.2, 20.0  # focal lengths in image widths: 136 and 3 degrees of view
LEAST_SCALE, MOST_SCALE = 10.0, 1e6  # units per metre: a unit of 10 cm is no depth image, 65 mm are no range
FOLDED = 0.02  # share of an image's pixels that a calibration may not reach
MOST_STRETCH = 4.0
UNEQUAL = 1.3  # fx to fy: images that were stretched from 16:9 to 4:3
OFF_CENTRE = 0.2  # of the image's size
TANGENTIAL = 0.02


def camera_problem(camera: Camera) -> str | None:
    """Why nothing has these intrinsics at this size; None where something may."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    if not all(math.isfinite(number) for number in numbers):
        return "has a number that is not finite"
    size = f"{camera.width}x{camera.height}"
    shortest, longest = SHORTEST * camera.width, LONGEST * camera.width
    for name, focal in (("fx", camera.fx), ("fy", camera.fy)):
        if not shortest <= focal <= longest:
            return (
                f"{name} is {number(focal)} pixels, which no camera with images of {size} has: from {number(shortest)} "
                f"to {number(longest)} make sense{_unit_hint(camera)}"
            )
    if not (0 < camera.cx < camera.width - 1 and 0 < camera.cy < camera.height - 1):
        return (
            f"the principal point ({number(camera.cx)}, {number(camera.cy)}) is not inside the images of {size}"
            f"{_size_hint(camera)}"
        )
    share, stretch = distortion_effect(camera)
    values = ", ".join(map(number, camera.distortion))
    if share > FOLDED:
        return (
            f"the distortion {values} folds {share:.0%} of an image of {size} over the rest: k1, k2, p1, p2, k3 of "
            "OpenCV's model are needed, in this order"
        )
    if stretch > MOST_STRETCH:
        return (
            f"the distortion {values} moves pixels of an image of {size} by a factor of {stretch:.3g}, which no lens "
            "does: k1, k2, p1, p2, k3 of OpenCV's model are needed, in this order"
        )
    return None


def camera_doubts(camera: Camera) -> list[str]:
    """What is unlikely about possible intrinsics, for people."""
    doubts = []
    ratio = max(camera.fx, camera.fy) / min(camera.fx, camera.fy)
    if ratio > UNEQUAL:
        doubts.append(
            f"fx {number(camera.fx)} and fy {number(camera.fy)} differ by {ratio - 1:.0%}: the order is fx, fy, cx, cy"
        )
    off_x = abs(camera.cx - (camera.width - 1) / 2) / camera.width
    off_y = abs(camera.cy - (camera.height - 1) / 2) / camera.height
    if max(off_x, off_y) > OFF_CENTRE:
        doubts.append(
            f"the principal point ({number(camera.cx)}, {number(camera.cy)}) is far from the centre of images of "
            f"{camera.width}x{camera.height}: are the intrinsics of this size?"
        )
    if len(camera.distortion) >= 4 and max(map(abs, camera.distortion[2:4])) > TANGENTIAL:
        p1, p2 = camera.distortion[2:4]
        doubts.append(
            f"the distortion's p1 {number(p1)} and p2 {number(p2)} are larger than lenses have: the order is k1, k2, "
            "p1, p2, k3, and the k1 to k4 of a fisheye model are something else"
        )
    return doubts


def depth_scale_problem(scale: float) -> str | None:
    """Why no depth image has so many units per metre; None where one may."""
    if not math.isfinite(scale) or not LEAST_SCALE <= scale <= MOST_SCALE:
        hint = (
            f"; metres per unit {number(scale)} are {number(1 / scale)} units per metre"
            if 0 < scale <= 1 / LEAST_SCALE
            else ""
        )
        return (
            f"a depth scale of {number(scale)} units per metre makes no sense (from {number(LEAST_SCALE)} to "
            f"{number(MOST_SCALE)} do; millimetres are 1000){hint}"
        )
    return None


@lru_cache(maxsize=64)  # asked of every image, and cameras are few
def distortion_effect(camera: Camera) -> tuple[float, float]:
    """The share of the image that the distortion does not reach, or reaches twice (there it folds the image over); and
    the greatest ratio, either way, of distances from the centre with and without it.
    """
    if not any(camera.distortion):
        return 0.0, 1.0
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25))
    xy = pixels_to_normalized(camera, np.column_stack([u.ravel(), v.ravel()]))
    good = np.isfinite(xy).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for part in np.linspace(0, 1, 9)[1:]:  # from the centre on it must never turn back
            good &= _jacobian(camera.distortion, part * np.nan_to_num(xy)) > 0
        seen = np.hypot((u.ravel() - camera.cx) / camera.fx, (v.ravel() - camera.cy) / camera.fy)
        ratio = (seen / np.hypot(xy[:, 0], xy[:, 1]))[good & (seen > 0.05)]
    stretch = float(max(ratio.max(), (1 / ratio).max())) if len(ratio) else 1.0
    return float(1 - good.mean()), stretch


def _jacobian(distortion: tuple[float, ...], xy: FloatArray) -> FloatArray:
    """Determinant ``[n]`` of the derivative of OpenCV's distortion at normalised coordinates ``[n, 2]``."""
    k1, k2, p1, p2, k3 = (*distortion, 0.0, 0.0, 0.0, 0.0)[:5]
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    dxx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    dxy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    dyy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return np.asarray(dxx * dyy - dxy * dxy)


def _unit_hint(camera: Camera) -> str:
    if camera.fx < 5 and camera.fy < 5 and abs(camera.cx) <= 1.5 and abs(camera.cy) <= 1.5:
        pixels = (
            camera.fx * camera.width,
            camera.fy * camera.height,
            camera.cx * camera.width,
            camera.cy * camera.height,
        )
        return f"; divided by the image's size they would be {','.join(map(number, pixels))} in pixels"
    commas = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    if len(commas) >= 8 and all(value == int(value) for value in commas):
        return "; were these decimal commas? numbers are written with points"
    return "; intrinsics are pixels, in the order fx, fy, cx, cy"


def _size_hint(camera: Camera) -> str:
    times = max((2 * camera.cx + 1) / camera.width, (2 * camera.cy + 1) / camera.height)
    if 1.2 < times < 20:
        return f": are these the intrinsics of images {times:.3g} times as large?"
    return ": it is given in pixels"
