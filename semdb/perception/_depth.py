"""Compiled parts of `lifting` and `objects`: what is asked of a depth image pixel by pixel.

`depth` is float32 ``[H, W]`` metres; a value is known where it is finite and positive. `mask` is bool ``[h, w]``, the
part of an image-sized mask that begins at row `top`, column `left`.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np

from semdb.compiled import kernel


@kernel
def fit_inverse_depth(  # type: ignore[no-untyped-def]  # pragma: no cover
    depth, xy, fx, fy, half, needed, residual_limit, residual_share, slope_limit, out
):
    """Writes the inverse depth at each position `xy` ``[n, 2]`` whose `out` ``[n]`` is NaN; see `lifting.lift`.

    Least squares of ``a + b dx + c dy`` over the known pixels of the window, by its normal equations.
    """
    height, width = depth.shape
    limit = np.float32(np.inf)
    flat = depth.reshape(height * width)
    values = np.empty((2 * half + 1) ** 2, np.float64)
    across, down = np.empty_like(values), np.empty_like(values)
    for k in range(len(xy)):
        if not np.isnan(out[k]) or not (np.isfinite(xy[k, 0]) and np.isfinite(xy[k, 1])):
            continue
        px, py = np.float64(xy[k, 0]), np.float64(xy[k, 1])
        u0, v0 = int(np.rint(px)), int(np.rint(py))
        left, right = max(u0 - half, 0), min(u0 + half + 1, width)
        n = np.uintp(0)
        sx = sy = sxx = sxy = syy = t = tx = ty = 0.0
        for v in range(max(v0 - half, 0), min(v0 + half + 1, height)):
            dy = v - py
            for u in range(left, right):
                z = flat[np.uintp(v * width + u)]
                if not (z > 0 and z < limit):
                    continue
                w, dx = np.float64(np.float32(1) / z), u - px
                values[n], across[n], down[n] = w, dx, dy
                n = np.uintp(n + np.uintp(1))
                sx, sy, t = sx + dx, sy + dy, t + w
                sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
                tx, ty = tx + dx * w, ty + dy * w
        if n < needed:
            continue
        # Known pixels in two lines leave a slope nearly open: a little weight on zero slope keeps it finite.
        s = np.float64(n) + 1e-9
        sxx, syy = sxx + 1e-9 - sx * sx / s, syy + 1e-9 - sy * sy / s
        sxy, tx, ty = sxy - sx * sy / s, tx - sx * t / s, ty - sy * t / s
        c = (ty - sxy / sxx * tx) / (syy - sxy / sxx * sxy)
        b = (tx - sxy * c) / sxx
        a = (t - sx * b - sy * c) / s
        if not a > 0:
            continue
        bound, beyond = residual_limit + residual_share * a, 0
        for j in range(n):
            i = np.uintp(j)
            beyond += not abs(values[i] - (a + b * across[i] + c * down[i])) <= bound
        if beyond == 0 and np.hypot(b * fx, c * fy) <= slope_limit * a:
            out[k] = a


@kernel
def smooth_surface(mask, depth, top, left, step, smooth):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Marks known pixels of `mask` whose right and lower neighbours are not nearer or farther by the factor `step`.

    Writes 0 or 1 to `smooth` uint8 ``[h, w]``. Returns how many pixels are known.
    """
    rows, columns = mask.shape
    here, under = np.zeros(columns + 1, np.float32), np.zeros(columns + 1, np.float32)  # 0: not known
    known = 0
    for row in range(rows + 1):
        here, under = under, here
        if row < rows:
            line, values = mask[row], depth[top + row, left : left + columns]
            for k in range(columns):
                x = np.uintp(k)
                under[x] = values[x] if line[x] & _known(values[x]) else np.float32(0)
        else:
            under[:] = 0
        if row == 0:
            continue
        out, found = smooth[row - 1], np.int32(0)
        for k in range(columns):  # without branches: several pixels at a time
            x = np.uintp(k)
            z, right, below = here[x], here[x + np.uintp(1)], under[x]
            nearest = min(right if right > 0 else z, below if below > 0 else z)
            out[x] = np.uint8((z > 0) & (max(right, below) <= z * step) & (z <= nearest * step))
            found = np.int32(found + np.int32(z > 0))
        known += int(found)
    return known


@kernel(inline="always")
def _known(z):  # type: ignore[no-untyped-def]  # pragma: no cover
    return (z > 0) & (z < np.float32(np.inf))


@kernel
def count_labels(labels, counts):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Adds to `counts` ``[n]`` how many pixels of `labels` int32 ``[h, w]`` have each of 0 to n - 1."""
    rows, columns = labels.shape
    for row in range(rows):
        begin, label = 0, labels[row, 0]
        for column in range(1, columns):  # runs: a count that each pixel raises waits for itself
            if labels[row, column] != label:
                counts[label] += column - begin
                begin, label = column, labels[row, column]
        counts[label] += columns - begin


@kernel
def of_label(labels, depth, top, left, label, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes the depths of the pixels of `labels` int32 ``[h, w]`` that are `label` to `out`, which has the room."""
    count = 0
    for row in range(labels.shape[0]):
        for column in range(labels.shape[1]):
            if labels[row, column] == label:
                out[count] = depth[top + row, left + column]
                count += 1


@kernel
def within(mask, depth, top, left, nearest, farthest, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes `mask` without its known pixels before `nearest` or behind `farthest` to `out` bool ``[h, w]``."""
    rows, columns = mask.shape
    for row in range(rows):
        here, line, target = depth[top + row, left : left + columns], mask[row], out[row]
        for column in range(columns):  # without branches: several pixels at a time
            z = here[column]
            target[column] = line[column] & ~(_known(z) & ((z < nearest) | (z > farthest)))


@kernel
def mark_known(mask, depth, top, left, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes the known pixels of `mask` to `out` bool ``[h, w]``."""
    rows, columns = mask.shape
    for row in range(rows):
        here, line, target = depth[top + row, left : left + columns], mask[row], out[row]
        for column in range(columns):
            target[column] = line[column] & _known(here[column])
