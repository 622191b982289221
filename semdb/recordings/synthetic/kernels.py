"""Ray casting of boxes, frusta and ellipsoids: the compiled part of the renderer.

All of it is in one file because numba's cache looks only at the file of the function that is called.
A ray is ``o + t d`` in the frame of a primitive; rays of the camera have ``d_z = 1``, so ``t`` is depth z.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

BOX, FRUSTUM, ELLIPSOID, ROOM = 0, 1, 2, 3
TILE = 16  # pixels
SUBSAMPLES = 3  # per pixel side, at edges
PROBES = 8  # most texture probes along the long axis of a pixel's footprint
FAR = 1e30
_njit = numba.njit(nogil=True, cache=True, error_model="numpy")


@_njit
def _hit_box(ox, oy, oz, dx, dy, dz, hx, hy, hz, inside):  # type: ignore[no-untyped-def]
    """Entry (or exit when `inside`) of a box: (t, face); face is 2 * axis + (1 on the negative side)."""
    t_in, t_out, f_in, f_out = -FAR, FAR, 0, 0
    for axis in range(3):
        if axis == 0:
            o, d, h = ox, dx, hx
        elif axis == 1:
            o, d, h = oy, dy, hy
        else:
            o, d, h = oz, dz, hz
        if abs(d) < 1e-12:
            if abs(o) > h:
                return FAR, 0
            continue
        if d > 0:
            t0, t1, f0, f1 = (-h - o) / d, (h - o) / d, 2 * axis + 1, 2 * axis
        else:
            t0, t1, f0, f1 = (h - o) / d, (-h - o) / d, 2 * axis, 2 * axis + 1
        if t0 > t_in:
            t_in, f_in = t0, f0
        if t1 < t_out:
            t_out, f_out = t1, f1
    if t_in > t_out:
        return FAR, 0
    if inside:
        return (t_out, f_out) if t_out > 0 else (FAR, 0)
    return (t_in, f_in) if t_in > 0 else (FAR, 0)


@_njit
def _hit_frustum(ox, oy, oz, dx, dy, dz, r0, r1, h):  # type: ignore[no-untyped-def]
    """First hit of a capped cone along z: radius `r0` at -h, `r1` at +h. Face 0 side, 1 top, 2 bottom."""
    rm, k = 0.5 * (r0 + r1), 0.5 * (r1 - r0) / h
    best, face = FAR, 0
    a = dx * dx + dy * dy - k * k * dz * dz
    b = ox * dx + oy * dy - k * dz * (rm + k * oz)
    c = ox * ox + oy * oy - (rm + k * oz) ** 2
    disc = b * b - a * c
    if disc > 0 and abs(a) > 1e-14:
        root = math.sqrt(disc)
        for sign in (-1.0, 1.0):
            t = (-b + sign * root) / a
            if 0 < t < best and abs(oz + t * dz) <= h:
                best, face = t, 0
    if abs(dz) > 1e-12:
        for side in range(2):
            z, r = (h, r1) if side == 0 else (-h, r0)
            t = (z - oz) / dz
            if 0 < t < best and (ox + t * dx) ** 2 + (oy + t * dy) ** 2 <= r * r:
                best, face = t, 1 + side
    return best, face


@_njit
def _hit(kind, o, d, half, top):  # type: ignore[no-untyped-def]
    """First hit of a primitive in its own frame: (t, face), t = FAR for none."""
    if kind == BOX or kind == ROOM:
        return _hit_box(o[0], o[1], o[2], d[0], d[1], d[2], half[0], half[1], half[2], kind == ROOM)
    if kind == FRUSTUM:
        return _hit_frustum(o[0], o[1], o[2], d[0], d[1], d[2], half[0], top, half[2])
    ox, oy, oz = o[0] / half[0], o[1] / half[1], o[2] / half[2]
    dx, dy, dz = d[0] / half[0], d[1] / half[1], d[2] / half[2]
    a, b, c = dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz - 1
    disc = b * b - a * c
    if disc <= 0:
        return FAR, 0
    t = (-b - math.sqrt(disc)) / a
    return (t, 0) if t > 0 else (FAR, 0)


@_njit
def _surface(kind, face, p, half, top, n, gu, gv):  # type: ignore[no-untyped-def]
    """(u, v) 0..1 of point `p` on a face; writes the outward normal and the gradients of u and v."""
    for i in range(3):
        n[i] = 0.0
        gu[i] = 0.0
        gv[i] = 0.0
    if kind == BOX or kind == ROOM:
        axis, sign = face // 2, 1.0 - 2.0 * (face % 2)
        n[axis] = sign
        if axis == 0:
            ua, us, va = 1, sign, 2
        elif axis == 1:
            ua, us, va = 0, -sign, 2
        else:
            ua, us, va = 0, sign, 1
        if kind == ROOM:
            us = -us
            n[axis] = -sign
        gu[ua] = us / (2 * half[ua])
        gv[va] = -1 / (2 * half[va])
        return 0.5 + gu[ua] * p[ua], 0.5 + gv[va] * p[va]
    if kind == FRUSTUM:
        if face == 0:
            k = 0.5 * (top - half[0]) / half[2]
            r = max(math.sqrt(p[0] * p[0] + p[1] * p[1]), 1e-9)
            norm = math.sqrt(1 + k * k)
            n[0], n[1], n[2] = p[0] / r / norm, p[1] / r / norm, -k / norm
            gu[0], gu[1] = -p[1] / (r * r * 2 * math.pi), p[0] / (r * r * 2 * math.pi)
            gv[2] = -0.5 / half[2]
            return math.atan2(p[1], p[0]) / (2 * math.pi) + 0.5, 0.5 + gv[2] * p[2]
        r = max(top if face == 1 else half[0], 1e-9)
        n[2] = 1.0 if face == 1 else -1.0
        gu[0], gv[1] = 0.5 / r, -0.5 / r
        return 0.5 + gu[0] * p[0], 0.5 + gv[1] * p[1]
    qx, qy = p[0] / half[0], p[1] / half[1]
    r2 = max(qx * qx + qy * qy, 1e-6)
    n[0], n[1], n[2] = qx / half[0], qy / half[1], p[2] / (half[2] * half[2])
    norm = math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
    n[0], n[1], n[2] = n[0] / norm, n[1] / norm, n[2] / norm
    gu[0], gu[1] = -qy / (half[0] * r2 * 2 * math.pi), qx / (half[1] * r2 * 2 * math.pi)
    gv[2] = -0.5 / half[2]
    return math.atan2(qy, qx) / (2 * math.pi) + 0.5, 0.5 + gv[2] * p[2]


@_njit
def _fetch(texels, offset, w, h, wrap, x, y, weight, out):  # type: ignore[no-untyped-def]
    """Adds `weight` times the bilinear sample at texel coordinates (x, y) of one level to `out`."""
    x -= 0.5
    y -= 0.5
    xf, yf = math.floor(x), math.floor(y)
    ax, ay = x - xf, y - yf
    x0, y0 = int(xf), int(yf)
    x1, y1 = x0 + 1, y0 + 1
    if wrap:
        x0, x1, y0, y1 = x0 & (w - 1), x1 & (w - 1), y0 & (h - 1), y1 & (h - 1)
    else:
        x0, x1 = min(max(x0, 0), w - 1), min(max(x1, 0), w - 1)
        y0, y1 = min(max(y0, 0), h - 1), min(max(y1, 0), h - 1)
    i00, i01 = offset + 3 * (y0 * w + x0), offset + 3 * (y0 * w + x1)
    i10, i11 = offset + 3 * (y1 * w + x0), offset + 3 * (y1 * w + x1)
    w00, w01, w10, w11 = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
    for c in range(3):
        value = w00 * texels[i00 + c] + w01 * texels[i01 + c] + w10 * texels[i10 + c] + w11 * texels[i11 + c]
        out[c] += weight * value


@_njit
def _texture(texels, table, tex, u, v, j, out):  # type: ignore[no-untyped-def]
    """Writes the texture `tex` filtered over a pixel's footprint to `out`.

    `j` = (du/dx, dv/dx, du/dy, dv/dy). Probes along the long axis of the footprint ellipse, each trilinear at the
    level of the short axis (anisotropic filtering), so that there is neither aliasing nor needless blur.
    """
    w, h, levels, wrap = table[tex, 0], table[tex, 1], table[tex, 2], table[tex, 3]
    ax, ay, bx, by = j[0] * w, j[1] * h, j[2] * w, j[3] * h
    e, f, g = ax * ax + bx * bx, ax * ay + bx * by, ay * ay + by * by
    root = math.sqrt((e - g) ** 2 + 4 * f * f)
    major = math.sqrt(max(0.5 * (e + g + root), 1e-12))
    minor = math.sqrt(max(0.5 * (e + g - root), 1e-12))
    mx, my = (f, major * major - e) if e < g else (major * major - g, f)
    norm = math.sqrt(mx * mx + my * my)
    if norm > 1e-12:
        mx, my = mx / norm * major, my / norm * major
    else:
        mx, my = major, 0.0
    probes = int(min(max(math.ceil(major / max(minor, 1.0) - 0.2), 1), PROBES))
    level = min(max(math.log2(max(minor, major / probes)), 0.0), levels - 1.0)
    low = int(level)
    blend = level - low
    out[0] = out[1] = out[2] = 0.0
    for i in range(probes):
        s = (i + 0.5) / probes - 0.5
        x, y = u * w + s * mx, v * h + s * my
        scale = 1.0 / (1 << low)
        wl, hl = max(w >> low, 1), max(h >> low, 1)
        _fetch(texels, table[tex, 4 + low], wl, hl, wrap, x * scale, y * scale, (1 - blend) / probes, out)
        if blend > 0:
            wl, hl = max(wl >> 1, 1), max(hl >> 1, 1)
            at = table[tex, 5 + low]
            _fetch(texels, at, wl, hl, wrap, x * scale * 0.5, y * scale * 0.5, blend / probes, out)


@_njit
def _light(lightmap, offset, nu, nv, curved, u, v, out):  # type: ignore[no-untyped-def]
    """Multiplies `out` by the baked light at (u, v) of a face."""
    x, y = u * nu - 0.5, v * nv - 0.5
    xf, yf = math.floor(x), math.floor(y)
    ax, ay = x - xf, y - yf
    x0, y0 = int(xf), int(yf)
    x1, y1 = x0 + 1, min(max(y0 + 1, 0), nv - 1)
    y0 = min(max(y0, 0), nv - 1)
    if curved:
        x0, x1 = (x0 + nu) % nu, (x1 + nu) % nu
    else:
        x0, x1 = min(max(x0, 0), nu - 1), min(max(x1, 0), nu - 1)
    for c in range(3):
        a = lightmap[offset + y0 * nu + x0, c] * (1 - ax) + lightmap[offset + y0 * nu + x1, c] * ax
        b = lightmap[offset + y1 * nu + x0, c] * (1 - ax) + lightmap[offset + y1 * nu + x1, c] * ax
        out[c] *= a * (1 - ay) + b * ay


@_njit
def _closest(ids, start, stop, kind, o, m, half, top, near, x, y, d):  # type: ignore[no-untyped-def]
    """Nearest primitive of a tile along the camera ray (x, y, 1): (t, primitive, face). `ids` are sorted by `near`."""
    best, prim, face = FAR, -1, 0
    for k in range(start, stop):
        i = ids[k]
        if near[i] > best:
            break
        for r in range(3):
            d[r] = m[i, r, 0] * x + m[i, r, 1] * y + m[i, r, 2]
        t, f = _hit(kind[i], o[i], d, half[i], top[i])
        if t < best:
            best, prim, face = t, i, f
    return best, prim, face


@_njit
def _shade(scene, i, face, t, x, y, step_x, step_y, o, m, work, out):  # type: ignore[no-untyped-def]
    """Writes the colour of primitive `i` hit at depth `t` by the ray (x, y, 1) to `out`."""
    kind, half, top, ftex, fuv, fmap, tint, texels, table, lightmap = scene
    p, d, n, gu, gv, j = work[0], work[1], work[2], work[3], work[4], work[5]
    for r in range(3):
        d[r] = m[i, r, 0] * x + m[i, r, 1] * y + m[i, r, 2]
        p[r] = o[i, r] + t * d[r]
    u, v = _surface(kind[i], face, p, half[i], top[i], n, gu, gv)
    nd = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
    nd = min(nd, -1e-3) if nd < 0 else max(nd, 1e-3)
    su, sv = fuv[i, face, 2], fuv[i, face, 3]
    for axis in range(2):
        step = step_x if axis == 0 else step_y
        n_dx = (n[0] * m[i, 0, axis] + n[1] * m[i, 1, axis] + n[2] * m[i, 2, axis]) / nd
        ju = jv = 0.0
        for r in range(3):
            move = t * step * (m[i, r, axis] - d[r] * n_dx)  # of the hit point, per pixel
            ju += gu[r] * move
            jv += gv[r] * move
        j[2 * axis] = ju * su
        j[2 * axis + 1] = jv * sv
    _texture(texels, table, ftex[i, face], fuv[i, face, 0] + su * u, fuv[i, face, 1] + sv * v, j, out)
    for c in range(3):
        out[c] *= tint[i, face, c]
    if fmap[i, face, 0] >= 0:
        curved = face == 0 and (kind[i] == FRUSTUM or kind[i] == ELLIPSOID)
        _light(lightmap, fmap[i, face, 0], fmap[i, face, 1], fmap[i, face, 2], curved, u, v, out)


@_njit
def render(scene, tiles, ids, o, m, near, camera, rgb, depth, prims):  # type: ignore[no-untyped-def]
    """Renders one view.

    scene: arrays of `scene.PackedScene`. tiles ``[rows, cols, 2]``: range in `ids`. o ``[n, 3]``, m ``[n, 3, 3]``: camera
    centre and rotation in the frame of each primitive. camera: (fx, fy, cx, cy). Writes rgb ``[H, W, 3]`` uint8,
    depth ``[H, W]`` float64 (z of the pixel's centre, 0 for none), prims ``[H, W]`` int32 (8 * primitive + face).
    """
    kind, half, top = scene[0], scene[1], scene[2]
    fx, fy, cx, cy = camera
    height, width = depth.shape
    work, out, acc = np.zeros((6, 4)), np.zeros(3), np.zeros(3)
    for v in range(height):
        for u in range(width):
            tile = tiles[v // TILE, u // TILE]
            x, y = (u - cx) / fx, (v - cy) / fy
            t, i, f = _closest(ids, tile[0], tile[1], kind, o, m, half, top, near, x, y, work[1])
            depth[v, u] = t if i >= 0 else 0.0
            prims[v, u] = 8 * i + f if i >= 0 else -1
    for v in range(height):
        for u in range(width):
            here = prims[v, u]
            edge = False
            for dv in range(-1, 2):
                for du in range(-1, 2):
                    if prims[min(max(v + dv, 0), height - 1), min(max(u + du, 0), width - 1)] != here:
                        edge = True
            if not edge:
                x, y = (u - cx) / fx, (v - cy) / fy
                if here >= 0:
                    _shade(scene, here // 8, here % 8, depth[v, u], x, y, 1 / fx, 1 / fy, o, m, work, out)
                    for c in range(3):
                        rgb[v, u, c] = np.uint8(min(max(out[c] + 0.5, 0.0), 255.0))
                continue
            tile = tiles[v // TILE, u // TILE]
            acc[0] = acc[1] = acc[2] = 0.0
            for sv in range(SUBSAMPLES):
                for su in range(SUBSAMPLES):
                    x = (u + (su + 0.5) / SUBSAMPLES - 0.5 - cx) / fx
                    y = (v + (sv + 0.5) / SUBSAMPLES - 0.5 - cy) / fy
                    t, i, f = _closest(ids, tile[0], tile[1], kind, o, m, half, top, near, x, y, work[1])
                    if i >= 0:
                        _shade(scene, i, f, t, x, y, 0.5 / fx, 0.5 / fy, o, m, work, out)
                        for c in range(3):
                            acc[c] += out[c]
            for c in range(3):
                rgb[v, u, c] = np.uint8(min(max(acc[c] / SUBSAMPLES**2 + 0.5, 0.0), 255.0))


@_njit
def trace(bvh_box, bvh_link, order, kind, rot, centre, half, top, p, d, t_max, work):  # type: ignore[no-untyped-def]
    """Nearest primitive along ``p + t d`` in the world, ``t < t_max``: (t, primitive or -1, face)."""
    stack = np.empty(64, np.int64)
    stack[0] = 0
    size, best, prim, face = 1, t_max, -1, 0
    o, e = work[0], work[1]
    while size > 0:
        size -= 1
        node = stack[size]
        t0, t1 = 0.0, best
        for a in range(3):
            inv = 1.0 / (d[a] if abs(d[a]) > 1e-12 else 1e-12)
            ta, tb = (bvh_box[node, a] - p[a]) * inv, (bvh_box[node, 3 + a] - p[a]) * inv
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
            for r in range(3):
                o[r] = e[r] = 0.0
                for c in range(3):
                    o[r] += rot[i, r, c] * (p[c] - centre[i, c])
                    e[r] += rot[i, r, c] * d[c]
            t, f = _hit(kind[i], o, e, half[i], top[i])
            if t < best:
                best, prim, face = t, i, f
    return best, prim, face


@_njit
def bake(bvh_box, bvh_link, order, world, fmap, mean, lamps, dirs, reach, ambient, lightmap):  # type: ignore[no-untyped-def]
    """Fills `lightmap` ``[texels, 3]`` with the light that each texel of each face receives.

    lamps ``[l, 9]``: points of area lights (position, normal, colour). dirs ``[k, 3]``: cosine-weighted directions
    about +z for the light that comes from other surfaces, whose colours are `mean` ``[n, 6, 3]``; what is nearer than
    `reach` metres gives less of it (ambient occlusion).
    """
    kind, rot, centre, half, top = world
    work, n, gu, gv = np.zeros((2, 3)), np.zeros(3), np.zeros(3), np.zeros(3)
    p, q, d, nw = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(kind.shape[0]):
        for face in range(6):
            offset, nu, nv = fmap[i, face, 0], fmap[i, face, 1], fmap[i, face, 2]
            for texel in range(nu * nv if offset >= 0 else 0):
                _face_point(kind[i], face, (texel % nu + 0.5) / nu, (texel // nu + 0.5) / nv, half[i], top[i], p)
                _surface(kind[i], face, p, half[i], top[i], n, gu, gv)
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
                    _, blocker, _ = trace(bvh_box, bvh_link, order, kind, rot, centre, half, top, q, d, 0.995, work)
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
                    t, hit, f = trace(bvh_box, bvh_link, order, kind, rot, centre, half, top, q, d, FAR, work)
                    if hit >= 0:
                        near = min(t / reach, 1.0)
                        for c in range(3):
                            light[c] += ambient * near * mean[hit, f, c] / dirs.shape[0]


@_njit
def _face_point(kind, face, u, v, half, top, p):  # type: ignore[no-untyped-def]
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


Kernel = Any  # numba's dispatchers carry no types
