"""Dense alignment of a query's depth and grey values with surfaces of keyframes, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

LEAST_SLANT = 0.15  # cosine of the angle between a surface and the ray that sees it
NEAREST_M = 0.1
LEAST_GRADIENT = 2.0  # grey values per pixel
CAUCHY_SQUARED = 4.0  # (2 sigma)^2, as in bundle adjustment
# What `accumulate` counts
SEEN, NEAR, OCCLUDED, THROUGH, ALIKE, CHI2, WEIGHT, GREY_FIRST = range(8)
DETAIL_FIRST = GREY_FIRST + 6  # after sums of grey values: weight, k, q, kk, qk, qq
COUNTS = DETAIL_FIRST + 3  # and of detail: kk, qk, qq


@kernel
def reduce_depth(depth: Any, step: int, jump: float, out: Any) -> None:
    """Mean of each block of `step` x `step` depths; NaN where half are missing or they differ by a share `jump`."""
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            total, count, low, high = 0.0, 0, 1e9, 0.0
            for y in range(v * step, (v + 1) * step):
                for x in range(u * step, (u + 1) * step):
                    d = depth[y, x]
                    if d > 0:
                        total += d
                        count += 1
                        low, high = min(low, d), max(high, d)
            if 2 * count >= step * step and high - low < jump * low:
                out[v, u] = total / count
            else:
                out[v, u] = np.nan


@kernel
def normals_of(depth: Any, fx: float, fy: float, cx: float, cy: float, jump: float, out: Any) -> None:
    """Normals ``[h, w, 3]`` (camera frame, towards the camera) of a depth image; NaN at borders and jumps."""
    h, w = depth.shape
    out[:] = np.nan
    for v in range(1, h - 1):
        for u in range(1, w - 1):
            d, left, right = depth[v, u], depth[v, u - 1], depth[v, u + 1]
            up, down = depth[v - 1, u], depth[v + 1, u]
            limit = jump * d
            if not (abs(left - d) < limit and abs(right - d) < limit and abs(up - d) < limit and abs(down - d) < limit):
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            ax, ay, az = (right - left) * x + (right + left) / fx, (right - left) * y, right - left
            bx, by, bz = (down - up) * x, (down - up) * y + (down + up) / fy, down - up
            nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            size = np.sqrt(nx * nx + ny * ny + nz * nz)
            if size > 0:
                sign = -1.0 if nx * x + ny * y + nz > 0 else 1.0
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = sign * nx / size, sign * ny / size, sign * nz / size


@kernel
def accumulate(
    points: Any, normals: Any, greys: Any, details: Any, variances: Any, floor: float, every: int,
    depth: Any, grey: Any, detail: Any, depth_variance: Any, intrinsics: Any, world_from_camera: Any,
    gate: float, gain: float, bias: float, grey_variance: float, use_grey: bool,
    matrix: Any, gradient: Any, counts: Any,
) -> None:  # fmt: skip
    """Adds what every `every`-th point of a keyframe says of the query's pose to `matrix` ``[6, 6]``, `gradient`.

    `points`, `normals` ``[n, 3]`` are in the world, `variances` ``[n]`` of their depth along the normal, to which
    `floor` is added. `depth` (metres) and `grey` are images ``[h, w]`` of the query without distortion, `intrinsics`
    fx, fy, cx, cy. The unknowns are a translation (m, world) and a rotation (rad, left perturbation in the world, about
    the camera).
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    h, w = depth.shape
    r00, r01, r02 = world_from_camera[0, 0], world_from_camera[0, 1], world_from_camera[0, 2]
    r10, r11, r12 = world_from_camera[1, 0], world_from_camera[1, 1], world_from_camera[1, 2]
    r20, r21, r22 = world_from_camera[2, 0], world_from_camera[2, 1], world_from_camera[2, 2]
    tx, ty, tz = world_from_camera[0, 3], world_from_camera[1, 3], world_from_camera[2, 3]
    j = np.zeros(6)
    for i in range(0, points.shape[0], every):
        ox, oy, oz = points[i, 0] - tx, points[i, 1] - ty, points[i, 2] - tz
        x = r00 * ox + r10 * oy + r20 * oz
        y = r01 * ox + r11 * oy + r21 * oz
        z = r02 * ox + r12 * oy + r22 * oz
        if z < NEAREST_M:
            continue
        fu, fv = fx * x / z + cx, fy * y / z + cy
        if not (1.0 <= fu < w - 2 and 1.0 <= fv < h - 2):
            continue
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        if -(nx * ox + ny * oy + nz * oz) < LEAST_SLANT * np.sqrt(ox * ox + oy * oy + oz * oz):
            continue  # seen from behind, or along the surface
        u, v = int(fu + 0.5), int(fv + 0.5)
        d = depth[v, u]
        if not d > 0:
            continue
        counts[SEEN] += 1
        qx, qy = (u - cx) / fx * d, (v - cy) / fy * d
        # the query's point about the camera, in the world's axes
        wx, wy, wz = r00 * qx + r01 * qy + r02 * d, r10 * qx + r11 * qy + r12 * d, r20 * qx + r21 * qy + r22 * d
        error = nx * (wx - ox) + ny * (wy - oy) + nz * (wz - oz)
        if abs(error) > gate:
            if d < z:
                counts[OCCLUDED] += 1
            else:
                counts[THROUGH] += 1
            continue
        variance = variances[i] + floor + depth_variance[v, u]
        chi2 = error * error / variance
        weight = 1 / (1 + chi2 / CAUCHY_SQUARED)
        if chi2 < 9:
            counts[NEAR] += 1
        counts[CHI2] += weight * chi2
        counts[WEIGHT] += weight
        j[0], j[1], j[2] = nx, ny, nz
        j[3], j[4], j[5] = wy * nz - wz * ny, wz * nx - wx * nz, wx * ny - wy * nx
        scale = weight / variance
        for a in range(6):
            gradient[a] += scale * j[a] * error
            for b in range(a, 6):
                matrix[a, b] += scale * j[a] * j[b]
        left, top = int(fu), int(fv)
        p, q = fu - left, fv - top
        g00, g01, g10, g11 = grey[top, left], grey[top, left + 1], grey[top + 1, left], grey[top + 1, left + 1]
        shown = (1 - q) * ((1 - p) * g00 + p * g01) + q * ((1 - p) * g10 + p * g11)
        k = greys[i]
        counts[GREY_FIRST] += weight
        counts[GREY_FIRST + 1] += weight * k
        counts[GREY_FIRST + 2] += weight * shown
        counts[GREY_FIRST + 3] += weight * k * k
        counts[GREY_FIRST + 4] += weight * shown * k
        counts[GREY_FIRST + 5] += weight * shown * shown
        fine = (1 - q) * ((1 - p) * detail[top, left] + p * detail[top, left + 1])
        fine += q * ((1 - p) * detail[top + 1, left] + p * detail[top + 1, left + 1])
        counts[DETAIL_FIRST] += details[i] * details[i]
        counts[DETAIL_FIRST + 1] += details[i] * fine
        counts[DETAIL_FIRST + 2] += fine * fine
        off = shown - (gain * k + bias)
        grey_chi2 = off * off / grey_variance
        if grey_chi2 < 9:
            counts[ALIKE] += 1
        if not use_grey:
            continue
        gu = (1 - q) * (g01 - g00) + q * (g11 - g10)
        gv = (1 - p) * (g10 - g00) + p * (g11 - g01)
        if gu * gu + gv * gv < LEAST_GRADIENT * LEAST_GRADIENT:
            continue  # noise, which would seem to hold the pose where nothing does
        ax, ay = gu * fx / z, gv * fy / z
        az = -(ax * x + ay * y) / z
        # how the grey value grows with a shift of the point, in the world's axes
        bx, by, bz = r00 * ax + r01 * ay + r02 * az, r10 * ax + r11 * ay + r12 * az, r20 * ax + r21 * ay + r22 * az
        j[0], j[1], j[2] = -bx, -by, -bz
        j[3], j[4], j[5] = -(oy * bz - oz * by), -(oz * bx - ox * bz), -(ox * by - oy * bx)
        scale = weight / (1 + grey_chi2 / CAUCHY_SQUARED) / grey_variance
        for a in range(6):
            gradient[a] += scale * j[a] * off
            for b in range(a, 6):
                matrix[a, b] += scale * j[a] * j[b]
