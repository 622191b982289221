"""How a query correlates with what a keyframe saw, from many poses, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

NEAREST_M = 0.1
LEAST_INSIDE = 0.2  # share of the points
ENOUGH_INSIDE = 0.5  # fewer count less
LEAST_VARIANCE = 4.0  # of grey values: plain walls correlate with anything


@kernel
def correlation(points: Any, values: Any, step: int, grey: Any, lens: Any, pose: Any) -> float:
    """Of every `step`-th of world `points` ``[n, 3]`` with grey `values` and a view ``[h, w]`` from `pose` ``[4, 4]``.

    `lens` is fx, fy, cx, cy. -1 where few are seen, less than the correlation where not many are.
    """
    h, w = grey.shape
    m = pose
    count, tried = 0, 0
    a, b, aa, bb, ab = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(0, points.shape[0], step):
        tried += 1
        ox, oy, oz = points[i, 0] - m[0, 3], points[i, 1] - m[1, 3], points[i, 2] - m[2, 3]
        z = m[0, 2] * ox + m[1, 2] * oy + m[2, 2] * oz
        if z < NEAREST_M:
            continue
        u = lens[0] * (m[0, 0] * ox + m[1, 0] * oy + m[2, 0] * oz) / z + lens[2]
        v = lens[1] * (m[0, 1] * ox + m[1, 1] * oy + m[2, 1] * oz) / z + lens[3]
        if not (0.0 <= u < w - 1 and 0.0 <= v < h - 1):
            continue
        left, top = int(u), int(v)
        p, q = u - left, v - top
        there = (1 - q) * ((1 - p) * grey[top, left] + p * grey[top, left + 1])
        there += q * ((1 - p) * grey[top + 1, left] + p * grey[top + 1, left + 1])
        own = values[i]
        count += 1
        a += own
        b += there
        aa += own * own
        bb += there * there
        ab += own * there
    if count < LEAST_INSIDE * tried or count < 2:
        return -1.0
    a, b = a / count, b / count
    aa, bb, ab = aa / count - a * a, bb / count - b * b, ab / count - a * b
    if aa < LEAST_VARIANCE or bb < LEAST_VARIANCE:
        return -1.0
    return float(ab / np.sqrt(aa * bb)) * min(1.0, count / (ENOUGH_INSIDE * tried))


@kernel
def correlations(points: Any, values: Any, step: int, grey: Any, lens: Any, poses: Any, found: Any) -> None:
    """`found` ``[k]``: `correlation` of each of `poses` ``[k, 4, 4]``."""
    for k in range(poses.shape[0]):
        found[k] = correlation(points, values, step, grey, lens, poses[k])
