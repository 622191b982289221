"""Compiled kernels of SURF's orientation and descriptor. `nogil`; every keypoint is computed on its own.

Source: Bay, Ess, Tuytelaars, Van Gool, Speeded-Up Robust Features (CVIU 2008); sample positions, weights and the
search of the orientation (windows of 60 degrees every 5) are those of OpenCV's implementation.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from semdb.perception.features._jit import kernel

GRID = 20  # gradients across the descriptor window, each of size s
CELLS = GRID + 1
ORIENTATION_RADIUS = 6
ORIENTATION_SIGMA = 2.5
DESCRIPTOR_SIGMA = 3.3
DEGREES = 180.0 / math.pi


def gaussian(n: int, sigma: float) -> Any:
    """float32 [n], normalised, centred."""
    x = np.arange(n) - (n - 1) / 2
    weights = np.exp(-(x * x) / (2 * sigma * sigma))
    return (weights / weights.sum()).astype(np.float32)


@kernel
def _orientation(sums: Any, pad: int, height: int, width: int, x: float, y: float, s: float, weights: Any) -> float:
    """Dominant direction of the gradient around (x, y) in degrees, -1 where no gradient can be measured.

    Haar responses of size 4s on a disc of radius 6s; the sector of 60 degrees with the longest sum wins. Angles are
    binned so that a sector is a run of bins (even: a multiple of 5 degrees, odd: those between two) and one
    pass of running sums tries all 72.
    """
    size = 2 * int(np.rint(2 * s))
    if size > height or size > width:
        return -1.0
    half = size // 2
    bins = np.zeros((2, 144), np.float64)
    found = 0
    for i in range(-ORIENTATION_RADIUS, ORIENTATION_RADIUS + 1):
        top = int(np.rint(y + i * s - (size - 1) * 0.5))
        if top < 0 or top > height - size:
            continue
        a, b, c = sums[top + pad], sums[top + half + pad], sums[top + size + pad]
        for j in range(-ORIENTATION_RADIUS, ORIENTATION_RADIUS + 1):
            if i * i + j * j > ORIENTATION_RADIUS * ORIENTATION_RADIUS:
                continue
            left = int(np.rint(x + j * s - (size - 1) * 0.5))
            if left < 0 or left > width - size:
                continue
            p, q, r = left + pad, left + half + pad, left + size + pad
            # differences along columns first: they fit although the sums may have wrapped
            whole_p, whole_q, whole_r = np.int32(c[p] - a[p]), np.int32(c[q] - a[q]), np.int32(c[r] - a[r])
            upper = np.int32(b[r] - a[r]) - np.int32(b[p] - a[p])
            dx = whole_r - 2 * whole_q + whole_p
            dy = (whole_r - whole_p) - 2 * upper
            weight = weights[i + ORIENTATION_RADIUS] * weights[j + ORIENTATION_RADIUS]
            gx, gy = dx * weight, dy * weight
            angle = int(np.rint(math.atan2(gy, gx) * DEGREES)) % 360
            k = 2 * (angle // 5) + (1 if angle % 5 else 0)
            bins[0, k] += gx
            bins[1, k] += gy
            found += 1
    if found == 0:
        return -1.0
    best = -1.0
    best_x = best_y = 0.0
    for sector in range(72):
        sum_x = sum_y = 0.0
        for k in range(2 * sector - 11, 2 * sector + 12):
            sum_x += bins[0, k % 144]
            sum_y += bins[1, k % 144]
        length = sum_x * sum_x + sum_y * sum_y
        if length > best:
            best, best_x, best_y = length, sum_x, sum_y
    return (math.atan2(best_y, best_x) * DEGREES) % 360.0


@kernel
def _strip(a: Any, b: Any, c: Any, d: Any, x: int, fy0: float, fy1: float) -> float:
    """Sum left of column `x` between the top, `fy0` of the way from row a to b, and the bottom, from c to d."""
    return np.int32(c[x] - a[x]) + fy1 * np.int32(d[x] - c[x]) - fy0 * np.int32(b[x] - a[x])


@kernel
def _cell_means(sums: Any, pad: int, x: float, y: float, side: float, sine: float, cosine: float, out: Any) -> None:
    """out[i, j]: mean grey value of the box of side `side` around cell (i, j) of the turned grid centred at (x, y)."""
    rows, columns = sums.shape
    for i in range(CELLS):
        for j in range(CELLS):
            u, v = (j - GRID // 2) * side, (i - GRID // 2) * side
            left = x + cosine * u - sine * v + (pad + 0.5 - side / 2)
            top = y + sine * u + cosine * v + (pad + 0.5 - side / 2)
            left = min(max(left, 0.0), columns - 1 - side - 1e-3)
            top = min(max(top, 0.0), rows - 1 - side - 1e-3)
            right, bottom = left + side, top + side
            x0, x1, y0, y1 = int(left), int(right), int(top), int(bottom)
            fx0, fx1, fy0, fy1 = left - x0, right - x1, top - y0, bottom - y1
            a, b, c, d = sums[y0], sums[y0 + 1], sums[y1], sums[y1 + 1]
            p0 = _strip(a, b, c, d, x0, fy0, fy1)
            p1 = _strip(a, b, c, d, x0 + 1, fy0, fy1)
            q0 = _strip(a, b, c, d, x1, fy0, fy1)
            q1 = _strip(a, b, c, d, x1 + 1, fy0, fy1)
            out[i, j] = (q0 + fx1 * (q1 - q0) - p0 - fx0 * (p1 - p0)) / (side * side)


@kernel
def _collect(means: Any, weights: Any, extended: bool, out: Any) -> None:
    """Sums of the weighted gradients in 4x4 fields of 5x5, as a unit vector."""
    out[:] = 0
    width = 8 if extended else 4
    for i in range(GRID):
        for j in range(GRID):
            weight = weights[i] * weights[j]
            a, b, c, d = means[i, j], means[i, j + 1], means[i + 1, j], means[i + 1, j + 1]
            dx = (b - a + d - c) * weight
            dy = (c - a + d - b) * weight
            k = (i // 5 * 4 + j // 5) * width
            if not extended:
                out[k] += dx
                out[k + 1] += dy
                out[k + 2] += abs(dx)
                out[k + 3] += abs(dy)
            else:
                p = k if dy >= 0 else k + 2
                out[p] += dx
                out[p + 1] += abs(dx)
                q = k + 4 if dx >= 0 else k + 6
                out[q] += dy
                out[q + 1] += abs(dy)
    norm = np.float32(0)
    for k in range(len(out)):
        norm += out[k] * out[k]
    scale = np.float32(1.0) / (np.sqrt(norm) + np.float32(1e-7))
    for k in range(len(out)):
        out[k] *= scale


@kernel
def describe(
    sums: Any,
    pad: int,
    height: int,
    width: int,
    candidates: Any,
    upright: bool,
    extended: bool,
    orientation_weights: Any,
    descriptor_weights: Any,
    start: int,
    stop: int,
    angles: Any,
    descriptors: Any,
) -> None:
    """Angle (degrees, -1: not measurable) and descriptor of the candidates `start` to `stop`.

    A `descriptors` array of no rows leaves the descriptors out.
    """
    means = np.empty((CELLS, CELLS), np.float32)
    for k in range(start, stop):
        x, y, size = candidates[k, 0], candidates[k, 1], candidates[k, 2]
        s = size * 1.2 / 9.0
        angle = 270.0 if upright else _orientation(sums, pad, height, width, x, y, s, orientation_weights)
        angles[k] = angle
        if angle < 0 or len(descriptors) == 0:
            continue
        side = math.floor(CELLS * s) / CELLS
        _cell_means(sums, pad, x, y, side, math.sin(angle / DEGREES), math.cos(angle / DEGREES), means)
        _collect(means, descriptor_weights, extended, descriptors[k])
