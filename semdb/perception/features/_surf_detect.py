"""Compiled kernels of SURF's detector: integral image, box-filter Hessian, maxima over space and scale.

All kernels are `nogil` and pure functions of their arguments: what they give for a pixel does not depend on
which rows or columns they were asked for, so bands on several threads and regions give the same bits.

Source: Bay, Ess, Tuytelaars, Van Gool, Speeded-Up Robust Features (CVIU 2008); the filter geometry (sizes, rounding,
mean-normalised lobes, weight 0.81, sampling phase) is that of OpenCV's implementation, so that results compare.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.compiled import kernel

COLUMNS = 6  # of a candidate: x, y, size, response, octave, sign of the Laplacian
DXY_WEIGHT = np.float32(0.81)  # 0.9 squared: balances the box filters against Gaussian derivatives


@kernel
def integral(image: Any, out: Any) -> None:
    """`out` int32 [H+1, W+1]: sums of `image` uint8 [H, W] above and left. Wraps for huge images, harmlessly:
    only differences over boxes are used, and those fit.
    """
    height, width = image.shape
    for x in range(width + 1):
        out[0, x] = 0
    for y in range(height):
        row = np.int32(0)
        source = image[y]
        above = out[y]
        below = out[y + 1]
        below[0] = 0
        for x in range(width):
            row = np.int32(row + source[x])
            below[x + 1] = np.int32(above[x + 1] + row)


def offsets_read(octave: int, layers: int) -> npt.NDArray[np.bool_]:
    """Which remainders, of the division by the octave's step, the corners of its boxes have (`_filter_boxes`)."""
    read = np.zeros(1 << octave, np.bool_)
    for layer in range(layers + 2):
        size = (9 + 6 * layer) << octave
        corners = [0, size // 3, 2 * (size // 3), size, *((k * size + 9) // 18 for k in (2, 4, 8, 10, 14, 16))]
        read[np.array(corners) % len(read)] = True
    return read


@kernel
def deinterleave(sums: Any, first: int, last: int, read: Any, out: Any) -> None:
    """`out` [rows, step, columns]: every `step`-th column of `sums` [rows, W] side by side, for contiguous reads;
    rows `first` to `last` only, and of rows and columns those that are `read` [step], by their remainder.
    """
    _, step, columns = out.shape
    for y in range(first, last):
        if not read[y % step]:
            continue
        source = sums[y]
        for phase in range(step):
            if not read[phase]:
                continue
            target = out[y, phase]
            for x in range(columns):
                target[x] = source[x * step + phase]


@kernel
def _box_row(flat: Any, a: int, b: int, c: int, d: int, out: Any, at: int, n: int) -> None:
    """out[at + x] = (flat[d + x] - flat[c + x]) - (flat[b + x] - flat[a + x]): box sums from their four corners.

    Flat arrays and unsigned offsets: slices would count references, signed indices would be tested for their sign.
    """
    ua, ub, uc, ud, target = np.uintp(a), np.uintp(b), np.uintp(c), np.uintp(d), np.uintp(at)
    for i in range(n):
        x = np.uintp(i)
        right = np.int32(flat[ud + x] - flat[uc + x])
        left = np.int32(flat[ub + x] - flat[ua + x])
        out[target + x] = np.int32(right - left)


@kernel
def _combine(boxes: Any, n: int, weight: Any, weight_xy: Any, out: Any, at: int) -> None:
    """out[at + x] = Dxx Dyy - 0.81 Dxy^2, from the whole and middle boxes of Dxx and Dyy and the four of Dxy."""
    target = np.uintp(at)
    pitch = len(boxes) // 8
    o1, o2, o3, o4 = np.uintp(pitch), np.uintp(2 * pitch), np.uintp(3 * pitch), np.uintp(4 * pitch)
    o5, o6, o7 = np.uintp(5 * pitch), np.uintp(6 * pitch), np.uintp(7 * pitch)
    for i in range(n):
        x = np.uintp(i)
        dxx = np.float32(np.int32(boxes[x] - np.int32(3) * boxes[o1 + x])) * weight
        dyy = np.float32(np.int32(boxes[o2 + x] - np.int32(3) * boxes[o3 + x])) * weight
        first = np.int32(boxes[o4 + x] - boxes[o5 + x])
        second = np.int32(boxes[o6 + x] - boxes[o7 + x])
        dxy = np.float32(np.int32(first - second)) * weight_xy
        out[target + x] = dxx * dyy - DXY_WEIGHT * (dxy * dxy)


@kernel
def _filter_boxes(
    flat: Any, step: int, columns: int, pad: int, size: int, i: int, start: int, n: int, boxes: Any
) -> Any:
    """The eight box sums of filter `size` at sample row `i`, `n` sample columns from `start` on, into `boxes` [8 * m].

    `flat` is the de-interleaved integral image [rows, step, columns]. Returns the weights of the second derivatives
    (one over the area of a lobe) and of the mixed one.
    """
    pitch = len(boxes) // 8
    margin = (size // 2) // step
    third = size // 3
    # corners of the lobes: ninths of the size, rounded
    a, e, b = (2 * size + 9) // 18, (4 * size + 9) // 18, (8 * size + 9) // 18
    c, f, d = (10 * size + 9) // 18, (14 * size + 9) // 18, (16 * size + 9) // 18
    row = step * columns
    origin = (step * (i - margin) + pad) * row + start - margin + pad // step
    corners = (
        (e, f, 0, size),
        (e, f, third, 2 * third),
        (0, size, e, f),
        (third, 2 * third, e, f),
        (a, b, a, b),
        (a, b, c, d),
        (c, d, a, b),
        (c, d, c, d),
    )
    for k, (top, bottom, left, right) in enumerate(corners):
        p = origin + left % step * columns + left // step
        q = origin + right % step * columns + right // step
        _box_row(flat, p + top * row, p + bottom * row, q + top * row, q + bottom * row, boxes, k * pitch, n)
    return np.float32(1.0 / (third * (f - e))), np.float32(1.0 / ((b - a) * (b - a)))


@kernel
def _dense_row(
    flat: Any, columns: int, pad: int, size: int, i: int, start: int, n: int, strips: Any, out: Any, at: int
) -> None:
    """What `_filter_boxes` and `_combine` give, for the octave that samples every pixel, in half the time.

    There boxes share columns: strips of rows first (`strips` int32 [3 * m]), then differences of their columns.
    """
    third = size // 3
    a, e, b = (2 * size + 9) // 18, (4 * size + 9) // 18, (8 * size + 9) // 18
    c, f, d = (10 * size + 9) // 18, (14 * size + 9) // 18, (16 * size + 9) // 18
    weight = np.float32(1.0 / (third * (f - e)))
    weight_xy = np.float32(1.0 / ((b - a) * (b - a)))
    pitch = len(strips) // 3
    origin = (i - size // 2 + pad) * columns + start - size // 2 + pad
    zero, one, two = np.uintp(origin), np.uintp(origin + third * columns), np.uintp(origin + 2 * third * columns)
    three, re, rf = np.uintp(origin + size * columns), np.uintp(origin + e * columns), np.uintp(origin + f * columns)
    ra, rb = np.uintp(origin + a * columns), np.uintp(origin + b * columns)
    rc, rd = np.uintp(origin + c * columns), np.uintp(origin + d * columns)
    yy, xy = np.uintp(pitch), np.uintp(2 * pitch)
    for k in range(n + size):
        x = np.uintp(k)
        strips[x] = np.int32(flat[rf + x] - flat[re + x])
        middle = np.int32(flat[two + x] - flat[one + x])
        strips[yy + x] = np.int32(np.int32(flat[three + x] - flat[zero + x]) - np.int32(np.int32(3) * middle))
    for k in range(n + size):
        x = np.uintp(k)
        strips[xy + x] = np.int32(np.int32(flat[rb + x] - flat[ra + x]) - np.int32(flat[rd + x] - flat[rc + x]))
    target = np.uintp(at)
    x1, x2, x3 = np.uintp(third), np.uintp(2 * third), np.uintp(size)
    ye, yf = np.uintp(pitch + e), np.uintp(pitch + f)
    for k in range(n):
        x = np.uintp(k)
        middle = np.int32(strips[x2 + x] - strips[x1 + x])
        dxx = np.float32(np.int32(np.int32(strips[x3 + x] - strips[x]) - np.int32(np.int32(3) * middle))) * weight
        dyy = np.float32(np.int32(strips[yf + x] - strips[ye + x])) * weight
        out[target + x] = dxx * dyy
    xa, xb, xc, xd = np.uintp(2 * pitch + a), np.uintp(2 * pitch + b), np.uintp(2 * pitch + c), np.uintp(2 * pitch + d)
    for k in range(n):
        x = np.uintp(k)
        boxes = np.int32(np.int32(strips[xb + x] - strips[xa + x]) - np.int32(strips[xd + x] - strips[xc + x]))
        dxy = np.float32(boxes) * weight_xy
        out[target + x] -= DXY_WEIGHT * (dxy * dxy)


@kernel
def _candidate_flags(
    ring: Any, here: int, above: int, below: int, smaller: int, larger: int, n: int, threshold: Any, flags: Any
) -> None:
    """flags[x] says whether ring[here + x] passes the threshold and its nearest six neighbours (offsets of rows).

    It must be above those before it (smaller, up, left) and not below those after it: of two equal samples, as around
    a symmetric pattern that lies between two pixels, the first is kept; their parabola is the same.
    """
    o, u, d, s, e = np.uintp(here), np.uintp(above), np.uintp(below), np.uintp(smaller), np.uintp(larger)
    left, right = np.uintp(here - 1), np.uintp(here + 1)
    for i in range(n):
        x = np.uintp(i)
        v = ring[o + x]
        flags[x] = (
            (v > threshold) & (v > ring[left + x]) & (v >= ring[right + x]) & (v > ring[u + x])
            & (v >= ring[d + x]) & (v > ring[s + x]) & (v >= ring[e + x])
        )  # fmt: skip


@kernel
def _is_maximum(ring: Any, layer: int, up: int, mid: int, down: int, j: int) -> bool:
    """Whether a sample is above all neighbours before it and not below all after it, in order of layer, row, column."""
    v = ring[layer, mid, j]
    before = True
    for k in range(layer - 1, layer + 2):
        for row in (up, mid, down):
            for x in range(j - 1, j + 2):
                if k == layer and row == mid and x == j:
                    before = False
                elif ring[k, row, x] > v or (before and ring[k, row, x] == v):
                    return False
    return True


@kernel
def _interpolate(ring: Any, layer: int, up: int, mid: int, down: int, j: int) -> Any:
    """Offset (x, y, scale) in samples of the vertex of the parabola through the 3x3x3 neighbourhood, and whether
    it lies within one sample.
    """
    lo, me, hi = ring[layer - 1], ring[layer], ring[layer + 1]
    v = np.float64(me[mid, j])
    gx = (np.float64(me[mid, j + 1]) - me[mid, j - 1]) / 2
    gy = (np.float64(me[down, j]) - me[up, j]) / 2
    gs = (np.float64(hi[mid, j]) - lo[mid, j]) / 2
    xx = me[mid, j - 1] - 2 * v + me[mid, j + 1]
    yy = me[up, j] - 2 * v + me[down, j]
    ss = lo[mid, j] - 2 * v + hi[mid, j]
    xy = (np.float64(me[down, j + 1]) - me[down, j - 1] - me[up, j + 1] + me[up, j - 1]) / 4
    xs = (np.float64(hi[mid, j + 1]) - hi[mid, j - 1] - lo[mid, j + 1] + lo[mid, j - 1]) / 4
    ys = (np.float64(hi[down, j]) - hi[up, j] - lo[down, j] + lo[up, j]) / 4
    ca, cb, cc = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
    det = xx * ca + xy * cb + xs * cc
    if det == 0.0:
        return 0.0, 0.0, 0.0, False
    x = -(gx * ca + gy * cb + gs * cc) / det
    y = -(gx * cb + gy * (xx * ss - xs * xs) + gs * (xy * xs - xx * ys)) / det
    s = -(gx * cc + gy * (xy * xs - xx * ys) + gs * (xx * yy - xy * xy)) / det
    within = abs(x) <= 1 and abs(y) <= 1 and abs(s) <= 1 and (x != 0 or y != 0 or s != 0)
    return x, y, s, within


@kernel
def find_maxima(
    sums: Any,
    pad: int,
    height: int,
    width: int,
    octave: int,
    layers: int,
    threshold: Any,
    first: int,
    last: int,
    spans: Any,
    out: Any,
) -> int:
    """Maxima of the Hessian in one octave, sample rows `first` to `last` (not included), into `out` [capacity, 6].

    `sums` int32 [rows, step, columns]: de-interleaved integral image; `spans` int64 [k, 2] the sample columns to look
    at, ascending and disjoint. Returns the number of maxima, which may be more than `out` holds: call again
    with more room then.
    """
    step = sums.shape[1]
    flat = sums.reshape(sums.size)
    rows, columns = height // step, width // step
    pitch = columns + 2
    ring = np.empty((layers + 2, 3, pitch), np.float32)  # determinants of three rows
    ring_flat = ring.reshape(ring.size)
    boxes = np.empty(8 * columns, np.int32)
    strips = np.empty(3 * (columns + (9 + 6 * (layers + 1))), np.int32)
    flags = np.zeros(columns + 16, np.uint8)
    words = flags[: (columns + 15) // 8 * 8].view(np.uint64)
    count = 0
    for i in range(first - 1, last + 1):
        for layer in range(layers + 2):
            size = (9 + 6 * layer) << octave
            margin = (size // 2) // step
            if size > height or size > width or i < margin or i >= margin + 1 + (height - size) // step:
                continue
            for k in range(len(spans)):
                start = max(spans[k, 0] - 1, margin)
                n = min(spans[k, 1] + 1, margin + 1 + (width - size) // step) - start
                target = (layer * 3 + i % 3) * pitch + start
                if n > 0 and step == 1:
                    _dense_row(flat, sums.shape[2], pad, size, i, start, n, strips, ring_flat, target)
                elif n > 0:
                    weight, weight_xy = _filter_boxes(flat, step, sums.shape[2], pad, size, i, start, n, boxes)
                    _combine(boxes, n, weight, weight_xy, ring_flat, target)
        if i <= first:
            continue
        up, mid, down = (i - 2) % 3, (i - 1) % 3, i % 3
        for layer in range(1, layers + 1):
            margin = (((9 + 6 * (layer + 1)) << octave) // 2) // step + 1
            if i - 1 < margin or i - 1 >= rows - margin:
                continue
            for k in range(len(spans)):
                start = max(spans[k, 0], margin)
                n = min(spans[k, 1], columns - margin) - start
                if n <= 0:
                    continue
                row = layer * 3 * pitch + start
                here = row + mid * pitch
                _candidate_flags(
                    ring_flat, here, row + up * pitch, row + down * pitch, here - 3 * pitch, here + 3 * pitch,
                    n, threshold, flags,
                )  # fmt: skip
                flags[n : n + 8] = 0
                for w in range((n + 7) // 8):
                    if words[w] == 0:
                        continue
                    for x in range(8 * w, 8 * w + 8):
                        j = start + x
                        if flags[x] == 0 or not _is_maximum(ring, layer, up, mid, down, j):
                            continue
                        dx, dy, ds, within = _interpolate(ring, layer, up, mid, down, j)
                        if not within:
                            continue
                        if count < len(out):
                            size = (9 + 6 * layer) << octave
                            half = (size // 2) // step
                            centre = (size - 1) * 0.5
                            _filter_boxes(flat, step, sums.shape[2], pad, size, i - 1, j, 1, boxes)
                            trace = boxes[0] - 3 * boxes[columns] + boxes[2 * columns] - 3 * boxes[3 * columns]
                            out[count, 0] = step * (j - half) + centre + dx * step
                            out[count, 1] = step * (i - 1 - half) + centre + dy * step
                            out[count, 2] = np.rint(size + ds * (6 << octave))
                            out[count, 3] = ring[layer, mid, j]
                            out[count, 4] = octave
                            out[count, 5] = (trace > 0) - (trace < 0)
                        count += 1
    return count
