"""Poses of keyframes made to agree with each other's depth, for the time of the computation.

A trajectory that is wrong by a centimetre and half a degree moves a cup by its own width at three metres. Each keyframe
gets a small motion that brings the surfaces that it measured to those that its neighbours measured (point to plane,
projective association; Chen and Medioni 1991, Blais and Levine 1995), held by what poses are usually good for. The
stored poses stay as they are.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from semdb.compiled import kernel
from semdb.geometry import invert_pose, pose_from, project_to_so3, so3_exp
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.options import RegisterOptions
from semdb.threads import cores, each
from semdb.types import FloatArray

LEAST_COMPARED = 50  # points of a keyframe that fall on surfaces of another


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Points ``[n, 3]`` and normals ``[n, 3]`` of a keyframe in its camera frame."""

    points: FloatArray
    normals: FloatArray
    grid_points: FloatArray  # [h, w, 3] NaN where unknown
    grid_normals: FloatArray  # [h, w, 3]
    lens: FloatArray  # fx, fy, cx, cy of the grid


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """Poses ``[n, 4, 4]``, and how far the surfaces of each keyframe lie off those of its neighbours ``[n]``, metres.

    `apart` is the median distance of point to plane as a standard deviation; NaN without neighbours.
    """

    poses: FloatArray
    apart: FloatArray


def corrected_poses(
    lifted: Sequence[LiftedKeyframe],
    options: RegisterOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Poses ``[n, 4, 4]`` of the keyframes after registration; without common surfaces a keyframe stays where it is."""
    return registered(lifted, options, progress).poses


def registered(
    lifted: Sequence[LiftedKeyframe],
    options: RegisterOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Registered:
    """Poses of the keyframes after registration, and how well they agree."""
    options = options or RegisterOptions()
    poses = np.array([frame.world_from_camera for frame in lifted], np.float64).reshape(-1, 4, 4)
    if len(lifted) < 2 or options.rounds < 1:
        return Registered(poses, np.full(len(poses), np.nan))
    surfaces = each(lambda frame: surface_of(frame, options), lifted, cores())
    pairs = _neighbours(surfaces, poses, options)
    start = poses.copy()
    for done in range(options.rounds):
        reach = options.reach_m * options.narrower**done
        _solve(surfaces, poses, start, pairs, reach, options)
        if progress is not None:
            progress(done + 1, options.rounds)
    return Registered(poses, _apart(surfaces, poses, pairs, options.reach_m * options.narrower**options.rounds))


def _apart(
    surfaces: Sequence[Surface], poses: FloatArray, pairs: Sequence[tuple[int, int]], reach: float
) -> FloatArray:
    """Of each keyframe the median over its neighbours of `plane_distances`' medians, as a deviation; NaN without."""
    found: list[list[float]] = [[] for _ in surfaces]
    for i, j in pairs:
        one, other = surfaces[i], surfaces[j]
        away = np.empty(len(one.points))
        number: int = plane_distances(
            one.points,
            poses[i],
            other.grid_points,
            other.grid_normals,
            poses[j],
            invert_pose(poses[j]),
            other.lens,
            reach,
            away,
        )
        if number >= LEAST_COMPARED:
            middle = float(np.median(away[:number]))
            found[i].append(middle)
            found[j].append(middle)
    return np.array([np.median(values) / 0.6745 if values else np.nan for values in found], np.float64)


def surface_of(frame: LiftedKeyframe, options: RegisterOptions) -> Surface:
    """Points and normals of a keyframe on a coarse grid."""
    camera, depth = frame.camera, frame.grid_depth
    step = max(1, depth.shape[1] // options.columns)
    half = step // 2
    rows, columns = len(depth[half::step]), len(depth[0, half::step])
    cells = np.zeros((rows, columns))
    mean_depth(depth, step, half, cells)
    fine = frame.step
    offset, whole = fine // 2 + half * fine, fine * step  # pixel of the first cell, and from one to the next
    lens = np.array([camera.fx, camera.fy, camera.cx - offset, camera.cy - offset]) / whole
    u, v = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64))
    # distortion is left out: it moves a point by less than the cells are wide, and neighbours share it
    grid = np.stack([(u - lens[2]) / lens[0] * cells, (v - lens[3]) / lens[1] * cells, cells], axis=2)
    grid[~(cells > 0)] = np.nan
    normals = np.full_like(grid, np.nan)
    surface_normals(grid, normals)
    known = np.isfinite(normals[..., 0])
    return Surface(grid[known], normals[known], grid, normals, lens)


@kernel
def mean_depth(depth, step, half, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """For each cell the depth whose inverse is the mean of those around that lie on one surface with it; 0 for none.

    Noise of depth sensors is even in inverse depth, and a plane is linear in it.
    """
    rows, columns = depth.shape
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            v0, u0 = half + row * step, half + column * step
            centre = depth[v0, u0]
            if not centre > 0:
                continue
            # twice: about the pixel itself, then about the mean of the first time
            inverse = 1.0 / centre
            for _ in range(2):
                total, number = 0.0, 0
                limit = 0.015 + 0.02 * inverse
                for v in range(max(v0 - step, 0), min(v0 + step + 1, rows)):
                    for u in range(max(u0 - step, 0), min(u0 + step + 1, columns)):
                        z = depth[v, u]
                        if z > 0 and abs(1.0 / z - inverse) < limit:
                            total += 1.0 / z
                            number += 1
                if number:
                    inverse = total / number
            if number > step * step:
                out[row, column] = 1.0 / inverse


@kernel
def surface_normals(grid, normals):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Unit normals of a grid of points ``[h, w, 3]`` from its neighbours, towards the camera; NaN at edges."""
    rows, columns = grid.shape[:2]
    for v in range(2, rows - 2):
        for u in range(2, columns - 2):
            z = grid[v, u, 2]
            if not z > 0:
                continue
            limit = 0.1 * z
            good = True
            for y, x in ((v - 2, u), (v + 2, u), (v, u - 2), (v, u + 2)):
                if not abs(grid[y, x, 2] - z) < limit:
                    good = False
            if not good:
                continue
            ax, ay, az = (
                grid[v, u + 2, 0] - grid[v, u - 2, 0],
                grid[v, u + 2, 1] - grid[v, u - 2, 1],
                grid[v, u + 2, 2] - grid[v, u - 2, 2],
            )
            bx, by, bz = (
                grid[v + 2, u, 0] - grid[v - 2, u, 0],
                grid[v + 2, u, 1] - grid[v - 2, u, 1],
                grid[v + 2, u, 2] - grid[v - 2, u, 2],
            )
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if not length > 0:
                continue
            if nx * grid[v, u, 0] + ny * grid[v, u, 1] + nz * z > 0:
                length = -length
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = nx / length, ny / length, nz / length


def _neighbours(surfaces: Sequence[Surface], poses: FloatArray, options: RegisterOptions) -> list[tuple[int, int]]:
    """Ordered pairs of keyframes of which the second sees what the first does: of each the best few."""
    count = len(surfaces)
    probe = [surface.points[:: max(1, len(surface.points) // 64)] for surface in surfaces]
    found: set[tuple[int, int]] = set()
    centres = poses[:, :3, 3]
    for i in range(count):
        if not len(probe[i]):
            continue
        world = probe[i] @ poses[i, :3, :3].T + poses[i, :3, 3]
        near = np.flatnonzero(np.linalg.norm(centres - centres[i], axis=1) < options.farthest_m)
        near = near[near != i]
        shares = np.zeros(len(near))
        for row, j in enumerate(near):
            shares[row] = _share_in(world, surfaces[j], poses[j], options.reach_m * 2)
        order = np.argsort(-shares, kind="stable")[: options.neighbours]
        found.update((i, int(near[k])) for k in order if shares[k] >= options.least_common)
    return sorted(found)


def _share_in(world: FloatArray, surface: Surface, pose: FloatArray, reach: float) -> float:
    inverse = invert_pose(pose)
    local = world @ inverse[:3, :3].T + inverse[:3, 3]
    ahead = local[local[:, 2] > 0.1]
    if not len(ahead):
        return 0.0
    fx, fy, cx, cy = surface.lens
    u = np.rint(ahead[:, 0] / ahead[:, 2] * fx + cx)
    v = np.rint(ahead[:, 1] / ahead[:, 2] * fy + cy)
    rows, columns = surface.grid_points.shape[:2]
    inside = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    measured = surface.grid_points[v[inside].astype(int), u[inside].astype(int), 2]
    return float(np.count_nonzero(np.abs(measured - ahead[inside, 2]) < reach) / len(world))


def _solve(
    surfaces: Sequence[Surface],
    poses: FloatArray,
    start: FloatArray,
    pairs: Sequence[tuple[int, int]],
    reach: float,
    options: RegisterOptions,
) -> None:
    """One round: changes `poses` ``[n, 4, 4]`` in place."""
    count = len(surfaces)
    blocks = np.zeros((len(pairs), 12, 12))
    sides = np.zeros((len(pairs), 12))

    def compare(row: int) -> None:
        i, j = pairs[row]
        one, other = surfaces[i], surfaces[j]
        pair_equations(
            *(one.points, one.normals, poses[i], other.grid_points, other.grid_normals, poses[j]),
            *(invert_pose(poses[j]), other.lens, reach, options.point_sigma_m, blocks[row], sides[row]),
        )
        weight = min(1.0, options.most_points / max(blocks[row, 0:3, 0:3].trace() * options.point_sigma_m**2, 1e-9))
        blocks[row] *= weight
        sides[row] *= weight

    each(compare, range(len(pairs)), cores())
    index = np.array([[*range(6 * i, 6 * i + 6), *range(6 * j, 6 * j + 6)] for i, j in pairs], np.int64).reshape(-1, 12)
    rows, columns = np.repeat(index, 12, axis=1).ravel(), np.tile(index, (1, 12)).ravel()
    matrix = coo_matrix((blocks.ravel(), (rows, columns)), shape=(6 * count, 6 * count)).tocsc()
    side = np.zeros(6 * count)
    np.add.at(side, index.ravel(), sides.ravel())
    precision = np.tile([options.position_sigma_m**-2] * 3 + [options.rotation_sigma_rad**-2] * 3, count)
    moved = np.concatenate([_moved(poses[k], start[k]) for k in range(count)])
    matrix = matrix + coo_matrix((precision, (np.arange(6 * count),) * 2), shape=matrix.shape).tocsc()
    step = splu(matrix).solve(side - precision * moved)
    for k in range(count):
        shift, turn = step[6 * k : 6 * k + 3], step[6 * k + 3 : 6 * k + 6]
        poses[k] = pose_from(project_to_so3(so3_exp(turn) @ poses[k, :3, :3]), poses[k, :3, 3] + shift)


def _moved(pose: FloatArray, start: FloatArray) -> FloatArray:
    """How far a pose has been moved ``[6]``: metres, and small rotation in the map."""
    turn = pose[:3, :3] @ start[:3, :3].T
    rotation = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return np.concatenate([pose[:3, 3] - start[:3, 3], rotation])


@kernel
def pair_equations(points, normals, pose, grid, grid_normals, other, other_inverse, lens, reach, sigma, block, side):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Adds the normal equations of the distances of `points` ``[n, 3]`` from the surface of another keyframe.

    Unknown are shift and turn (about the camera's centre, axes of the map) of the first, then of the second keyframe:
    `block` ``[12, 12]``, `side` ``[12]``.
    """
    rows, columns = grid.shape[:2]
    j = np.empty(12)
    for k in range(len(points)):
        lx, ly, lz = points[k]
        ax = pose[0, 0] * lx + pose[0, 1] * ly + pose[0, 2] * lz
        ay = pose[1, 0] * lx + pose[1, 1] * ly + pose[1, 2] * lz
        az = pose[2, 0] * lx + pose[2, 1] * ly + pose[2, 2] * lz
        wx, wy, wz = ax + pose[0, 3], ay + pose[1, 3], az + pose[2, 3]
        z = other_inverse[2, 0] * wx + other_inverse[2, 1] * wy + other_inverse[2, 2] * wz + other_inverse[2, 3]
        if not z > 0.1:
            continue
        x = other_inverse[0, 0] * wx + other_inverse[0, 1] * wy + other_inverse[0, 2] * wz + other_inverse[0, 3]
        y = other_inverse[1, 0] * wx + other_inverse[1, 1] * wy + other_inverse[1, 2] * wz + other_inverse[1, 3]
        fu, fv = x / z * lens[0] + lens[2], y / z * lens[1] + lens[3]
        if not (fu > -0.5 and fv > -0.5 and fu < columns - 0.5 and fv < rows - 0.5):
            continue
        u, v = int(np.rint(fu)), int(np.rint(fv))
        nx, ny, nz = grid_normals[v, u]
        if not nx * nx < 2.0:
            continue
        gx, gy, gz = grid[v, u]
        bx = other[0, 0] * gx + other[0, 1] * gy + other[0, 2] * gz
        by = other[1, 0] * gx + other[1, 1] * gy + other[1, 2] * gz
        bz = other[2, 0] * gx + other[2, 1] * gy + other[2, 2] * gz
        mx = other[0, 0] * nx + other[0, 1] * ny + other[0, 2] * nz
        my = other[1, 0] * nx + other[1, 1] * ny + other[1, 2] * nz
        mz = other[2, 0] * nx + other[2, 1] * ny + other[2, 2] * nz
        ox, oy, oz = normals[k]
        sx = pose[0, 0] * ox + pose[0, 1] * oy + pose[0, 2] * oz
        sy = pose[1, 0] * ox + pose[1, 1] * oy + pose[1, 2] * oz
        sz = pose[2, 0] * ox + pose[2, 1] * oy + pose[2, 2] * oz
        if sx * mx + sy * my + sz * mz < 0.8:
            continue
        dx, dy, dz = wx - bx - other[0, 3], wy - by - other[1, 3], wz - bz - other[2, 3]
        away = mx * dx + my * dy + mz * dz
        if not (abs(away) < reach and dx * dx + dy * dy + dz * dz < 9 * reach * reach):
            continue
        share = away / reach
        noise = sigma * (1.0 + 0.3 * lz * lz)
        weight = (1 - share * share) ** 2 / (noise * noise)
        j[0], j[1], j[2] = mx, my, mz
        j[3], j[4], j[5] = ay * mz - az * my, az * mx - ax * mz, ax * my - ay * mx
        j[6], j[7], j[8] = -mx, -my, -mz
        j[9], j[10], j[11] = -(by * mz - bz * my), -(bz * mx - bx * mz), -(bx * my - by * mx)
        for r in range(12):
            side[r] -= weight * j[r] * away
            for c in range(12):
                block[r, c] += weight * j[r] * j[c]


@kernel
def plane_distances(points, pose, grid, grid_normals, other, other_inverse, lens, reach, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes to `out` how far each of `points` ``[n, 3]`` lies off the surface of another keyframe; returns how many.

    Those that fall on no surface of it, or farther than `reach` from it, are left out.
    """
    rows, columns = grid.shape[:2]
    n = 0
    for k in range(len(points)):
        lx, ly, lz = points[k]
        wx = pose[0, 0] * lx + pose[0, 1] * ly + pose[0, 2] * lz + pose[0, 3]
        wy = pose[1, 0] * lx + pose[1, 1] * ly + pose[1, 2] * lz + pose[1, 3]
        wz = pose[2, 0] * lx + pose[2, 1] * ly + pose[2, 2] * lz + pose[2, 3]
        z = other_inverse[2, 0] * wx + other_inverse[2, 1] * wy + other_inverse[2, 2] * wz + other_inverse[2, 3]
        if not z > 0.1:
            continue
        x = other_inverse[0, 0] * wx + other_inverse[0, 1] * wy + other_inverse[0, 2] * wz + other_inverse[0, 3]
        y = other_inverse[1, 0] * wx + other_inverse[1, 1] * wy + other_inverse[1, 2] * wz + other_inverse[1, 3]
        fu, fv = x / z * lens[0] + lens[2], y / z * lens[1] + lens[3]
        if not (fu > -0.5 and fv > -0.5 and fu < columns - 0.5 and fv < rows - 0.5):
            continue
        u, v = int(np.rint(fu)), int(np.rint(fv))
        nx, ny, nz = grid_normals[v, u]
        if not nx * nx < 2.0:
            continue
        gx, gy, gz = grid[v, u]
        away = abs(nx * (x - gx) + ny * (y - gy) + nz * (z - gz))
        if away < reach:
            out[n] = away
            n += 1
    return n
