"""Compiled parts: pixels of masks to points, and points to what another keyframe says of them."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.geometry.sensor import AT_LEAST_M, GROWTH_PER_M, NEAREST_M


@kernel
def inner_pixels(depth, owner, label, border, jump, share, box, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Pixels (flat index) of `label` in `box` (u0, v0, u1, v1) that are no rim and no depth edge. Returns how many.

    `depth` float32 ``[H, W]`` metres (0: none), `owner` int16 ``[H, W]``.
    """
    height, width = depth.shape
    n = 0
    for v in range(box[1], box[3]):
        for u in range(box[0], box[2]):
            z = depth[v, u]
            if owner[v, u] != label or not z > 0:
                continue
            good = True
            for y in range(max(v - border, 0), min(v + border + 1, height)):
                for x in range(max(u - border, 0), min(u + border + 1, width)):
                    if owner[y, x] != label:
                        good = False
                        break
                if not good:
                    break
            if not good:
                continue
            limit = jump + share * z
            for y in range(max(v - 1, 0), min(v + 2, height)):
                for x in range(max(u - 1, 0), min(u + 2, width)):
                    other = depth[y, x]
                    if other > 0 and abs(other - z) > limit:
                        good = False
            if good:
                out[n] = v * width + u
                n += 1
    return n


@kernel
def joined_pixels(depth, owner, label, inner, number, jump, share, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Pixels of `label` that the first `number` of `inner` reach from neighbour to neighbour without a depth edge.

    Writes flat pixels to `out`, `inner` first, and returns how many.
    """
    height, width = depth.shape
    known = np.zeros(height * width, np.uint8)
    for k in range(number):
        known[inner[k]] = 1
        out[k] = inner[k]
    n, next_one = number, 0
    while next_one < n:
        pixel = out[next_one]
        next_one += 1
        v, u = pixel // width, pixel % width
        z = depth[v, u]
        for y in range(max(v - 1, 0), min(v + 2, height)):
            for x in range(max(u - 1, 0), min(u + 2, width)):
                other = y * width + x
                if known[other] or owner[y, x] != label or not depth[y, x] > 0:
                    continue
                if abs(depth[y, x] - z) <= jump + share * z:
                    known[other] = 1
                    out[n] = other
                    n += 1
    return n


@kernel
def rim_pixels(depth, owner, label, reach, inner, number, box, state, out, out_depth):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Pixels of `label` in `box` that are not among the first `number` of `inner`, with the depth of the nearest.

    A pixel farther than `reach` from all inner ones is left out. `state` uint8 ``[H * W]`` of zeros is left as it was.
    Writes flat pixels to `out` and depths to `out_depth`; returns how many.
    """
    height, width = depth.shape
    for k in range(number):
        state[inner[k]] = 1
    n = 0
    for v in range(box[1], box[3]):
        for u in range(box[0], box[2]):
            if owner[v, u] != label or state[v * width + u]:
                continue
            best, found = reach * reach + 1, np.float32(0)
            for y in range(max(v - reach, 0), min(v + reach + 1, height)):
                for x in range(max(u - reach, 0), min(u + reach + 1, width)):
                    if state[y * width + x]:
                        away = (y - v) * (y - v) + (x - u) * (x - u)
                        if away < best:
                            best, found = away, depth[y, x]
            if found > 0:
                out[n] = v * width + u
                out_depth[n] = found
                n += 1
    for k in range(number):
        state[inner[k]] = 0
    return n


@kernel
def look_up(  # type: ignore[no-untyped-def]  # pragma: no cover
    points,
    counts,
    centres,
    radii,
    chosen,
    camera_from_world,
    lens,
    distortion,
    grid_depth,
    grid_owner,
    scale,
    limits,
    labels,
    seen,
    overlaps,
    behind,
):
    """What one keyframe says of the points of sightings `chosen` ``[c]``.

    `points` float32 ``[m, k, 3]`` world, `counts` ``[m]`` how many of them are there, `centres`, `radii` spheres about
    them. `lens` fx, fy, cx, cy, width, height; `distortion` k1, k2, p1, p2, k3. `grid_depth` float32 ``[h, w]``,
    `grid_owner` int16; `scale` pixels per cell. `limits`: near_m, near_share, through_m, through_share, silhouette_m.
    Writes `seen` int32 ``[c, 5]``: in view, visible, occluded, seen through, without depth; `overlaps` and `behind`
    int32 ``[c, labels + 1]``: visible points by label, and those not far behind a pixel of that label.
    """
    fx, fy, cx, cy, width, height = lens
    k1, k2, p1, p2, k3 = distortion
    near_m, near_share, through_m, through_share, silhouette = limits
    rows, columns = grid_depth.shape
    r = camera_from_world
    corner = np.sqrt((max(cx, width - cx) / fx) ** 2 + (max(cy, height - cy) / fy) ** 2)
    cosine = 1.0 / np.sqrt(1.0 + corner * corner)
    sine = corner * cosine
    for c in range(len(chosen)):
        m = chosen[c]
        px, py, pz = centres[m, 0], centres[m, 1], centres[m, 2]
        x = r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]
        y = r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        across = np.sqrt(x * x + y * y)
        if z < -radii[m] or across * cosine - z * sine > radii[m] * 1.001:  # outside the cone about the image
            continue
        for k in range(counts[m]):
            px, py, pz = points[m, k, 0], points[m, k, 1], points[m, k, 2]
            z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
            if z < 0.05:
                continue
            x = (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z
            y = (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z
            if abs(x) > 2 * corner or abs(y) > 2 * corner:
                continue
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            u, v = fx * xd + cx, fy * yd + cy
            if u < -0.5 or v < -0.5 or u >= width - 0.5 or v >= height - 0.5:
                continue
            column = min(int((u + 0.5) / scale), columns - 1)
            row = min(int((v + 0.5) / scale), rows - 1)
            seen[c, 0] += 1
            measured = grid_depth[row, column]
            label = grid_owner[row, column]
            if not measured > 0:
                seen[c, 4] += 1
            elif abs(measured - z) <= near_m + near_share * z:
                seen[c, 1] += 1
                overlaps[c, label] += 1
            elif measured < z:
                seen[c, 2] += 1
                if z - measured < silhouette:
                    behind[c, label] += 1
            elif measured - z > through_m + through_share * z:
                seen[c, 3] += 1


@kernel
def _beside(row, column, z, near, grid_depth, grid_owner, mine):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether a cell next to this one, of a label of `mine`, has that depth: what is thin falls between cells."""
    rows, columns = grid_depth.shape
    for b in range(max(row - 1, 0), min(row + 2, rows)):
        for a in range(max(column - 1, 0), min(column + 2, columns)):
            if mine[grid_owner[b, a]] and grid_depth[b, a] > 0 and abs(grid_depth[b, a] - z) <= near:
                return True
    return False


@kernel
def vote(points, camera_from_world, lens, distortion, grid_depth, grid_owner, scale, limits, mine, visible, inside):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Counts for each point float64 ``[n, 3]`` (world) whether a keyframe sees it, and sees it in a label of `mine`.

    `mine` bool ``[labels + 1]``; `limits`: how near a surface is seen, in metres and as a multiple of
    `depth_noise`; the others as in `look_up`. Adds to `visible` and `inside`, int32 ``[n]``.
    """
    fx, fy, cx, cy, width, height = lens
    k1, k2, p1, p2, k3 = distortion
    rows, columns = grid_depth.shape
    r = camera_from_world
    corner = np.sqrt((max(cx, width - cx) / fx) ** 2 + (max(cy, height - cy) / fy) ** 2)
    for k in range(len(points)):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < 0.05:
            continue
        x = (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z
        y = (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z
        if abs(x) > 2 * corner or abs(y) > 2 * corner:
            continue
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
        v = fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
        if u < -0.5 or v < -0.5 or u >= width - 0.5 or v >= height - 0.5:
            continue
        column = min(int((u + 0.5) / scale), columns - 1)
        row = min(int((v + 0.5) / scale), rows - 1)
        measured = grid_depth[row, column]
        near = limits[0] + limits[1] * (AT_LEAST_M + GROWTH_PER_M * (z - NEAREST_M) ** 2)
        if measured > 0 and abs(measured - z) <= near:
            visible[k] += 1
            if mine[grid_owner[row, column]] or _beside(row, column, z, near, grid_depth, grid_owner, mine):
                inside[k] += 1
