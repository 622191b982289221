"""Whether depth lies where colour does: edges of depth against edges of colour, moved and stretched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semdb.types import Float32Array, FloatArray, ImageArray

SIZE = (320, 240)  # of the images that are compared; all shifts are in pixels of an image twice as wide
CAP = 8.0  # pixels: an edge that is farther from any other counts as so far
MOST_POINTS = 1500
STEP = 0.06  # of the depth: between neighbours, an edge


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFrame:
    """Edges of one frame: points ``[n, 2]`` of depth's about the centre, and how far each pixel is from colour's."""

    points: FloatArray
    distance: Float32Array  # [240, 320], at most CAP


def edge_frame(image: ImageArray, depth: Float32Array) -> EdgeFrame:
    """Of an image ``[H, W, 3]`` and the depth ``[H, W]`` metres that belongs to it."""
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), SIZE, interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (3, 3), 0)
    level = float(np.median(grey))
    edges = cv2.Canny(grey, 0.4 * level, 0.9 * level)
    distance = np.minimum(cv2.distanceTransform(np.where(edges > 0, 0, 255).astype(np.uint8), cv2.DIST_L2, 3), CAP)
    return EdgeFrame(depth_edges(depth), np.asarray(distance, np.float32))


def depth_edges(depth: Float32Array) -> FloatArray:
    """Pixels ``[n, 2]`` (of `SIZE`, about its centre) of depth steps between known neighbours of ``[H, W]`` metres."""
    depth = np.asarray(cv2.resize(depth, SIZE, interpolation=cv2.INTER_NEAREST), np.float32)
    mask = np.zeros(depth.shape, bool)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            a, b = (depth[:-2], depth[2:]) if axis == 0 else (depth[:, :-2], depth[:, 2:])
            step = np.abs(a - b) > STEP * np.minimum(a, b)
            inner = mask[1:-1] if axis == 0 else mask[:, 1:-1]
            inner |= step
    rows, columns = np.nonzero(mask)
    points = np.column_stack([columns, rows]).astype(np.float64) - ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    if len(points) > MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, MOST_POINTS).astype(int)]
    return points


def misfit(frames: Sequence[EdgeFrame], zoom: float, shifts: FloatArray) -> float:
    """Mean distance in pixels (of 320) of depth edges from colour's, moved by `shifts` ``[frames, 2]`` after `zoom`."""
    sums, count = 0.0, 0
    for frame, shift in zip(frames, shifts, strict=True):
        where = np.rint(frame.points * zoom + shift + ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)).astype(int)
        inside = (where[:, 0] >= 0) & (where[:, 1] >= 0) & (where[:, 0] < SIZE[0]) & (where[:, 1] < SIZE[1])
        sums += float(frame.distance[where[inside, 1], where[inside, 0]].sum())
        count += int(inside.sum())
    return sums / count if count else CAP
