"""Ray casting of boxes, frusta and ellipsoids: the compiled part of the renderer.

A ray is ``o + t d`` in the frame of a primitive; rays of the camera have ``d_z = 1``, so ``t`` is depth z.
"""

# mypy: disable-error-code="no-untyped-def,no-untyped-call,misc"
# ruff: noqa: SIM109, PLR1714 - numba compiles comparisons faster than tests for membership
from __future__ import annotations

import math

import numpy as np

from semdb.compiled import kernel

BOX, FRUSTUM, ELLIPSOID, ROOM = 0, 1, 2, 3
TILE = 8  # pixels
SUBSAMPLES = 3  # per pixel side, at edges
PROBES = 8  # most texture probes along the long axis of a pixel's footprint
FAR = 1e30


@kernel
def _hit_box(ox, oy, oz, dx, dy, dz, hx, hy, hz, inside):
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
        inverse = 1.0 / d
        if d > 0:
            t0, t1, f0, f1 = (-h - o) * inverse, (h - o) * inverse, 2 * axis + 1, 2 * axis
        else:
            t0, t1, f0, f1 = (h - o) * inverse, (-h - o) * inverse, 2 * axis, 2 * axis + 1
        if t0 > t_in:
            t_in, f_in = t0, f0
        if t1 < t_out:
            t_out, f_out = t1, f1
    if t_in > t_out:
        return FAR, 0
    if inside:
        return (t_out, f_out) if t_out > 0 else (FAR, 0)
    return (t_in, f_in) if t_in > 0 else (FAR, 0)


@kernel
def _hit_frustum(ox, oy, oz, dx, dy, dz, r0, r1, h):
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


@kernel
def hit(kind, ox, oy, oz, dx, dy, dz, hx, hy, hz, top):
    """First hit of a primitive in its own frame: (t, face), t = FAR for none."""
    if kind == BOX or kind == ROOM:
        return _hit_box(ox, oy, oz, dx, dy, dz, hx, hy, hz, kind == ROOM)
    if kind == FRUSTUM:
        return _hit_frustum(ox, oy, oz, dx, dy, dz, hx, top, hz)
    ox, oy, oz = ox / hx, oy / hy, oz / hz
    dx, dy, dz = dx / hx, dy / hy, dz / hz
    a, b, c = dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz - 1
    disc = b * b - a * c
    if disc <= 0:
        return FAR, 0
    t = (-b - math.sqrt(disc)) / a
    return (t, 0) if t > 0 else (FAR, 0)


@kernel
def surface(kind, face, x, y, z, hx, hy, hz, top):
    """(u, v) 0..1, outward normal and the gradients of u and v, of point (x, y, z) on a face: 11 numbers."""
    if kind == BOX or kind == ROOM:
        sign = 1.0 - 2.0 * (face % 2)
        side = -1.0 if kind == ROOM else 1.0  # the room is seen from inside
        if face < 2:
            g = sign * side / (2 * hy)
            return 0.5 + g * y, 0.5 - 0.5 * z / hz, sign * side, 0.0, 0.0, 0.0, g, 0.0, 0.0, 0.0, -0.5 / hz
        if face < 4:
            g = -sign * side / (2 * hx)
            return 0.5 + g * x, 0.5 - 0.5 * z / hz, 0.0, sign * side, 0.0, g, 0.0, 0.0, 0.0, 0.0, -0.5 / hz
        g = sign * side / (2 * hx)
        return 0.5 + g * x, 0.5 - 0.5 * y / hy, 0.0, 0.0, sign * side, g, 0.0, 0.0, 0.0, -0.5 / hy, 0.0
    if kind == FRUSTUM:
        if face == 0:
            k = 0.5 * (top - hx) / hz
            r2 = max(x * x + y * y, 1e-12)
            r, norm = math.sqrt(r2), math.sqrt(1 + k * k)
            turn = r2 * 2 * math.pi
            u, v, gv = math.atan2(y, x) / (2 * math.pi) + 0.5, 0.5 - 0.5 * z / hz, -0.5 / hz
            return u, v, x / r / norm, y / r / norm, -k / norm, -y / turn, x / turn, 0.0, 0.0, 0.0, gv
        r = max(top if face == 1 else hx, 1e-9)
        up = 1.0 if face == 1 else -1.0
        return 0.5 + 0.5 * x / r, 0.5 - 0.5 * y / r, 0.0, 0.0, up, 0.5 / r, 0.0, 0.0, 0.0, -0.5 / r, 0.0
    qx, qy = x / hx, y / hy
    turn = max(qx * qx + qy * qy, 1e-6) * 2 * math.pi
    nx, ny, nz = qx / hx, qy / hy, z / (hz * hz)
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    u, v, gv = math.atan2(qy, qx) / (2 * math.pi) + 0.5, 0.5 - 0.5 * z / hz, -0.5 / hz
    return u, v, nx / norm, ny / norm, nz / norm, -qy / (hx * turn), qx / (hy * turn), 0.0, 0.0, 0.0, gv


@kernel
def _fetch(texels, offset, w, h, wrap, x, y):
    """Bilinear sample (r, g, b) at texel coordinates (x, y) of one level."""
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
    a, b = offset + 3 * (y0 * w + x0), offset + 3 * (y0 * w + x1)
    c, d = offset + 3 * (y1 * w + x0), offset + 3 * (y1 * w + x1)
    wa, wb, wc, wd = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
    return (
        wa * texels[a] + wb * texels[b] + wc * texels[c] + wd * texels[d],
        wa * texels[a + 1] + wb * texels[b + 1] + wc * texels[c + 1] + wd * texels[d + 1],
        wa * texels[a + 2] + wb * texels[b + 2] + wc * texels[c + 2] + wd * texels[d + 2],
    )


@kernel
def _texture(texels, table, tex, u, v, jux, jvx, juy, jvy):
    """The texture `tex` filtered over a pixel's footprint: (r, g, b).

    jux is du/dx and so on. Probes along the long axis of the footprint ellipse, each trilinear at the level of the
    short axis (anisotropic filtering), so that there is neither aliasing nor needless blur.
    """
    w, h, levels, wrap = table[tex, 0], table[tex, 1], table[tex, 2], table[tex, 3]
    ax, ay, bx, by = jux * w, jvx * h, juy * w, jvy * h
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
    probes = int(min(max(math.ceil(major / max(minor, 1.0) - 0.5), 1), PROBES))
    level = min(max(math.log2(max(minor, major / probes)), 0.0), levels - 1.0)
    low = int(level)
    blend = level - low
    red = green = blue = 0.0
    for i in range(probes):
        s = (i + 0.5) / probes - 0.5
        x, y = u * w + s * mx, v * h + s * my
        scale = 1.0 / (1 << low)
        wl, hl = max(w >> low, 1), max(h >> low, 1)
        r, g, b = _fetch(texels, table[tex, 4 + low], wl, hl, wrap, x * scale, y * scale)
        if blend > 0.02:
            at = table[tex, 5 + low]
            r1, g1, b1 = _fetch(texels, at, max(wl >> 1, 1), max(hl >> 1, 1), wrap, x * scale * 0.5, y * scale * 0.5)
            r, g, b = r + blend * (r1 - r), g + blend * (g1 - g), b + blend * (b1 - b)
        red, green, blue = red + r, green + g, blue + b
    return red / probes, green / probes, blue / probes


@kernel
def _light(lightmap, offset, nu, nv, curved, u, v):
    """The baked light (r, g, b) at (u, v) of a face."""
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
    a, b, c, d = offset + y0 * nu + x0, offset + y0 * nu + x1, offset + y1 * nu + x0, offset + y1 * nu + x1
    wa, wb, wc, wd = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
    return (
        wa * lightmap[a, 0] + wb * lightmap[b, 0] + wc * lightmap[c, 0] + wd * lightmap[d, 0],
        wa * lightmap[a, 1] + wb * lightmap[b, 1] + wc * lightmap[c, 1] + wd * lightmap[d, 1],
        wa * lightmap[a, 2] + wb * lightmap[b, 2] + wc * lightmap[c, 2] + wd * lightmap[d, 2],
    )


@kernel
def _closest(ids, start, stop, kind, o, m, half, top, near, x, y):
    """Nearest primitive of a tile along the camera ray (x, y, 1): (t, primitive, face). `ids` are sorted by `near`."""
    best, prim, face = FAR, -1, 0
    for k in range(start, stop):
        i = ids[k]
        if near[i, 0] > best:
            break
        if x < near[i, 1] or x > near[i, 2] or y < near[i, 3] or y > near[i, 4]:
            continue
        dx = m[i, 0, 0] * x + m[i, 0, 1] * y + m[i, 0, 2]
        dy = m[i, 1, 0] * x + m[i, 1, 1] * y + m[i, 1, 2]
        dz = m[i, 2, 0] * x + m[i, 2, 1] * y + m[i, 2, 2]
        t, f = hit(kind[i], o[i, 0], o[i, 1], o[i, 2], dx, dy, dz, half[i, 0], half[i, 1], half[i, 2], top[i])
        if t < best:
            best, prim, face = t, i, f
    return best, prim, face


@kernel
def _shade(kind, half, top, ftex, fuv, fmap, tint, texels, table, lightmap, i, face, t, x, y, step, o, m):
    """The colour (r, g, b) of primitive `i` hit at depth `t` by the ray (x, y, 1); pixels are `step` apart."""
    dx = m[i, 0, 0] * x + m[i, 0, 1] * y + m[i, 0, 2]
    dy = m[i, 1, 0] * x + m[i, 1, 1] * y + m[i, 1, 2]
    dz = m[i, 2, 0] * x + m[i, 2, 1] * y + m[i, 2, 2]
    px, py, pz = o[i, 0] + t * dx, o[i, 1] + t * dy, o[i, 2] + t * dz
    u, v, nx, ny, nz, ux, uy, uz, vx, vy, vz = surface(
        kind[i], face, px, py, pz, half[i, 0], half[i, 1], half[i, 2], top[i]
    )
    nd = min(nx * dx + ny * dy + nz * dz, -1e-3)
    su, sv = fuv[i, face, 2] * t * step, fuv[i, face, 3] * t * step
    # how the hit point moves on the tangent plane per pixel to the right and down
    a = (nx * m[i, 0, 0] + ny * m[i, 1, 0] + nz * m[i, 2, 0]) / nd
    mx, my, mz = m[i, 0, 0] - dx * a, m[i, 1, 0] - dy * a, m[i, 2, 0] - dz * a
    jux, jvx = su * (ux * mx + uy * my + uz * mz), sv * (vx * mx + vy * my + vz * mz)
    a = (nx * m[i, 0, 1] + ny * m[i, 1, 1] + nz * m[i, 2, 1]) / nd
    mx, my, mz = m[i, 0, 1] - dx * a, m[i, 1, 1] - dy * a, m[i, 2, 1] - dz * a
    juy, jvy = su * (ux * mx + uy * my + uz * mz), sv * (vx * mx + vy * my + vz * mz)
    at_u, at_v = fuv[i, face, 0] + fuv[i, face, 2] * u, fuv[i, face, 1] + fuv[i, face, 3] * v
    r, g, b = _texture(texels, table, ftex[i, face], at_u, at_v, jux, jvx, juy, jvy)
    r, g, b = r * tint[i, face, 0], g * tint[i, face, 1], b * tint[i, face, 2]
    if fmap[i, face, 0] >= 0:
        curved = face == 0 and (kind[i] == FRUSTUM or kind[i] == ELLIPSOID)
        lr, lg, lb = _light(lightmap, fmap[i, face, 0], fmap[i, face, 1], fmap[i, face, 2], curved, u, v)
        r, g, b = r * lr, g * lg, b * lb
    return r, g, b


@kernel
def cast(kind, half, top, tiles, ids, o, m, near, focal, cx, cy, depth, prims):
    """First pass: writes depth ``[H, W]`` (z of pixel centres, 0 for none) and prims (8 * primitive + face, or -1).

    tiles ``[rows, cols, 2]``: ranges in `ids`. o ``[n, 3]``, m ``[n, 3, 3]``: camera centre and rotation in the frame
    of each primitive. near ``[n, 5]``: its least depth, and the bounds x0, x1, y0, y1 of the rays that can hit it.
    """
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            start, stop = tiles[v // TILE, u // TILE, 0], tiles[v // TILE, u // TILE, 1]
            x, y = (u - cx) / focal, (v - cy) / focal
            t, i, f = _closest(ids, start, stop, kind, o, m, half, top, near, x, y)
            if i >= 0:
                depth[v, u] = t
                prims[v, u] = 8 * i + f


@kernel
def shade(
    kind,
    half,
    top,
    ftex,
    fuv,
    fmap,
    tint,
    texels,
    table,
    lightmap,
    tiles,
    ids,
    o,
    m,
    near,
    focal,
    cx,
    cy,
    depth,
    prims,
    rgb,
):
    """Second pass: writes rgb ``[H, W, 3]`` uint8 from what `cast` found.

    Where a pixel and its neighbours see more than one face, a grid of rays finds the share of each face in the
    pixel, and each face is shaded once.
    """
    height, width = depth.shape
    found, count = np.zeros(SUBSAMPLES**2, np.int64), np.zeros(SUBSAMPLES**2, np.int64)
    where = np.zeros((SUBSAMPLES**2, 3))
    for v in range(height):
        for u in range(width):
            here = prims[v, u]
            edge = False
            for dv in range(-1, 2):
                for du in range(-1, 2):
                    if prims[min(max(v + dv, 0), height - 1), min(max(u + du, 0), width - 1)] != here:
                        edge = True
            x, y = (u - cx) / focal, (v - cy) / focal
            found[0], count[0] = here, 0 if edge else 1
            where[0, 0], where[0, 1], where[0, 2] = depth[v, u], x, y
            n = 1
            if edge:
                start, stop = tiles[v // TILE, u // TILE, 0], tiles[v // TILE, u // TILE, 1]
                for k in range(SUBSAMPLES * SUBSAMPLES):
                    xs = x + ((k % SUBSAMPLES + 0.5) / SUBSAMPLES - 0.5) / focal
                    ys = y + ((k // SUBSAMPLES + 0.5) / SUBSAMPLES - 0.5) / focal
                    t, i, f = _closest(ids, start, stop, kind, o, m, half, top, near, xs, ys)
                    face = 8 * i + f if i >= 0 else -1
                    j = 0
                    while j < n and found[j] != face:
                        j += 1
                    if j == SUBSAMPLES * SUBSAMPLES:
                        continue
                    if j == n:
                        found[j], count[j] = face, 0
                        where[j, 0], where[j, 1], where[j, 2] = t, xs, ys
                        n += 1
                    count[j] += 1
            red = green = blue = 0.0
            total = 0
            for j in range(n):
                if count[j] == 0:
                    continue
                total += count[j]
                if found[j] < 0:
                    continue
                r, g, b = _shade(
                    kind, half, top, ftex, fuv, fmap, tint, texels, table, lightmap,
                    found[j] // 8, found[j] % 8, where[j, 0], where[j, 1], where[j, 2], 1 / focal, o, m,
                )  # fmt: skip
                red, green, blue = red + count[j] * r, green + count[j] * g, blue + count[j] * b
            rgb[v, u, 0] = np.uint8(min(max(red / total + 0.5, 0.0), 255.0))
            rgb[v, u, 1] = np.uint8(min(max(green / total + 0.5, 0.0), 255.0))
            rgb[v, u, 2] = np.uint8(min(max(blue / total + 0.5, 0.0), 255.0))
