"""Edges of grey images, and a query's laid on those of keyframes, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

NEAREST_M = 0.1
CAUCHY_SQUARED = 4.0  # (2 sigma)^2, as in bundle adjustment
HIDDEN = 1.05  # times the depth of what lies before it
LEAST_LENGTH = 0.15  # of a tangent as it is seen, of its length: less is an edge seen from its end
HIT_PX = 2.5
SEEN, HIT, CHI2, COUNTS = range(4)  # What `match_edges` counts


@kernel
def thin(strength: Any, gx: Any, gy: Any, least: float, kept: Any, offset: Any) -> None:
    """Gradients ``[h, w]`` that are greatest across their edge, and how far (pixels, along the gradient) it lies off.

    Canny, A computational approach to edge detection, PAMI 8(6), 1986; a parabola through three samples.
    """
    h, w = strength.shape
    for v in range(2, h - 2):
        for u in range(2, w - 2):
            m = strength[v, u]
            if m < least:
                continue
            dx, dy = gx[v, u] / m, gy[v, u] / m
            ahead, behind = 0.0, 0.0
            for sign in range(2):
                s = 1.0 if sign == 0 else -1.0
                x, y = u + s * dx, v + s * dy
                left, top = int(x), int(y)
                p, q = x - left, y - top
                value = (1 - q) * ((1 - p) * strength[top, left] + p * strength[top, left + 1])
                value += q * ((1 - p) * strength[top + 1, left] + p * strength[top + 1, left + 1])
                if sign == 0:
                    ahead = value
                else:
                    behind = value
            if m >= ahead and m > behind:
                kept[v, u] = m
                bend = 2 * m - ahead - behind
                offset[v, u] = min(0.7, max(-0.7, 0.5 * (ahead - behind) / max(bend, 1e-6)))


@kernel
def cover(points: Any, step: int, intrinsics: Any, world_from_camera: Any, nearest: Any) -> None:
    """Depth ``[h, w]`` of the nearest of every `step`-th of world `points` ``[n, 3]`` in each pixel, or what was."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    h, w = nearest.shape
    m = world_from_camera
    for i in range(0, points.shape[0], step):
        ox, oy, oz = points[i, 0] - m[0, 3], points[i, 1] - m[1, 3], points[i, 2] - m[2, 3]
        z = m[0, 2] * ox + m[1, 2] * oy + m[2, 2] * oz
        if z < NEAREST_M:
            continue
        x, y = m[0, 0] * ox + m[1, 0] * oy + m[2, 0] * oz, m[0, 1] * ox + m[1, 1] * oy + m[2, 1] * oz
        fu, fv = fx * x / z + cx + 0.5, fy * y / z + cy + 0.5
        if not (0.0 <= fu < w and 0.0 <= fv < h):
            continue
        u, v = int(fu), int(fv)
        nearest[v, u] = min(nearest[v, u], z)


@kernel
def is_hidden(z: float, u: int, v: int, nearest: Any) -> bool:
    """Whether a depth lies behind all that is known of a pixel and those about it."""
    h, w = nearest.shape
    farthest = 0.0
    for a in range(max(v - 1, 0), min(v + 2, h)):
        for b in range(max(u - 1, 0), min(u + 2, w)):
            if nearest[a, b] < np.inf:
                farthest = max(farthest, nearest[a, b])
    return farthest > 0 and z > farthest * HIDDEN


@kernel
def match_edges(
    points: Any, tangents: Any, step: int,
    strength: Any, offset: Any, along_x: Any, along_y: Any, intrinsics: Any, world_from_camera: Any,
    nearest: Any, shrink: float, radius: float, turn: float, sigma: float,
    matrix: Any, gradient: Any, counts: Any, marked: Any,
) -> None:  # fmt: skip
    """Adds to `matrix` ``[6, 6]`` and `gradient` what each `step`-th edge point of a keyframe says of a pose.

    `points`, `tangents` ``[n, 3]`` are in the world. Across each edge, as the pose puts it, the nearest edge of the
    query (``[h, w]``: strength, offset, direction of the gradient) is looked for, `radius` pixels far, whose gradient
    points the same way (cosine above `turn`: from dark to bright, too). `nearest` is of `cover`, of an image `shrink`
    times as large. Unknowns are as in `accumulate`. `marked` ``[h, w]``, if not empty, is set where edges are expected.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    h, w = strength.shape
    m = world_from_camera
    j = np.zeros(6)
    for i in range(0, points.shape[0], step):
        ox, oy, oz = points[i, 0] - m[0, 3], points[i, 1] - m[1, 3], points[i, 2] - m[2, 3]
        z = m[0, 2] * ox + m[1, 2] * oy + m[2, 2] * oz
        if z < NEAREST_M:
            continue
        x, y = m[0, 0] * ox + m[1, 0] * oy + m[2, 0] * oz, m[0, 1] * ox + m[1, 1] * oy + m[2, 1] * oz
        fu, fv = fx * x / z + cx, fy * y / z + cy
        if not (3.0 <= fu < w - 4 and 3.0 <= fv < h - 4):
            continue
        cu, cv = int((fu + 0.5) * shrink), int((fv + 0.5) * shrink)
        if is_hidden(z, cu, cv, nearest):
            continue
        a, b, c = tangents[i, 0], tangents[i, 1], tangents[i, 2]
        tz = m[0, 2] * a + m[1, 2] * b + m[2, 2] * c
        du = fx * (m[0, 0] * a + m[1, 0] * b + m[2, 0] * c - x / z * tz) / z
        dv = fy * (m[0, 1] * a + m[1, 1] * b + m[2, 1] * c - y / z * tz) / z
        length = np.sqrt(du * du + dv * dv)
        if length < LEAST_LENGTH * fx / z:
            continue
        nx, ny = dv / length, -du / length  # the gradient, which is a quarter turn from the tangent
        counts[SEEN] += 1
        if marked.shape[0]:
            marked[int(fv + 0.5), int(fu + 0.5)] = 1
        error, found = 0.0, False
        r = 0
        while r <= radius and not found:
            for side in range(2):
                if r == 0 and side == 1:
                    continue
                s = -r if side else r
                u, v = int(fu + s * nx + 0.5), int(fv + s * ny + 0.5)
                if u < 2 or v < 2 or u >= w - 2 or v >= h - 2 or strength[v, u] <= 0:
                    continue
                gx, gy = along_x[v, u], along_y[v, u]
                same = gx * nx + gy * ny
                if same < turn:
                    continue
                ex, ey = u + offset[v, u] * gx - fu, v + offset[v, u] * gy - fv
                off = (ex * gx + ey * gy) / same
                if not found or abs(off) < abs(error):
                    error, found = off, True
            r += 1
        if not found or abs(error) > radius + 1:
            continue
        if abs(error) < HIT_PX:
            counts[HIT] += 1
        chi2 = error * error / (sigma * sigma)
        weight = 1 / (1 + chi2 / CAUCHY_SQUARED)
        counts[CHI2] += weight * chi2
        ax, ay = nx * fx / z, ny * fy / z
        az = -(ax * x + ay * y) / z
        # how the edge moves in the image with a shift of the point, in the world's axes
        bx, by, bz = m[0, 0] * ax + m[0, 1] * ay + m[0, 2] * az, m[1, 0] * ax + m[1, 1] * ay + m[1, 2] * az, \
            m[2, 0] * ax + m[2, 1] * ay + m[2, 2] * az  # fmt: skip
        j[0], j[1], j[2] = -bx, -by, -bz
        j[3], j[4], j[5] = -(oy * bz - oz * by), -(oz * bx - ox * bz), -(ox * by - oy * bx)
        scale = weight / (sigma * sigma)
        for p in range(6):
            gradient[p] -= scale * j[p] * error
            for q in range(p, 6):
                matrix[p, q] += scale * j[p] * j[q]
