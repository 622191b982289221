"""What keyframes with depth show of a place, seen from elsewhere, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

NEAREST_M = 0.1
MOST_FOOTPRINT = 2  # pixels to each side that a pixel of a keyframe may cover, seen from nearer
SAME_DEPTH = 0.06  # share, by which a keyframe's own depth may differ from that of what it is asked for


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
def sample(
    nearest: Any, query: Any, of_query: Any, grey: Any, depth: Any, keyframe: Any, of_keyframe: Any, seen: Any
) -> None:
    """What a keyframe shows at each pixel of a view: `seen` ``[h, w]``, NaN where it does not see what is there.

    `nearest` ``[h, w]`` is of `splat`, infinite where nothing is known.
    """
    h, w = nearest.shape
    kh, kw = depth.shape
    for v in range(h):
        for u in range(w):
            seen[v, u] = np.nan
            d = nearest[v, u]
            if not d < np.inf:
                continue
            a, b, z = _in_other(u, v, d, query, of_query, keyframe, of_keyframe)
            if z < NEAREST_M or not (0.0 <= a < kw - 1 and 0.0 <= b < kh - 1):
                continue
            there = depth[int(b + 0.5), int(a + 0.5)]
            if not abs(there - z) < SAME_DEPTH * z:
                continue
            left, top = int(a), int(b)
            p, q = a - left, b - top
            value = (1 - q) * ((1 - p) * grey[top, left] + p * grey[top, left + 1])
            value += q * ((1 - p) * grey[top + 1, left] + p * grey[top + 1, left + 1])
            seen[v, u] = value
