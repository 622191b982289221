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


def register_seven_scenes(depth: Float32Array, camera: Camera) -> Float32Array:
    """Depth ``[480, 640]`` metres of the depth camera (NaN invalid) as seen by the colour `camera` ``[H, W]``."""
    x, y, inverse_z, known = (np.empty(depth.shape, dtype=np.float32) for _ in range(4))
    shift = COLOR_FROM_DEPTH[:3, 3].astype(np.float32)
    _transform(np.ascontiguousarray(depth, dtype=np.float32), _rotated_rays(), shift, x, y, inverse_z, known)
    if any(camera.distortion):
        pixels = normalized_to_pixels(camera, np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        u = pixels[:, 0].reshape(depth.shape).astype(np.float32)
        v = pixels[:, 1].reshape(depth.shape).astype(np.float32)
    else:
        u = x * np.float32(camera.fx) + np.float32(camera.cx)
        v = y * np.float32(camera.fy) + np.float32(camera.cy)
    nearest = np.zeros((camera.height, camera.width), dtype=np.float32)  # 1/z, 0 is nothing
    _rasterise(known, u, v, inverse_z, np.float32(MAX_STEP), nearest)
    registered = np.full_like(nearest, np.nan)
    np.divide(np.float32(1), nearest, out=registered, where=nearest > 0)
    return registered


@lru_cache(maxsize=1)
def _rotated_rays() -> Float32Array:  # [3, 480, 640]
    """Directions of the depth camera's pixels at z = 1, turned into the colour camera."""
    camera = SEVEN_SCENES_DEPTH
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(camera, np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    turned = (rays @ COLOR_FROM_DEPTH[:3, :3].T).T.reshape(3, camera.height, camera.width)
    return np.ascontiguousarray(turned, dtype=np.float32)


@kernel
def _transform(depth, rays, shift, x, y, inverse_z, known):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Where each depth pixel is in the other camera: normalised x and y, and 1/z; `known` is `depth`, 0 for NaN."""
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            d = depth[row, column]
            w = np.float32(1) / (d * rays[2, row, column] + shift[2])
            x[row, column] = (d * rays[0, row, column] + shift[0]) * w
            y[row, column] = (d * rays[1, row, column] + shift[1]) * w
            inverse_z[row, column] = w
            known[row, column] = d if d > 0 else np.float32(0)


@kernel(fastmath=True)
def _rasterise(depth, u, v, inverse_z, max_step, nearest):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Both triangles of each 2x2 block: the diagonal from top right to bottom left is shared."""
    rows, columns = depth.shape
    for row in range(rows - 1):
        for column in range(columns - 1):
            for half in range(2):
                r0, c0 = row + half, column + half
                r1, c1 = row + half, column + 1 - half
                r2, c2 = row + 1 - half, column + half
                a, b, c = depth[r0, c0], depth[r1, c1], depth[r2, c2]
                low, high = min(a, b, c), max(a, b, c)
                if low <= 0 or high - low > max_step * low:
                    continue  # a corner is not known, or they are not one surface
                _triangle(
                    u[r0, c0], v[r0, c0], inverse_z[r0, c0],
                    u[r1, c1], v[r1, c1], inverse_z[r1, c1],
                    u[r2, c2], v[r2, c2], inverse_z[r2, c2],
                    nearest,
                )  # fmt: skip


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
