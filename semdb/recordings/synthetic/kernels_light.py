"""The light that reaches each texel of a room: the compiled part of baking.

numba's cache looks only at the file of the function that is called: after an edit of kernels.py, touch this file.
"""

# mypy: disable-error-code="no-untyped-def,no-untyped-call,misc"
# ruff: noqa: SIM109, PLR1714 - numba compiles comparisons faster than tests for membership
from __future__ import annotations

import math

import numpy as np

from semdb.compiled import kernel
from semdb.recordings.synthetic.kernels import BOX, FAR, FRUSTUM, ROOM, hit, surface


@kernel
def trace(bvh_box, bvh_link, order, kind, rot, centre, half, top, px, py, pz, dx, dy, dz, t_max, stack):
    """Nearest primitive along ``p + t d`` in the world, ``t < t_max``: (t, primitive or -1, face).

    `stack` ``[64]`` is scratch.
    """
    stack[0] = 0
    size, best, prim, face = 1, t_max, -1, 0
    ix, iy, iz = (
        1 / (dx if abs(dx) > 1e-12 else 1e-12),
        1 / (dy if abs(dy) > 1e-12 else 1e-12),
        1 / (dz if abs(dz) > 1e-12 else 1e-12),
    )
    while size > 0:
        size -= 1
        node = stack[size]
        ta, tb = (bvh_box[node, 0] - px) * ix, (bvh_box[node, 3] - px) * ix
        t0, t1 = max(0.0, min(ta, tb)), min(best, max(ta, tb))
        ta, tb = (bvh_box[node, 1] - py) * iy, (bvh_box[node, 4] - py) * iy
        t0, t1 = max(t0, min(ta, tb)), min(t1, max(ta, tb))
        ta, tb = (bvh_box[node, 2] - pz) * iz, (bvh_box[node, 5] - pz) * iz
        t0, t1 = max(t0, min(ta, tb)), min(t1, max(ta, tb))
        if t0 > t1:
            continue
        left, count = bvh_link[node, 0], bvh_link[node, 1]
        if count == 0:
            stack[size], stack[size + 1] = left, left + 1
            size += 2
            continue
        for k in range(left, left + count):
            i = order[k]
            x, y, z = px - centre[i, 0], py - centre[i, 1], pz - centre[i, 2]
            ox, oy = (
                rot[i, 0, 0] * x + rot[i, 0, 1] * y + rot[i, 0, 2] * z,
                rot[i, 1, 0] * x + rot[i, 1, 1] * y + rot[i, 1, 2] * z,
            )
            oz = rot[i, 2, 0] * x + rot[i, 2, 1] * y + rot[i, 2, 2] * z
            ex, ey = (
                rot[i, 0, 0] * dx + rot[i, 0, 1] * dy + rot[i, 0, 2] * dz,
                rot[i, 1, 0] * dx + rot[i, 1, 1] * dy + rot[i, 1, 2] * dz,
            )
            ez = rot[i, 2, 0] * dx + rot[i, 2, 1] * dy + rot[i, 2, 2] * dz
            t, f = hit(kind[i], ox, oy, oz, ex, ey, ez, half[i, 0], half[i, 1], half[i, 2], top[i])
            if t < best:
                best, prim, face = t, i, f
    return best, prim, face


@kernel
def bake(bvh_box, bvh_link, order, world, fmap, mean, lamps, dirs, reach, ambient, lightmap):
    """Fills `lightmap` ``[texels, 3]`` with the light that each texel of each face receives.

    lamps ``[l, 9]``: points of area lights (position, normal, colour). dirs ``[k, 3]``: cosine-weighted directions
    about +z for the light that comes from other surfaces, whose colours are `mean` ``[n, 6, 3]``; what is nearer than
    `reach` metres gives less of it (ambient occlusion).
    """
    kind, rot, centre, half, top = world
    stack = np.zeros(64, np.int64)
    n, p, q, d, nw = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(kind.shape[0]):
        for face in range(6):
            offset, nu, nv = fmap[i, face, 0], fmap[i, face, 1], fmap[i, face, 2]
            for texel in range(nu * nv if offset >= 0 else 0):
                _face_point(kind[i], face, (texel % nu + 0.5) / nu, (texel // nu + 0.5) / nv, half[i], top[i], p)
                _, _, n[0], n[1], n[2], _, _, _, _, _, _ = surface(
                    kind[i], face, p[0], p[1], p[2], half[i, 0], half[i, 1], half[i, 2], top[i]
                )
                for c in range(3):
                    nw[c] = rot[i, 0, c] * n[0] + rot[i, 1, c] * n[1] + rot[i, 2, c] * n[2]
                    q[c] = centre[i, c] + 2e-3 * nw[c]
                    for r in range(3):
                        q[c] += rot[i, r, c] * p[r]
                light = lightmap[offset + texel]
                for k in range(lamps.shape[0]):
                    dist2 = 0.0
                    for c in range(3):
                        d[c] = lamps[k, c] - q[c]
                        dist2 += d[c] * d[c]
                    cos_here = (nw[0] * d[0] + nw[1] * d[1] + nw[2] * d[2]) / math.sqrt(dist2)
                    cos_lamp = -(lamps[k, 3] * d[0] + lamps[k, 4] * d[1] + lamps[k, 5] * d[2]) / math.sqrt(dist2)
                    if cos_here <= 0 or cos_lamp <= 0:
                        continue
                    _, blocker, _ = trace(
                        bvh_box,
                        bvh_link,
                        order,
                        kind,
                        rot,
                        centre,
                        half,
                        top,
                        q[0],
                        q[1],
                        q[2],
                        d[0],
                        d[1],
                        d[2],
                        0.995,
                        stack,
                    )
                    if blocker < 0:
                        for c in range(3):
                            light[c] += lamps[k, 6 + c] * cos_here * cos_lamp / (dist2 + 0.3)
                ax, ay, az = (1.0, 0.0, 0.0) if abs(nw[0]) < 0.8 else (0.0, 1.0, 0.0)
                bx, by, bz = nw[1] * az - nw[2] * ay, nw[2] * ax - nw[0] * az, nw[0] * ay - nw[1] * ax
                norm = math.sqrt(bx * bx + by * by + bz * bz)
                bx, by, bz = bx / norm, by / norm, bz / norm
                cx, cy, cz = nw[1] * bz - nw[2] * by, nw[2] * bx - nw[0] * bz, nw[0] * by - nw[1] * bx
                for k in range(dirs.shape[0]):
                    d[0] = dirs[k, 0] * bx + dirs[k, 1] * cx + dirs[k, 2] * nw[0]
                    d[1] = dirs[k, 0] * by + dirs[k, 1] * cy + dirs[k, 2] * nw[1]
                    d[2] = dirs[k, 0] * bz + dirs[k, 1] * cz + dirs[k, 2] * nw[2]
                    t, hit, f = trace(
                        bvh_box,
                        bvh_link,
                        order,
                        kind,
                        rot,
                        centre,
                        half,
                        top,
                        q[0],
                        q[1],
                        q[2],
                        d[0],
                        d[1],
                        d[2],
                        FAR,
                        stack,
                    )
                    if hit >= 0:
                        near = min(t / reach, 1.0)
                        for c in range(3):
                            light[c] += ambient * near * mean[hit, f, c] / dirs.shape[0]


@kernel
def _face_point(kind, face, u, v, half, top, p):
    """Writes the point at (u, v) of a face: the inverse of `_surface`."""
    if kind == BOX or kind == ROOM:
        axis, sign = face // 2, 1.0 - 2.0 * (face % 2)
        flip = -1.0 if kind == ROOM else 1.0
        p[axis] = sign * half[axis]
        ua = 1 if axis == 0 else 0
        va = 1 if axis == 2 else 2
        us = flip * (-sign if axis == 1 else sign)
        p[ua] = us * (2 * u - 1) * half[ua]
        p[va] = (1 - 2 * v) * half[va]
    elif kind == FRUSTUM and face > 0:
        r = top if face == 1 else half[0]
        p[0], p[1], p[2] = (2 * u - 1) * r * 0.7, (1 - 2 * v) * r * 0.7, half[2] if face == 1 else -half[2]
    else:
        angle, z = (u - 0.5) * 2 * math.pi, (1 - 2 * v) * half[2]
        if kind == FRUSTUM:
            r = half[0] + (top - half[0]) * (1 - v)
            p[0], p[1], p[2] = r * math.cos(angle), r * math.sin(angle), z
        else:
            s = math.sqrt(max(1 - (1 - 2 * v) ** 2, 0.0))
            p[0], p[1], p[2] = half[0] * s * math.cos(angle), half[1] * s * math.sin(angle), z
