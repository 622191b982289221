"""Compiled parts of `png` and `images`: the filters of rows undone, depth in metres."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np

from semdb.compiled import kernel

SUB, UP, AVERAGE, PAETH = 1, 2, 3, 4


@kernel
def unfilter(lines, size, pixels):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes the bytes of pixels uint8 ``[H, stride]`` of `lines` uint8 ``[H, 1 + stride]``, each after its filter.

    `size` is how many bytes a pixel has, 2 or 3. Returns the number of rows before one with an unknown filter.
    """
    rows, stride = pixels.shape
    above = np.zeros(stride, np.uint8)
    for row in range(rows):
        kind, line, out = lines[row, 0], lines[row, 1:], pixels[row]
        if kind == 0:
            out[:] = line
        elif kind == UP:
            for k in range(stride):
                out[k] = np.uint8(line[k] + above[k])
        elif kind == SUB:  # three calls: each is compiled for its filter
            _undo(SUB, line, above, size, out)
        elif kind == AVERAGE:
            _undo(AVERAGE, line, above, size, out)
        elif kind == PAETH:
            _undo(PAETH, line, above, size, out)
        else:
            return row
        above = out
    return rows


@kernel(inline="always")
def _undo(kind, line, above, size, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """One row. The pixel to the left is kept in variables: to read what was just written takes longer."""
    left0 = left1 = left2 = corner0 = corner1 = corner2 = np.int32(0)
    for begin in range(0, len(line), size):
        k = np.uintp(begin)
        up = np.int32(above[k])
        left0 = np.int32((line[k] + _predicted(kind, left0, up, corner0)) & 255)
        out[k], corner0 = left0, up
        up = np.int32(above[k + 1])
        left1 = np.int32((line[k + 1] + _predicted(kind, left1, up, corner1)) & 255)
        out[k + 1], corner1 = left1, up
        if size == 3:
            up = np.int32(above[k + 2])
            left2 = np.int32((line[k + 2] + _predicted(kind, left2, up, corner2)) & 255)
            out[k + 2], corner2 = left2, up


@kernel(inline="always")
def _predicted(kind, left, up, corner):  # type: ignore[no-untyped-def]  # pragma: no cover
    if kind == SUB:
        return left
    if kind == AVERAGE:
        return (left + up) >> 1
    to_left, to_up = up - corner, left - corner
    to_corner = abs(to_left + to_up)
    to_left, to_up = abs(to_left), abs(to_up)
    nearest = up if to_up <= to_corner else corner
    return left if (to_left <= to_up) & (to_left <= to_corner) else nearest


@kernel
def scaled(raw, factor, depth):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes `raw` uint16 ``[H, W]`` times `factor` to `depth` float32, NaN where it is 0 or 65535."""
    for row in range(raw.shape[0]):
        for column in range(raw.shape[1]):
            value = raw[row, column]
            valid = (value != 0) & (value != 65535)
            depth[row, column] = np.float32(value) * factor if valid else np.float32(np.nan)
