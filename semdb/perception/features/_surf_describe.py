"""Compiled kernels of SURF's orientation and descriptor. `nogil`; every keypoint is computed on its own.

Source: Bay, Ess, Tuytelaars, Van Gool, Speeded-Up Robust Features (CVIU 2008); sample positions, weights and the
search of the orientation (windows of 60 degrees every 5) are those of OpenCV's implementation.

Arrays are flat and offsets unsigned where time is spent: slices would count references, signed indices would be tested.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from semdb.compiled import kernel
from semdb.perception.features._surf_levels import (
    ALL_COLUMNS,
    ALL_ROWS,
    HALF,
    LEFT,
    MARGIN,
    PART_COLUMNS,
    PART_ROWS,
    STEP,
    TOP,
)

GRID = 20  # gradients across the descriptor window, each of size s
CELLS = GRID + 1  # means of grey across it
RADIUS = 6  # of the disc for the orientation, in units of s
ACROSS = 2 * RADIUS + 1
SECTORS = 72
DEGREES = 180.0 / math.pi


def gaussian(n: int, sigma: float) -> Any:
    """float32 [n, n], product of two normalised Gaussians, centred."""
    x = np.arange(n) - (n - 1) / 2
    weights = np.exp(-(x * x) / (2 * sigma * sigma))
    weights /= weights.sum()
    return np.outer(weights, weights).astype(np.float32)


@lru_cache(maxsize=1)
def orientation_weights() -> Any:
    """float32 [169]: weights of the gradients around a keypoint, 0 off the disc."""
    i = np.arange(-RADIUS, RADIUS + 1)
    disc = i[:, None] ** 2 + i**2 <= RADIUS**2
    return np.where(disc, gaussian(ACROSS, 2.5), np.float32(0)).ravel()


@lru_cache(maxsize=8)
def descriptor_weights(sigma: float) -> Any:
    """float32 [400]: weights of the gradients of a descriptor, `sigma` in cells."""
    return gaussian(GRID, sigma).ravel()


@kernel
def _gradients(sums: Any, pitch: int, pad: int, height: int, width: int, x: float, y: float, s: float,
               weights: Any, columns: Any, gx: Any, gy: Any) -> int:  # fmt: skip
    """Weighted Haar responses of size 4s on the 13x13 lattice of spacing s around (x, y), into `gx`, `gy` [169].

    Returns how many there are: those on the disc, if they lie fully in the image.
    """
    size = 2 * int(np.rint(2 * s))
    if size > height or size > width:
        return 0
    half = size // 2
    found = 0
    for j in range(ACROSS):
        left = int(np.rint(x + (j - RADIUS) * s - (size - 1) * 0.5))
        columns[j] = left + pad if 0 <= left <= width - size else -1
    for i in range(ACROSS):
        top = int(np.rint(y + (i - RADIUS) * s - (size - 1) * 0.5))
        if top < 0 or top > height - size:
            continue
        a = (top + pad) * pitch
        b = a + half * pitch
        c = a + size * pitch
        for j in range(ACROSS):
            weight = weights[i * ACROSS + j]
            left = columns[j]
            if weight == 0 or left < 0:
                continue
            ap, bp, cp = np.uintp(a + left), np.uintp(b + left), np.uintp(c + left)
            q, r = np.uintp(half), np.uintp(size)
            # differences along columns first: they fit although the sums may have wrapped
            whole_p = np.int32(sums[cp] - sums[ap])
            whole_q = np.int32(sums[cp + q] - sums[ap + q])
            whole_r = np.int32(sums[cp + r] - sums[ap + r])
            upper = np.int32(np.int32(sums[bp + r] - sums[ap + r]) - np.int32(sums[bp] - sums[ap]))
            gx[found] = np.float32(whole_r - 2 * whole_q + whole_p) * weight
            gy[found] = np.float32(whole_r - whole_p - 2 * upper) * weight
            found += 1
    return found


@kernel
def _sector_bins(gx: Any, gy: Any, n: int, bins: Any) -> None:
    """bins[k]: 2 (a // 5), and one more unless a % 5 == 0, for the direction of a gradient in whole degrees a.

    Arctangent: Abramowitz and Stegun 4.4.49, error 1e-5 rad.
    """
    for k in range(n):
        x, y = gx[k], gy[k]
        ax, ay = abs(x), abs(y)
        steep = ay > ax
        t = (ax if steep else ay) / ((ay if steep else ax) + np.float32(1e-20))
        t2 = t * t
        r = np.float32(0.0208351) * t2 - np.float32(0.0851330)
        r = r * t2 + np.float32(0.1801410)
        r = r * t2 - np.float32(0.3302995)
        r = (r * t2 + np.float32(0.9998660)) * t * np.float32(DEGREES)
        r = np.float32(90) - r if steep else r
        r = np.float32(180) - r if x < 0 else r
        r = np.float32(360) - r if y < 0 else r
        angle = np.int32(r + np.float32(0.5))
        angle = np.int32(0) if angle == np.int32(360) else angle
        fives = np.int32((np.float32(angle) + np.float32(0.5)) * np.float32(0.2))
        bins[k] = np.int32(np.int32(2) * fives) + np.int32(angle != np.int32(np.int32(5) * fives))


@kernel
def _dominant_angle(gx: Any, gy: Any, bins: Any, found: int, sums: Any) -> float:
    """Direction, in degrees, of the longest sum of gradients over a sector of 60 degrees, tried every 5 degrees.

    A sector is a run of 23 bins: running sums try all. `sums` float64 [2 * (144 + 23)] is scratch.
    """
    n = 2 * SECTORS
    for k in range(n):
        sums[k] = 0
        sums[n + 23 + k] = 0
    for k in range(found):
        p = np.uintp(bins[k])
        sums[p] += gx[k]
        sums[p + np.uintp(n + 23)] += gy[k]
    for k in range(23):
        sums[n + k] = sums[k]
        sums[n + 23 + n + k] = sums[n + 23 + k]
    x = y = 0.0
    for k in range(1, 24):  # the sector around bin 12
        x += sums[k]
        y += sums[n + 23 + k]
    best = -1.0
    best_x = best_y = 0.0
    for k in range(1, n, 2):
        length = x * x + y * y
        if length > best:
            best, best_x, best_y = length, x, y
        if k + 24 < n + 23:
            x += (sums[k + 23] - sums[k]) + (sums[k + 24] - sums[k + 1])
            y += (sums[n + 46 + k] - sums[n + 23 + k]) + (sums[n + 47 + k] - sums[n + 24 + k])
    return (math.atan2(best_y, best_x) * DEGREES) % 360.0


@kernel
def orient(sums: Any, pitch: int, pad: int, height: int, width: int, candidates: Any, weights: Any,
           start: int, stop: int, angles: Any) -> None:  # fmt: skip
    """angles[start:stop]: dominant direction of the gradient around each candidate, -1 where it cannot be measured.

    `sums` int32 flat: the padded integral image with `pitch` columns.
    """
    columns = np.empty(ACROSS, np.int64)
    gx = np.empty(ACROSS * ACROSS, np.float32)
    gy = np.empty(ACROSS * ACROSS, np.float32)
    bins = np.empty(ACROSS * ACROSS, np.int32)
    scratch = np.empty(2 * (2 * SECTORS + 23), np.float64)
    for k in range(start, stop):
        x, y, s = candidates[k, 0], candidates[k, 1], candidates[k, 2] * 1.2 / 9.0
        found = _gradients(sums, pitch, pad, height, width, x, y, s, weights, columns, gx, gy)
        if found == 0:
            angles[k] = -1
            continue
        _sector_bins(gx, gy, found, bins)
        angles[k] = _dominant_angle(gx, gy, bins, found, scratch)


@kernel
def smooth(sums: Any, pitch: int, pad: int, step: int, half: int, edge: float, margin: int,
           top: int, rows: int, left: int, columns: int, out: Any) -> None:  # fmt: skip
    """Grey means around every `step`-th pixel: a box of 2 half + 1 pixels and a rim of one more with weight `edge`.

    out[k * columns + l] is the mean around the pixel ((top + k) * step - margin, (left + l) * step - margin).
    """
    taps = 2 * half + 1 + 2 * edge
    scale = 1.0 / (taps * taps)
    w00 = np.float32((1 - edge) * (1 - edge) * scale)
    w01 = np.float32((1 - edge) * edge * scale)
    w11 = np.float32(edge * edge * scale)
    n = (columns - 1) * step + 1
    inner = np.empty(n + 2 * half + 3, np.int32)
    wide = np.empty(n + 2 * half + 3, np.int32)
    line = np.empty(n, np.float32)
    begin = pad + left * step - margin - half - 1
    i0, i1, r1 = np.uintp(1), np.uintp(2 * half + 2), np.uintp(2 * half + 3)
    for k in range(rows):
        y = pad + (top + k) * step - margin - half
        a, b = np.uintp(y * pitch + begin), np.uintp((y + 2 * half + 1) * pitch + begin)
        c, d = np.uintp((y - 1) * pitch + begin), np.uintp((y + 2 * half + 2) * pitch + begin)
        for i in range(n + 2 * half + 3):
            x = np.uintp(i)
            inner[x] = np.int32(sums[b + x] - sums[a + x])
            wide[x] = np.int32(sums[d + x] - sums[c + x])
        if step == 1:
            line = out[k * columns : (k + 1) * columns]
        for i in range(n):
            x = np.uintp(i)
            box = np.float32(np.int32(inner[i1 + x] - inner[i0 + x])) * w00
            rim = np.int32(np.int32(inner[r1 + x] - inner[x]) + np.int32(wide[i1 + x] - wide[i0 + x]))
            corner = np.float32(np.int32(wide[r1 + x] - wide[x])) * w11
            line[x] = box + np.float32(rim) * w01 + corner
        if step > 1:
            target = np.uintp(k * columns)
            for i in range(columns):
                out[target + np.uintp(i)] = line[i * step]


@kernel
def _sample(grey: Any, top: int, rows: int, left: int, columns: int, across: int, x: Any, y: Any,
            dx: Any, dy: Any, lattice: Any, at: Any, fx: Any, fy: Any, means: Any) -> None:  # fmt: skip
    """means[i * 21 + j]: the smooth image, bilinear, at cell (i, j) of the turned grid centred at (x, y).

    One cell to the right is (dx, dy), one down is (-dy, dx), in its samples. `grey` holds `across` of its
    `columns` from `left` on, of its `rows` those from `top` on; positions beyond its border are moved there.
    `lattice` [2, 441] has the offsets j and i of the cells. Places first, reads after: so the first loop is vectorised.
    """
    right, bottom, zero = np.float32(columns - 1.01), np.float32(rows - 1.01), np.float32(0)
    pitch, first_row, first_column = np.int32(across), np.int32(top), np.int32(left)
    for k in range(CELLS * CELLS):
        u, v = lattice[0, k], lattice[1, k]
        p = x + (u * dx - v * dy)
        q = y + (u * dy + v * dx)
        p = zero if p < zero else p
        p = right if p > right else p
        q = zero if q < zero else q
        q = bottom if q > bottom else q
        ip, iq = np.int32(p), np.int32(q)
        fx[k], fy[k] = p - np.float32(ip), q - np.float32(iq)
        at[k] = np.int32(np.int32(np.int32(iq - first_row) * pitch) + np.int32(ip - first_column))
    one, low = np.uintp(1), np.uintp(across)
    for k in range(CELLS * CELLS):
        o = np.uintp(at[k])
        a, b = grey[o], grey[o + low]
        top = a + fx[k] * (grey[o + one] - a)
        below = b + fx[k] * (grey[o + low + one] - b)
        means[k] = top + fy[k] * (below - top)


@kernel
def _collect(means: Any, weights: Any, fields: Any, out: Any) -> None:
    """64-d: sums of the weighted dx, dy, |dx|, |dy| in 4x4 fields of 5x5. `fields` float32 [4, 20] is scratch."""
    for row in range(4):
        for j in range(GRID):
            fields[0, j] = fields[1, j] = fields[2, j] = fields[3, j] = 0
        for i in range(row * 5, row * 5 + 5):
            k, q = np.uintp(i * CELLS), np.uintp(i * GRID)
            for j in range(GRID):
                x = np.uintp(j)
                a, b = means[k + x], means[k + x + np.uintp(1)]
                c, d = means[k + x + np.uintp(CELLS)], means[k + x + np.uintp(CELLS + 1)]
                w = weights[q + x]
                dx = ((b - a) + (d - c)) * w
                dy = ((c - a) + (d - b)) * w
                fields[0, j] += dx
                fields[1, j] += dy
                fields[2, j] += abs(dx)
                fields[3, j] += abs(dy)
        for field in range(4):
            for part in range(4):
                total = np.float32(0)
                for j in range(5):
                    total += fields[part, field * 5 + j]
                out[(row * 4 + field) * 4 + part] = total


@kernel
def _collect_extended(means: Any, weights: Any, out: Any) -> None:
    """128-d: the sums of dx and |dx| apart for dy < 0 and dy >= 0, those of dy and |dy| for dx < 0 and dx >= 0."""
    out[:] = 0
    for i in range(GRID):
        for j in range(GRID):
            k = i * CELLS + j
            a, b, c, d = means[k], means[k + 1], means[k + CELLS], means[k + CELLS + 1]
            dx = ((b - a) + (d - c)) * weights[i * GRID + j]
            dy = ((c - a) + (d - b)) * weights[i * GRID + j]
            field = (i // 5 * 4 + j // 5) * 8
            p = field if dy >= 0 else field + 2
            out[p] += dx
            out[p + 1] += abs(dx)
            q = field + 4 if dx >= 0 else field + 6
            out[q] += dy
            out[q + 1] += abs(dy)


@kernel
def _normalise(out: Any) -> None:
    norm = 0.0
    for k in range(len(out)):
        norm += out[k] * out[k]
    scale = np.float32(1.0 / (math.sqrt(norm) + 1e-7))
    for k in range(len(out)):
        out[k] *= scale


@kernel
def describe(grey: Any, step: int, margin: int, top: int, rows: int, left: int, columns: int, across: int,
             candidates: Any, angles: Any, chosen: Any, extended: bool, weights: Any,
             descriptors: Any) -> None:  # fmt: skip
    """Descriptors of the candidates `chosen`, from the part of a smooth image that `smooth` made.

    The part begins at row `top` and column `left` and is `across` wide, the whole would be [rows, columns].
    """
    means = np.empty(CELLS * CELLS, np.float32)
    at = np.empty(CELLS * CELLS, np.int32)
    fx = np.empty(CELLS * CELLS, np.float32)
    fy = np.empty(CELLS * CELLS, np.float32)
    fields = np.empty((4, GRID), np.float32)
    lattice = np.empty((2, CELLS * CELLS), np.float32)
    for k in range(CELLS * CELLS):
        lattice[0, k] = k % CELLS - GRID // 2
        lattice[1, k] = k // CELLS - GRID // 2
    for k in chosen:
        side = math.floor(CELLS * candidates[k, 2] * 1.2 / 9.0) / CELLS / step
        angle = angles[k] / DEGREES
        x = np.float32((candidates[k, 0] + margin) / step)
        y = np.float32((candidates[k, 1] + margin) / step)
        dx, dy = np.float32(math.cos(angle) * side), np.float32(math.sin(angle) * side)
        _sample(grey, top, rows, left, columns, across, x, y, dx, dy, lattice, at, fx, fy, means)
        if extended:
            _collect_extended(means, weights, descriptors[k])
        else:
            _collect(means, weights, fields, descriptors[k])
        _normalise(descriptors[k])


@kernel
def describe_levels(sums: Any, pitch: int, pad: int, parts: Any, edges: Any, bounds: Any, order: Any, grey: Any,
                    candidates: Any, angles: Any, extended: bool, weights: Any, descriptors: Any) -> None:  # fmt: skip
    """Descriptors of the candidates `order[bounds[k] : bounds[k + 1]]` from level k, for all k of the `level_parts`."""
    for k in range(len(parts)):
        step, half, margin = parts[k, STEP], parts[k, HALF], parts[k, MARGIN]
        top, rows, left, across = parts[k, TOP], parts[k, PART_ROWS], parts[k, LEFT], parts[k, PART_COLUMNS]
        smooth(sums, pitch, pad, step, half, edges[k], margin, top, rows, left, across, grey)
        describe(
            grey, step, margin, top, parts[k, ALL_ROWS], left, parts[k, ALL_COLUMNS], across, candidates, angles,
            order[bounds[k] : bounds[k + 1]], extended, weights, descriptors,
        )  # fmt: skip
