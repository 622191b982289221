"""What keyframes with depth show of a place, seen from elsewhere, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

NEAREST_M = 0.1
MOST_FOOTPRINT = 2  # pixels to each side that a pixel of a keyframe may cover, seen from nearer
SAME_DEPTH = 0.06  # share, by which a keyframe's own depth may differ from that of what it is asked for
HOLE = 5  # pixels, that what is seen aslant or from near leaves open between two of one surface
ONE_SURFACE = 0.25  # share, by which depths on both sides of a hole may differ
ABOUT = 4  # pixels to each side, by which it is measured how finely a keyframe shows what is there
ONE_STEP = 0.15  # share of depth from there, more is no one surface
LEAST_SCALE = 0.45  # pixels of a keyframe to one of the view: thin lines are not there in fewer


@kernel
def _in_other(u: Any, v: Any, d: Any, lens: Any, pose: Any, other: Any, of_other: Any) -> Any:
    """Where the pixel `u`, `v` of one camera with depth `d` lies in another one: its pixel there, and its depth."""
    k, m = pose, of_other
    x, y = (u - lens[2]) / lens[0] * d, (v - lens[3]) / lens[1] * d
    ox = k[0, 0] * x + k[0, 1] * y + k[0, 2] * d + k[0, 3] - m[0, 3]
    oy = k[1, 0] * x + k[1, 1] * y + k[1, 2] * d + k[1, 3] - m[1, 3]
    oz = k[2, 0] * x + k[2, 1] * y + k[2, 2] * d + k[2, 3] - m[2, 3]
    z = m[0, 2] * ox + m[1, 2] * oy + m[2, 2] * oz
    a = other[0] * (m[0, 0] * ox + m[1, 0] * oy + m[2, 0] * oz) / z + other[2]
    b = other[1] * (m[0, 1] * ox + m[1, 1] * oy + m[2, 1] * oz) / z + other[3]
    return a, b, z


@kernel
def splat(depth: Any, keyframe: Any, of_keyframe: Any, query: Any, of_query: Any, nearest: Any) -> None:
    """Lowers `nearest` ``[h, w]`` to the depth that a keyframe's pixels have, seen from a pose.

    `depth` ``[h', w']`` is of the keyframe (NaN where unknown); `keyframe` and `query` are fx, fy, cx, cy without
    distortion, `of_keyframe`, `of_query` ``[4, 4]`` poses in the world.
    """
    h, w = nearest.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            d = depth[v, u]
            if not d > 0:
                continue
            a, b, z = _in_other(u, v, d, keyframe, of_keyframe, query, of_query)
            if z < NEAREST_M or not (-1.0 <= a < w + 1 and -1.0 <= b < h + 1):
                continue
            size = int(0.5 + 0.5 * d / z * query[0] / keyframe[0])
            size = min(size, MOST_FOOTPRINT)
            cu, cv = int(np.floor(a + 0.5)), int(np.floor(b + 0.5))
            for q in range(max(cv - size, 0), min(cv + size + 1, h)):
                for p in range(max(cu - size, 0), min(cu + size + 1, w)):
                    nearest[q, p] = min(nearest[q, p], z)


@kernel
def fill(nearest: Any, filled: Any) -> None:
    """`filled` ``[h, w]``: `nearest` (infinite where unknown) with its holes between two depths of one surface closed.

    In each hole the inverse depth, which is linear on a plane, goes from side to side, across the narrower way.
    """
    h, w = nearest.shape
    for v in range(h):
        for u in range(w):
            filled[v, u] = nearest[v, u]
            if nearest[v, u] < np.inf:
                continue
            width = 2 * HOLE
            for way in range(2):
                dv, du = way, 1 - way
                before, after = 0, 0
                for r in range(1, HOLE + 1):
                    a, b = v - r * dv, u - r * du
                    if before == 0 and a >= 0 and b >= 0 and nearest[a, b] < np.inf:
                        before = r
                    a, b = v + r * dv, u + r * du
                    if after == 0 and a < h and b < w and nearest[a, b] < np.inf:
                        after = r
                if before == 0 or after == 0 or before + after >= width:
                    continue
                one = 1 / nearest[v - before * dv, u - before * du]
                two = 1 / nearest[v + after * dv, u + after * du]
                if abs(one - two) > ONE_SURFACE * max(one, two):
                    continue
                width = before + after
                filled[v, u] = (before + after) / (one * after + two * before)


@kernel
def _is_there(z: float, a: float, b: float, depth: Any) -> bool:
    """Whether a keyframe saw a thing `z` far at its pixel `a`, `b`, or depths before and behind it about there."""
    p, q = int(a + 0.5), int(b + 0.5)
    there = depth[q, p]
    if abs(there - z) < SAME_DEPTH * z:
        return True
    least, most = np.inf, 0.0
    for y in range(max(q - 1, 0), min(q + 2, depth.shape[0])):
        for x in range(max(p - 1, 0), min(p + 2, depth.shape[1])):
            d = depth[y, x]
            if d > 0:
                least, most = min(least, d), max(most, d)
    return least * (1 - SAME_DEPTH) < z < most * (1 + SAME_DEPTH) and most < least * (1 + ONE_SURFACE)


@kernel
def _scale(u: int, v: int, nearest: Any, query: Any, of_query: Any, keyframe: Any, of_keyframe: Any) -> float:
    """Pixels of a keyframe to one of the view, along the worst direction; 1 where there is no one surface about."""
    h, w = nearest.shape
    d = nearest[v, u]
    j = np.zeros((2, 2))
    for way in range(2):
        dv, du = way * ABOUT, (1 - way) * ABOUT
        if v < dv or u < du or v + dv >= h or u + du >= w:
            return 1.0
        one, two = nearest[v - dv, u - du], nearest[v + dv, u + du]
        if not (abs(one - d) < ONE_STEP * d and abs(two - d) < ONE_STEP * d):
            return 1.0
        a, b, z = _in_other(u - du, v - dv, one, query, of_query, keyframe, of_keyframe)
        p, q, y = _in_other(u + du, v + dv, two, query, of_query, keyframe, of_keyframe)
        if z < NEAREST_M or y < NEAREST_M:
            return 0.0
        j[0, way], j[1, way] = (p - a) / (2 * ABOUT), (q - b) / (2 * ABOUT)
    total = j[0, 0] ** 2 + j[0, 1] ** 2 + j[1, 0] ** 2 + j[1, 1] ** 2
    area = j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]
    return float(np.sqrt(max(0.0, 0.5 * (total - np.sqrt(max(0.0, total * total - 4 * area * area))))))


@kernel
def sample(
    nearest: Any, query: Any, of_query: Any, grey: Any, depth: Any, keyframe: Any, of_keyframe: Any, seen: Any
) -> None:
    """What a keyframe shows at each pixel of a view: `seen` ``[h, w]``, NaN where it does not see what is there.

    So too where it shows that much more coarsely, from farther away or more aslant.

    `nearest` ``[h, w]`` is of `splat`, infinite where nothing is known.
    """
    h, w = nearest.shape
    kh, kw = depth.shape
    scales = np.ones((w + 1) // 2)  # of two rows: one for four pixels
    for v in range(h):
        for u in range(w):
            seen[v, u] = np.nan
            d = nearest[v, u]
            if v % 2 == 0 and u % 2 == 0:
                scales[u // 2] = 1.0
                if d < np.inf:
                    scales[u // 2] = _scale(u, v, nearest, query, of_query, keyframe, of_keyframe)
            if not d < np.inf or scales[u // 2] < LEAST_SCALE:
                continue
            a, b, z = _in_other(u, v, d, query, of_query, keyframe, of_keyframe)
            if z < NEAREST_M or not (0.0 <= a < kw - 1 and 0.0 <= b < kh - 1):
                continue
            if not _is_there(z, a, b, depth):
                continue
            left, top = int(a), int(b)
            p, q = a - left, b - top
            value = (1 - q) * ((1 - p) * grey[top, left] + p * grey[top, left + 1])
            value += q * ((1 - p) * grey[top + 1, left] + p * grey[top + 1, left + 1])
            seen[v, u] = value
