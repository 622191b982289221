"""Triangles of a depth image moved into another camera and rasterised, compiled (`semdb.recordings.registration`)."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np

from semdb.compiled import kernel

TOLERANCE = np.float32(-1e-4)  # a pixel centre on the edge of two triangles belongs to one of them at least
NONE, SEVERAL = np.int32(-1), np.int32(-2)  # how many pixels a triangle may see, where it is not one


@kernel
def transform(  # type: ignore[no-untyped-def]  # pragma: no cover
    depth, rays, shift, fx, fy, cx, cy, u, v, inverse_z, known
):
    """Where each depth pixel is in the other camera, in pixels, and 1/z; `known` is `depth`, 0 for NaN."""
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            d = depth[row, column]
            w = np.float32(1) / (d * rays[row, 2, column] + shift[2])
            x = (d * rays[row, 0, column] + shift[0]) * w
            y = (d * rays[row, 1, column] + shift[1]) * w
            u[row, column] = x * fx + cx
            v[row, column] = y * fy + cy
            inverse_z[row, column] = w
            known[row, column] = d if d > 0 else np.float32(0)


@kernel(fastmath=True)
def rasterise(depth, u, v, inverse_z, max_step, nearest):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Both triangles of each 2x2 block: the diagonal from top right to bottom left is shared."""
    rows, columns = depth.shape
    flat = nearest.reshape(nearest.size)
    place, value = np.empty(columns, np.int32), np.empty(columns, np.float32)
    for row in range(rows - 1):
        for half in range(2):
            several = _triangles_of_row(depth, u, v, inverse_z, max_step, row, half, nearest.shape, place, value)
            if several:
                for c in range(columns - 1):
                    if place[c] == SEVERAL:
                        r0, c0 = row + half, c + half
                        r1, c1 = row + half, c + 1 - half
                        r2, c2 = row + 1 - half, c + half
                        _triangle(
                            u[r0, c0], v[r0, c0], inverse_z[r0, c0],
                            u[r1, c1], v[r1, c1], inverse_z[r1, c1],
                            u[r2, c2], v[r2, c2], inverse_z[r2, c2],
                            nearest,
                        )  # fmt: skip
            found = 0
            for c in range(columns - 1):  # whether a triangle has a pixel cannot be foreseen: no branch
                place[found], value[found] = place[c], value[c]
                found += place[c] >= 0
            for k in range(found):
                p = np.uintp(place[k])
                flat[p] = max(flat[p], value[k])


@kernel(fastmath={"contract"})
def _triangles_of_row(  # type: ignore[no-untyped-def]  # pragma: no cover
    depth, u, v, inverse_z, max_step, row, half, size, place, value
):
    """What `_triangle` does, for one triangle of each block of a row, many at a time: nearly all see at most one pixel.

    Writes the flat index of that pixel to `place`, NONE where there is none, SEVERAL where there may be more, and its
    1/z to `value`. Returns how many are SEVERAL. Rounds as `_triangle` does to the last bit:
    hence `contract` and no more, and the sign of `share_c`.
    """
    height, width = size
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    columns = depth.shape[1]
    flat_depth, flat_u, flat_v, flat_w = depth.ravel(), u.ravel(), v.ravel(), inverse_z.ravel()
    begin = row * columns + half
    a, b = np.uintp(begin + half * columns), np.uintp(begin + half * columns + 1 - 2 * half)
    c = np.uintp(begin + (1 - half) * columns)
    several = np.int32(0)  # as wide as everything else: a wider number would halve how many go at a time
    for k in range(columns - 1):
        x = np.uintp(k)
        ua, ub, uc = flat_u[a + x], flat_u[b + x], flat_u[c + x]
        va, vb, vc = flat_v[a + x], flat_v[b + x], flat_v[c + x]
        wa, wb, wc = flat_w[a + x], flat_w[b + x], flat_w[c + x]
        low = min(flat_depth[a + x], flat_depth[b + x], flat_depth[c + x])
        high = max(flat_depth[a + x], flat_depth[b + x], flat_depth[c + x])
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        left, right = max(np.float32(0), np.ceil(min(ua, ub, uc))), min(last_x, np.floor(max(ua, ub, uc)))
        top, bottom = max(np.float32(0), np.ceil(min(va, vb, vc))), min(last_y, np.floor(max(va, vb, vc)))
        used = (low > 0) & (high - low <= max_step * low) & (area > 0) & (left <= right) & (top <= bottom)
        single = (left == right) & (top == bottom)
        dx, dy = left - ua, top - va
        share_b = (dx * (vc - va) - dy * (uc - ua)) * (np.float32(1) / area)
        share_c = ((vb - va) * dx - (ub - ua) * dy) * (np.float32(-1) / area)
        inside = (min(share_b, share_c) >= TOLERANCE) & (share_b + share_c <= np.float32(1) - TOLERANCE)
        value[x] = wa + share_b * (wb - wa) + share_c * (wc - wa)
        pixel = np.int32(np.int32(np.int32(top) * np.int32(width)) + np.int32(left))
        place[x] = (pixel if inside else NONE) if used & single else (SEVERAL if used else NONE)
        several = np.int32(several + np.int32(used & ~single))
    return several


@kernel(fastmath=True, inline="always")
def _triangle(ua, va, wa, ub, vb, wb, uc, vc, wc, nearest):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes 1/z of one triangle where it is the nearest surface; pixel centres are whole numbers."""
    area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
    if not area > 0:
        return  # seen from behind, or without extent
    height, width = nearest.shape
    left, right = max(0, int(np.ceil(min(ua, ub, uc)))), min(width - 1, int(np.floor(max(ua, ub, uc))))
    top, bottom = max(0, int(np.ceil(min(va, vb, vc)))), min(height - 1, int(np.floor(max(va, vb, vc))))
    if left > right or top > bottom:
        return  # between pixel centres
    scale = np.float32(1) / area
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            dx, dy = np.float32(x) - ua, np.float32(y) - va
            share_b = (dx * (vc - va) - dy * (uc - ua)) * scale
            share_c = ((ub - ua) * dy - (vb - va) * dx) * scale
            if min(share_b, share_c) < TOLERANCE or share_b + share_c > np.float32(1) - TOLERANCE:
                continue
            w = wa + share_b * (wb - wa) + share_c * (wc - wa)
            nearest[y, x] = max(nearest[y, x], w)


@kernel
def invert(nearest):  # type: ignore[no-untyped-def]  # pragma: no cover
    """1/z becomes z, what is not known NaN."""
    for row in range(nearest.shape[0]):
        for column in range(nearest.shape[1]):
            w = nearest[row, column]
            nearest[row, column] = np.float32(1) / w if w > 0 else np.float32(np.nan)
