"""Depth of 7-Scenes' depth camera as its colour camera would see it.

Neighbouring depth pixels of one surface are joined to triangles, which are moved into the colour camera and
rasterised with a z-buffer. Against moving single pixels this leaves no cracks through which the background
could show, needs no filling afterwards, and gives the depth at the centre of each colour pixel (linear in 1/z,
exact on planes) instead of that of a pixel up to half a pixel away. Pixels at depth steps join no triangle across
the step, so no surface is invented between foreground and background; what the depth camera did not see is NaN.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from functools import lru_cache

import numpy as np

from semdb.compiled import kernel
from semdb.geometry import back_project, normalized_to_pixels
from semdb.recordings.cameras import SEVEN_SCENES_DEPTH
from semdb.recordings.seven_scenes import COLOR_FROM_DEPTH
from semdb.types import Camera, Float32Array

# Neighbours further apart than this share of their depth are two surfaces: a Kinect's step is below 1.5 % of the
# depth up to 5 m, a floor seen at 10 degrees changes by 1 % a pixel.
MAX_STEP = 0.03
TOLERANCE = np.float32(-1e-4)  # a pixel centre on the edge of two triangles belongs to one of them at least
BAND = 64  # rows at a time: what is computed of them stays in the processor's cache
NONE, SEVERAL = np.int32(-1), np.int32(-2)  # how many pixels a triangle may see, where it is not one


def register_seven_scenes(depth: Float32Array, camera: Camera) -> Float32Array:
    """Depth ``[480, 640]`` metres of the depth camera (NaN invalid) as seen by the colour `camera` ``[H, W]``."""
    shift, rays = COLOR_FROM_DEPTH[:3, 3].astype(np.float32), _rotated_rays()
    distorted = any(camera.distortion)
    lens = (1.0, 1.0, 0.0, 0.0) if distorted else (camera.fx, camera.fy, camera.cx, camera.cy)
    fx, fy, cx, cy = (np.float32(number) for number in lens)
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    nearest = np.zeros((camera.height, camera.width), dtype=np.float32)  # 1/z, 0 is nothing
    for top in range(0, len(depth) - 1, BAND):
        part = depth[top : top + BAND + 1]
        u, v, inverse_z, known = np.empty((4, *part.shape), dtype=np.float32)
        _transform(part, rays[top : top + BAND + 1], shift, fx, fy, cx, cy, u, v, inverse_z, known)
        if distorted:
            pixels = normalized_to_pixels(camera, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
            u = pixels[:, 0].reshape(part.shape).astype(np.float32)
            v = pixels[:, 1].reshape(part.shape).astype(np.float32)
        _rasterise(known, u, v, inverse_z, np.float32(MAX_STEP), nearest)
    _invert(nearest)
    return nearest


@lru_cache(maxsize=1)
def _rotated_rays() -> Float32Array:  # [480, 3, 640]
    """Directions of the depth camera's pixels at z = 1, turned into the colour camera."""
    camera = SEVEN_SCENES_DEPTH
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(camera, np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    turned = (rays @ COLOR_FROM_DEPTH[:3, :3].T).reshape(camera.height, camera.width, 3)
    return np.ascontiguousarray(turned.transpose(0, 2, 1), dtype=np.float32)


@kernel
def _transform(  # type: ignore[no-untyped-def]  # pragma: no cover
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
def _rasterise(depth, u, v, inverse_z, max_step, nearest):  # type: ignore[no-untyped-def]  # pragma: no cover
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
def _invert(nearest):  # type: ignore[no-untyped-def]  # pragma: no cover
    """1/z becomes z, what is not known NaN."""
    for row in range(nearest.shape[0]):
        for column in range(nearest.shape[1]):
            w = nearest[row, column]
            nearest[row, column] = np.float32(1) / w if w > 0 else np.float32(np.nan)
