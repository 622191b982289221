"""How much an image is smoothed before descriptors are sampled from it, by the size of the keypoint.

A descriptor wants the mean grey of square cells of side s = 1.2/9 of the keypoint's size, turned by its angle. A turned
box and an upright one of the same variance differ little, so keypoints of about the same size share one image
of upright means, from which each cell costs one bilinear read. Larger keypoints read coarser images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from semdb.types import Float32Array

CELL = 1.2 / 9  # side of a descriptor cell per keypoint size
COARSER_FROM = 2.45  # side of a cell, in samples, from which every second sample will do
SPACING = 0.6  # between the sides of neighbouring levels, in samples


@dataclass(frozen=True, slots=True)
class Level:
    """`step` pixels between samples; box of 2 `half` + 1 pixels and a rim of weight `edge`; `margin` pixels outside."""

    step: int
    half: int
    edge: float

    @property
    def margin(self) -> int:
        return self.half + 2

    @property
    def pad(self) -> int:
        """Pixels around the image that the box may touch."""
        return self.margin + self.half + 2 + self.step


def level_keys(sizes: Float32Array) -> npt.NDArray[np.int64]:
    """Key of the level that serves keypoints of `sizes` [n]; depends on nothing but the size."""
    side = np.maximum(sizes.astype(np.float64) * CELL, SPACING)
    band = np.maximum(np.floor(np.log2(side / COARSER_FROM)), 0).astype(np.int64)
    return np.asarray(band * 64 + np.rint(side / SPACING / 2.0**band).astype(np.int64))


@lru_cache(maxsize=256)
def level_of(key: int, smoothing: float) -> Level:
    """The level of a key: its box has `smoothing` times the variance of a cell, less what bilinear reads of samples
    `step` apart add (a sixth of the squared step on average), plus what OpenCV's reads of single pixels add.
    """
    band, rank = divmod(key, 64)
    step = 1 << band
    side = rank * SPACING * step
    variance = max(smoothing * side * side / 12 + (1 - step * step) / 6, 0.02)
    half = int((math.sqrt(1 + 12 * variance) - 1) / 2)
    inner = half * (half + 1) * (2 * half + 1) / 3  # sum of squared offsets
    edge = (variance * (2 * half + 1) - inner) / (2 * ((half + 1) ** 2 - variance))
    return Level(step, half, edge)


# Columns of `level_parts`.
STEP, HALF, MARGIN, TOP, PART_ROWS, LEFT, PART_COLUMNS, ALL_ROWS, ALL_COLUMNS = range(9)


def level_parts(
    keys: npt.NDArray[np.int64], low: Float32Array, high: Float32Array, size: tuple[int, int], smoothing: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Of the level of each of `keys` [n] the part that its keypoints read: numbers [n, 9] as named above, edges [n].

    `low` and `high` [n, 3] are the least and the greatest x, y and size of keypoints; `size` is the image's height and
    width in pixels. A part begins at the sample TOP, LEFT of a level with ALL_ROWS times ALL_COLUMNS samples.
    """
    levels = [level_of(key, smoothing) for key in keys.tolist()]
    parts = np.empty((len(keys), 9), np.int64)
    parts[:, STEP : MARGIN + 1] = [(level.step, level.half, level.margin) for level in levels]
    step, margin = parts[:, STEP], parts[:, MARGIN]
    least, most = low.astype(np.float64), high.astype(np.float64)
    reach = 15 * CELL * most[:, 2] + 2 * step  # of a window turned by 45 degrees
    for axis, pixels, begin in ((1, size[0], TOP), (0, size[1], LEFT)):
        samples = -(-(pixels - 1 + 2 * margin) // step) + 1
        first = ((least[:, axis] + margin - reach) // step).astype(np.int64)
        last = ((most[:, axis] + margin + reach) // step).astype(np.int64) + 2
        first = np.minimum(np.maximum(first, 0), samples - 2)
        parts[:, begin] = first
        parts[:, begin + 1] = np.maximum(np.minimum(last, samples), first + 2) - first
        parts[:, ALL_ROWS if axis else ALL_COLUMNS] = samples
    return parts, np.array([level.edge for level in levels])
