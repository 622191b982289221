"""Compiled part of `objects` and `detections`: where a mask is."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.types import BoolArray

Window = tuple[int, int, int, int]  # left column, top row, width, height


def bounding_box(mask: BoolArray) -> Window:
    """Left column, top row, width and height of what is set in `mask` ``[H, W]``; zeros where nothing is.

    What OpenCV's ``boundingRect`` gives, in a fifth of its time.
    """
    height, width = mask.shape
    box: Window = _bounds(np.ascontiguousarray(mask).reshape(-1).view(np.uint8), height, width)
    return box


@kernel
def _bounds(mask, height, width):  # type: ignore[no-untyped-def]  # pragma: no cover
    top, bottom = height, -1
    across = np.zeros(width, np.uint8)  # whether a column has anything
    for row in range(height):
        begin = np.uintp(row * width)
        found = np.uint8(0)
        for column in range(width):  # without a way out, offsets unsigned: many pixels at a time
            found = np.uint8(found | mask[begin + np.uintp(column)])
        if found:
            top, bottom = min(top, row), row
            for column in range(width):
                across[column] = np.uint8(across[column] | mask[begin + np.uintp(column)])
    columns = np.flatnonzero(across)
    if bottom < 0:
        return 0, 0, 0, 0
    return columns[0], top, columns[-1] - columns[0] + 1, bottom - top + 1
