"""Masks for detectors that give boxes only: the box itself, or the depth in it that its object most likely has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from semdb.types import BoolArray, Detection, Float32Array

GAP_M = 0.1  # between neighbouring depths: what is further apart is another thing
GAP_SHARE = 0.02  # of the depth, where that is more: depth gets coarser with distance
MOST_DEPTHS = 4096  # of a box that clusters are found from
MIN_SHARE = 0.05  # of the pixels of a box that must have depth


def box_mask(box: npt.ArrayLike, shape: tuple[int, int]) -> BoolArray:
    """All of `box` ``[4]`` (x1, y1, x2, y2; the last pixel is inside) in an image of `shape` ``(H, W)``."""
    mask = np.zeros(shape, dtype=np.bool_)
    x1, y1, x2, y2 = _pixels(box, shape)
    mask[y1 : y2 + 1, x1 : x2 + 1] = True
    return mask


def depth_cluster_mask(box: npt.ArrayLike, depth: Float32Array) -> BoolArray:
    """The pixels ``[H, W]`` of `box` whose `depth` ``[H, W]`` (m, NaN where missing) is that of its object.

    Depths in the box are sorted and cut where neighbours are further apart than 0.1 m or 2 % of the depth. Of the
    clusters the one is taken that has most, pixels counting less towards the sides of the box (a Gaussian of a
    quarter of its sides): an object is in the middle of its box, what is before and behind it at its corners. The
    whole box where fewer than 5 % of its pixels have depth.
    """
    shape = depth.shape[0], depth.shape[1]
    x1, y1, x2, y2 = _pixels(box, shape)
    inside = depth[y1 : y2 + 1, x1 : x2 + 1]
    known = np.isfinite(inside) & (inside > 0)
    if known.sum() < max(1.0, MIN_SHARE * inside.size):
        return box_mask(box, shape)
    near, far = _cluster(inside[known], _weights(inside.shape)[known])
    mask = np.zeros(shape, dtype=np.bool_)
    with np.errstate(invalid="ignore"):
        mask[y1 : y2 + 1, x1 : x2 + 1] = known & (inside >= near) & (inside <= far)
    return mask


def filled(
    detections: Sequence[Detection], depth: Float32Array | None, shape: tuple[int, int]
) -> tuple[Detection, ...]:
    """`detections` with masks made of their boxes, by depth where there is one; weak ones stay without a mask."""

    def mask(box: Float32Array) -> BoolArray:
        return box_mask(box, shape) if depth is None else depth_cluster_mask(box, depth)

    return tuple(found if found.weak else replace(found, mask=mask(found.box)) for found in detections)


def _cluster(depths: Float32Array, weights: npt.NDArray[np.float64]) -> tuple[float, float]:
    """The least and the largest of the heaviest cluster of `depths` ``[n]``."""
    order = np.argsort(depths, kind="stable")
    order = order[:: max(1, len(order) // MOST_DEPTHS)]
    values, heavy = depths[order].astype(np.float64), weights[order]
    cuts = np.flatnonzero(np.diff(values) > np.maximum(GAP_M, GAP_SHARE * values[:-1])) + 1
    starts = np.concatenate([[0], cuts])
    best = int(np.argmax(np.add.reduceat(heavy, starts)))
    last = (cuts[best] if best < len(cuts) else len(values)) - 1
    return float(values[starts[best]]) - 1e-6, float(values[last]) + GAP_M / 2


def _weights(shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    rows, columns = (np.exp(-0.5 * ((np.arange(n) - (n - 1) / 2) / max(1.0, n / 4)) ** 2) for n in shape)
    return np.outer(rows, columns)


def _pixels(box: npt.ArrayLike, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    height, width = shape
    x1, y1, x2, y2 = (int(v) for v in np.rint(np.asarray(box, dtype=np.float64)))
    x1, y1 = min(max(x1, 0), width - 1), min(max(y1, 0), height - 1)
    return x1, y1, min(max(x2, x1), width - 1), min(max(y2, y1), height - 1)
