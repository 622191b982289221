"""Compiled kernels of SURF's detector: integral image, box-filter Hessian, maxima over space and scale.

All kernels are `nogil` and pure functions of their arguments: what they give for a pixel does not depend on
which rows or columns they were asked for, so bands on several threads and regions give the same bits.

Source: Bay, Ess, Tuytelaars, Van Gool, Speeded-Up Robust Features (CVIU 2008); the filter geometry (sizes, rounding,
mean-normalised lobes, weight 0.81, sampling phase) is that of OpenCV's implementation, so that results compare.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.perception.features._jit import kernel

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


@kernel
def deinterleave(sums: Any, out: Any) -> None:
    """`out` [rows, step, columns]: every `step`-th column of `sums` [rows, W] side by side, for contiguous reads."""
    rows, step, columns = out.shape
    for y in range(rows):
        source = sums[y]
        for phase in range(step):
            target = out[y, phase]
            for x in range(columns):
                target[x] = source[x * step + phase]


@kernel
def _boxes(sums: Any, top: int, bottom: int, column: int, left: int, right: int, out: Any) -> None:
    """out[x] = sum over rows `top` to `bottom` and columns `left` to `right` right of sample column `column` + x."""
    n = len(out)
    step = sums.shape[1]
    p = column + left // step
    q = column + right // step
    a = sums[top, left % step, p : p + n]
    b = sums[bottom, left % step, p : p + n]
    c = sums[top, right % step, q : q + n]
    d = sums[bottom, right % step, q : q + n]
    for x in range(n):
        out[x] = np.int32(np.int32(d[x] - c[x]) - np.int32(b[x] - a[x]))


@kernel
def _combine(boxes: Any, weight: Any, weight_xy: Any, out: Any) -> None:
    """out[x] = Dxx Dyy - 0.81 Dxy^2, from the whole and middle boxes of Dxx and Dyy and the four of Dxy."""
    n = len(out)
    xx, mid_xx, yy, mid_yy = boxes[0, :n], boxes[1, :n], boxes[2, :n], boxes[3, :n]
    a, b, c, d = boxes[4, :n], boxes[5, :n], boxes[6, :n], boxes[7, :n]
    for x in range(n):
        dxx = np.float32(np.int32(xx[x] - np.int32(3) * mid_xx[x])) * weight
        dyy = np.float32(np.int32(yy[x] - np.int32(3) * mid_yy[x])) * weight
        dxy = np.float32(np.int32(np.int32(a[x] - b[x]) - np.int32(c[x] - d[x]))) * weight_xy
        out[x] = dxx * dyy - DXY_WEIGHT * (dxy * dxy)


@kernel
def _filter_boxes(sums: Any, pad: int, size: int, i: int, start: int, boxes: Any) -> Any:
    """The eight box sums of filter `size` at sample row `i`, sample columns from `start` on, into `boxes` [8, n].

    Returns the weights of the second derivatives (one over the area of a lobe) and of the mixed one.
    """
    step = sums.shape[1]
    margin = (size // 2) // step
    y = step * (i - margin) + pad
    x = start - margin + pad // step
    third = size // 3
    # corners of the lobes: ninths of the size, rounded
    a, e, b = (2 * size + 9) // 18, (4 * size + 9) // 18, (8 * size + 9) // 18
    c, f, d = (10 * size + 9) // 18, (14 * size + 9) // 18, (16 * size + 9) // 18
    _boxes(sums, y + e, y + f, x, 0, size, boxes[0])
    _boxes(sums, y + e, y + f, x, third, 2 * third, boxes[1])
    _boxes(sums, y, y + size, x, e, f, boxes[2])
    _boxes(sums, y + third, y + 2 * third, x, e, f, boxes[3])
    _boxes(sums, y + a, y + b, x, a, b, boxes[4])
    _boxes(sums, y + a, y + b, x, c, d, boxes[5])
    _boxes(sums, y + c, y + d, x, a, b, boxes[6])
    _boxes(sums, y + c, y + d, x, c, d, boxes[7])
    return np.float32(1.0 / (third * (f - e))), np.float32(1.0 / ((b - a) * (b - a)))


@kernel
def _candidate_flags(here: Any, above: Any, below: Any, smaller: Any, larger: Any, threshold: Any, flags: Any) -> None:
    """flags[x] says whether here[x + 1] passes the threshold and its nearest six neighbours (arrays of n + 2)."""
    n = len(here) - 2
    left, middle, right = here[:n], here[1 : n + 1], here[2 : n + 2]
    up, down, inner, outer = above[1 : n + 1], below[1 : n + 1], smaller[1 : n + 1], larger[1 : n + 1]
    for x in range(n):
        v = middle[x]
        best = max(left[x], right[x], up[x], down[x], inner[x], outer[x], threshold)
        flags[x] = v > best


@kernel
def _is_maximum(ring: Any, layer: int, up: int, mid: int, down: int, j: int) -> bool:
    v = ring[layer, mid, j]
    for k in range(layer - 1, layer + 2):
        for row in (up, mid, down):
            for x in range(j - 1, j + 2):
                if ring[k, row, x] >= v and not (k == layer and row == mid and x == j):
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
    rows, columns = height // step, width // step
    ring = np.empty((layers + 2, 3, columns + 2), np.float32)  # determinants of three rows
    boxes = np.empty((8, columns), np.int32)
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
                stop = min(spans[k, 1] + 1, margin + 1 + (width - size) // step)
                if start < stop:
                    weight, weight_xy = _filter_boxes(sums, pad, size, i, start, boxes[:, : stop - start])
                    _combine(boxes, weight, weight_xy, ring[layer, i % 3, start:stop])
        if i <= first:
            continue
        up, mid, down = (i - 2) % 3, (i - 1) % 3, i % 3
        for layer in range(1, layers + 1):
            margin = (((9 + 6 * (layer + 1)) << octave) // 2) // step + 1
            if i - 1 < margin or i - 1 >= rows - margin:
                continue
            size = (9 + 6 * layer) << octave
            for k in range(len(spans)):
                start = max(spans[k, 0], margin)
                n = min(spans[k, 1], columns - margin) - start
                if n <= 0:
                    continue
                window = slice(start - 1, start + n + 1)
                here = ring[layer]
                _candidate_flags(
                    here[mid, window],
                    here[up, window],
                    here[down, window],
                    ring[layer - 1, mid, window],
                    ring[layer + 1, mid, window],
                    threshold,
                    flags,
                )
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
                            half = (size // 2) // step
                            centre = (size - 1) * 0.5
                            _filter_boxes(sums, pad, size, i - 1, j, boxes[:, :1])
                            trace = boxes[0, 0] - 3 * boxes[1, 0] + boxes[2, 0] - 3 * boxes[3, 0]
                            out[count, 0] = step * (j - half) + centre + dx * step
                            out[count, 1] = step * (i - 1 - half) + centre + dy * step
                            out[count, 2] = np.rint(size + ds * (6 << octave))
                            out[count, 3] = ring[layer, mid, j]
                            out[count, 4] = octave
                            out[count, 5] = (trace > 0) - (trace < 0)
                        count += 1
    return count
