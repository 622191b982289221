"""What keyframes with depth show of a place, seen from elsewhere, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

NEAREST_M = 0.1
MOST_FOOTPRINT = 2  # pixels to each side that a pixel of a keyframe may cover, seen from nearer
SAME_DEPTH = 0.06  # share, by which a keyframe's own depth may differ from that of what it is asked for


@kernel
def splat(depth: Any, keyframe: Any, of_keyframe: Any, query: Any, of_query: Any, nearest: Any) -> None:
    """Lowers `nearest` ``[h, w]`` to the depth that a keyframe's pixels have, seen from a pose.

    `depth` ``[h', w']`` is of the keyframe (NaN where unknown); `keyframe` and `query` are fx, fy, cx, cy without
    distortion, `of_keyframe`, `of_query` ``[4, 4]`` poses in the world.
    """
    h, w = nearest.shape
    k, m = of_keyframe, of_query
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            d = depth[v, u]
            if not d > 0:
                continue
            x, y = (u - keyframe[2]) / keyframe[0] * d, (v - keyframe[3]) / keyframe[1] * d
            ox = k[0, 0] * x + k[0, 1] * y + k[0, 2] * d + k[0, 3] - m[0, 3]
            oy = k[1, 0] * x + k[1, 1] * y + k[1, 2] * d + k[1, 3] - m[1, 3]
            oz = k[2, 0] * x + k[2, 1] * y + k[2, 2] * d + k[2, 3] - m[2, 3]
            z = m[0, 2] * ox + m[1, 2] * oy + m[2, 2] * oz
            if z < NEAREST_M:
                continue
            a = query[0] * (m[0, 0] * ox + m[1, 0] * oy + m[2, 0] * oz) / z + query[2]
            b = query[1] * (m[0, 1] * ox + m[1, 1] * oy + m[2, 1] * oz) / z + query[3]
            if not (-1.0 <= a < w + 1 and -1.0 <= b < h + 1):
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
    k, m = of_keyframe, of_query
    for v in range(h):
        for u in range(w):
            seen[v, u] = np.nan
            d = nearest[v, u]
            if not d < np.inf:
                continue
            x, y = (u - query[2]) / query[0] * d, (v - query[3]) / query[1] * d
            ox = m[0, 0] * x + m[0, 1] * y + m[0, 2] * d + m[0, 3] - k[0, 3]
            oy = m[1, 0] * x + m[1, 1] * y + m[1, 2] * d + m[1, 3] - k[1, 3]
            oz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * d + m[2, 3] - k[2, 3]
            z = k[0, 2] * ox + k[1, 2] * oy + k[2, 2] * oz
            if z < NEAREST_M:
                continue
            a = keyframe[0] * (k[0, 0] * ox + k[1, 0] * oy + k[2, 0] * oz) / z + keyframe[2]
            b = keyframe[1] * (k[0, 1] * ox + k[1, 1] * oy + k[2, 1] * oz) / z + keyframe[3]
            if not (0.0 <= a < kw - 1 and 0.0 <= b < kh - 1):
                continue
            there = depth[int(b + 0.5), int(a + 0.5)]
            if not abs(there - z) < SAME_DEPTH * z:
                continue
            left, top = int(a), int(b)
            p, q = a - left, b - top
            value = (1 - q) * ((1 - p) * grey[top, left] + p * grey[top, left + 1])
            value += q * ((1 - p) * grey[top + 1, left] + p * grey[top + 1, left + 1])
            seen[v, u] = value
