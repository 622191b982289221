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
    values = np.empty((2 * half + 1) ** 2, np.float64)
    across, down = np.empty_like(values), np.empty_like(values)
    for k in range(len(xy)):
        if not np.isnan(out[k]) or not (np.isfinite(xy[k, 0]) and np.isfinite(xy[k, 1])):
            continue
        px, py = np.float64(xy[k, 0]), np.float64(xy[k, 1])
        u0, v0 = int(np.rint(px)), int(np.rint(py))
        n = 0
        sx = sy = sxx = sxy = syy = t = tx = ty = 0.0
        for v in range(max(v0 - half, 0), min(v0 + half + 1, height)):
            for u in range(max(u0 - half, 0), min(u0 + half + 1, width)):
                z = depth[v, u]
                if not (z > 0 and z < limit):
                    continue
                w, dx, dy = np.float64(np.float32(1) / z), u - px, v - py
                values[n], across[n], down[n] = w, dx, dy
                n += 1
                sx, sy, t = sx + dx, sy + dy, t + w
                sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
                tx, ty = tx + dx * w, ty + dy * w
        if n < needed:
            continue
        # Known pixels in two lines leave a slope nearly open: a little weight on zero slope keeps it finite.
        s = n + 1e-9
        sxx, syy = sxx + 1e-9 - sx * sx / s, syy + 1e-9 - sy * sy / s
        sxy, tx, ty = sxy - sx * sy / s, tx - sx * t / s, ty - sy * t / s
        c = (ty - sxy / sxx * tx) / (syy - sxy / sxx * sxy)
        b = (tx - sxy * c) / sxx
        a = (t - sx * b - sy * c) / s
        worst = 0.0
        for i in range(n):
            worst = max(worst, abs(values[i] - (a + b * across[i] + c * down[i])))
        if a > 0 and worst <= residual_limit + residual_share * a and np.hypot(b * fx, c * fy) <= slope_limit * a:
            out[k] = a


@kernel
def smooth_surface(mask, depth, top, left, step, smooth):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Marks known pixels of `mask` whose right and lower neighbours are not nearer or farther by the factor `step`.

    Writes 0 or 1 to `smooth` uint8 ``[h, w]``. Returns how many pixels are known.
    """
    rows, columns = mask.shape
    right, below = left + columns, top + rows
    known = 0
    for row in range(rows):
        here = depth[top + row, left:right]
        under = depth[min(top + row + 1, below - 1), left:right]
        line, next_line, out = mask[row], mask[min(row + 1, rows - 1)], smooth[row]
        found = 0
        for column in range(columns - 1):  # without branches: several pixels at a time
            inside = line[column] & _known(here[column])
            across = line[column + 1] & _known(here[column + 1]) & _jump(here[column], here[column + 1], step)
            down = next_line[column] & _known(under[column]) & _jump(here[column], under[column], step)
            found += inside
            out[column] = inside & ~across & ~down
        last = columns - 1
        inside = line[last] & _known(here[last])
        down = next_line[last] & _known(under[last]) & _jump(here[last], under[last], step)
        out[last] = inside & ~down
        known += found + inside
    return known


@kernel(inline="always")
def _known(z):  # type: ignore[no-untyped-def]  # pragma: no cover
    return (z > 0) & (z < np.float32(np.inf))


@kernel(inline="always")
def _jump(z, other, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    return (other > z * step) | (z > other * step)


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
