"""One image placed by images that stand still, compiled: its pose, its turn while it was read out, and the points.

As `semdb.localization.bundle` does it, where keyframes may move, too; here each point is seen by the image and by one
keyframe, whose pose and turn are known. So there are nine unknowns beside the points, and one pass over these does for
a step. Unknowns of the image: translation, rotation (both a left perturbation of ``camera_from_world``), turn.
Observations are rows of (x, y) normalised, sigma, depth (NaN without), row of the image, factor of the depth's noise.
"""

from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.localization.bundle_kernels import FAST, depth_sigma, invert_3x3, move_images
from semdb.types import FloatArray, IntArray

PARAMETERS = 9
RESIDUAL = 9  # column of the residual


@kernel(fastmath=FAST, forceinline=True)
def _rows(
    points: FloatArray,
    n: int,
    rotation: FloatArray,
    translation: FloatArray,
    turn: FloatArray,
    c: int,
    observed: FloatArray,
    cauchy: float,
    rows: FloatArray,
    by_point: FloatArray,
) -> float:
    """Weighted residuals of what image `c` saw of point `n`, with their Jacobians by the image and by the point.

    Returns what the robust cost grows by.
    """
    x = rotation[c, 0, 0] * points[n, 0] + rotation[c, 0, 1] * points[n, 1] + rotation[c, 0, 2] * points[n, 2]
    y = rotation[c, 1, 0] * points[n, 0] + rotation[c, 1, 1] * points[n, 1] + rotation[c, 1, 2] * points[n, 2]
    z = rotation[c, 2, 0] * points[n, 0] + rotation[c, 2, 1] * points[n, 1] + rotation[c, 2, 2] * points[n, 2]
    x, y, z = x + translation[c, 0], y + translation[c, 1], z + translation[c, 2]
    sigma, depth, row = observed[n, 2], observed[n, 3], observed[n, 4]
    wx, wy, wz = row * turn[c, 0], row * turn[c, 1], row * turn[c, 2]
    ahead = max(z + wx * y - wy * x, 1e-3)
    u, v = (x + wy * z - wz * y) / ahead, (y + wz * x - wx * z) / ahead
    rx, ry = (u - observed[n, 0]) / sigma, (v - observed[n, 1]) / sigma
    growth = 1.0 + (rx * rx + ry * ry) / cauchy
    weight = 1.0 / np.sqrt(growth)
    scale = weight / (ahead * sigma)
    for r in range(3):
        if r == 0:
            p, q, s, residual = scale, 0.0, -u * scale, rx * weight
        elif r == 1:
            p, q, s, residual = 0.0, scale, -v * scale, ry * weight
        elif np.isnan(depth):
            p, q, s, residual = 0.0, 0.0, 0.0, 0.0
        else:
            spread = depth_sigma(depth) * observed[n, 5]
            rz = (ahead - depth) / spread
            growth_of_depth = 1.0 + rz * rz / cauchy
            growth *= growth_of_depth
            weight = 1.0 / np.sqrt(growth_of_depth)
            p, q, s, residual = 0.0, 0.0, weight / spread, rz * weight
        a, b, d = p + q * wz - s * wy, q + s * wx - p * wz, s + p * wy - q * wx
        rows[r, 0], rows[r, 1], rows[r, 2] = a, b, d
        rows[r, 3], rows[r, 4], rows[r, 5] = y * d - z * b, z * a - x * d, x * b - y * a
        rows[r, 6], rows[r, 7], rows[r, 8] = row * (y * s - z * q), row * (z * p - x * s), row * (x * q - y * p)
        rows[r, RESIDUAL] = residual
        for j in range(3):
            by_point[r, j] = a * rotation[c, 0, j] + b * rotation[c, 1, j] + d * rotation[c, 2, j]
    cost: float = cauchy * np.log(growth)
    return cost


@kernel(fastmath=FAST)
def equations(
    points: FloatArray,
    slot: IntArray,
    rotation: FloatArray,
    translation: FloatArray,
    turn: FloatArray,
    own: FloatArray,
    theirs: FloatArray,
    cauchy: float,
    damping: float,
    matrix: FloatArray,
    gradient: FloatArray,
    carried: FloatArray,
    back: FloatArray,
    pulls: FloatArray,
) -> float:
    """Equations of the image, the points eliminated; returns the robust cost.

    Image 0 is the one that is placed, ``slot[n]`` the keyframe that saw point n. Filled: `matrix` ``[9, 9]``,
    `gradient` ``[9]``, for the step of each point `carried` ``[n, 3, 9]`` and `back` ``[n, 3]``, and what each adds to
    the gradient, `pulls` ``[n, 9]``.
    """
    matrix[:] = 0.0
    gradient[:] = 0.0
    rows, by_point, other = np.zeros((3, 10)), np.zeros((3, 3)), np.zeros((3, 3))
    block, inverse, pull, coupling = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros((PARAMETERS, 3))
    cost = 0.0
    for n in range(len(points)):
        cost += _rows(points, n, rotation, translation, turn, slot[n], theirs, cauchy, rows, other)
        for i in range(3):
            pull[i] = (
                other[0, i] * rows[0, RESIDUAL] + other[1, i] * rows[1, RESIDUAL] + other[2, i] * rows[2, RESIDUAL]
            )
        cost += _rows(points, n, rotation, translation, turn, 0, own, cauchy, rows, by_point)
        for i in range(3):
            p, q, s = by_point[0, i], by_point[1, i], by_point[2, i]
            pull[i] += p * rows[0, RESIDUAL] + q * rows[1, RESIDUAL] + s * rows[2, RESIDUAL]
            for j in range(3):
                block[i, j] = (
                    p * by_point[0, j] + q * by_point[1, j] + s * by_point[2, j]
                    + other[0, i] * other[0, j] + other[1, i] * other[1, j] + other[2, i] * other[2, j]
                )  # fmt: skip
        invert_3x3(block, damping, inverse)
        for i in range(3):
            back[n, i] = inverse[i, 0] * pull[0] + inverse[i, 1] * pull[1] + inverse[i, 2] * pull[2]
        for i in range(PARAMETERS):
            p, q, s = rows[0, i], rows[1, i], rows[2, i]
            for j in range(3):
                coupling[i, j] = p * by_point[0, j] + q * by_point[1, j] + s * by_point[2, j]
            pulls[n, i] = (
                p * rows[0, RESIDUAL] + q * rows[1, RESIDUAL] + s * rows[2, RESIDUAL]
                - coupling[i, 0] * back[n, 0] - coupling[i, 1] * back[n, 1] - coupling[i, 2] * back[n, 2]
            )  # fmt: skip
            gradient[i] += pulls[n, i]
            for j in range(3):
                carried[n, j, i] = (
                    inverse[j, 0] * coupling[i, 0] + inverse[j, 1] * coupling[i, 1] + inverse[j, 2] * coupling[i, 2]
                )
        for i in range(PARAMETERS):
            p, q, s = rows[0, i], rows[1, i], rows[2, i]
            a, b, c = coupling[i, 0], coupling[i, 1], coupling[i, 2]
            for j in range(PARAMETERS):
                matrix[i, j] += (
                    p * rows[0, j] + q * rows[1, j] + s * rows[2, j]
                    - a * carried[n, 0, j] - b * carried[n, 1, j] - c * carried[n, 2, j]
                )  # fmt: skip
    return cost


@kernel
def solve_small(matrix: FloatArray, right: FloatArray, damping: float, found: FloatArray) -> bool:
    """Solves a symmetric positive `matrix` ``[p, p]``, its diagonal grown by the share `damping`; False where not."""
    size = len(right)
    lower = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j] * (1.0 + damping if i == j else 1.0)
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 1e-12 * matrix[i, i]:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * found[k]
        found[i] = total / lower[i, i]
    for i in range(size - 1, -1, -1):
        total = found[i]
        for k in range(i + 1, size):
            total -= lower[k, i] * found[k]
        found[i] = total / lower[i, i]
    return True


@kernel
def minimise(
    points: FloatArray,
    slot: IntArray,
    poses: FloatArray,
    turn: FloatArray,
    own: FloatArray,
    theirs: FloatArray,
    cauchy: float,
    expected: FloatArray,
    turn_information: float,
    most: int,
    least_gain: float,
    least_step: float,
    matrix: FloatArray,
    pulls: FloatArray,
) -> bool:
    """Levenberg-Marquardt from ``poses[0]`` ``[4, 4]``, ``turn[0]`` and `points`, in place; False where it fails.

    `matrix` ``[9, 9]`` and `pulls` ``[n, 9]`` are those of the solution, undamped. The turn is expected to be
    `expected` ``[3]``, with the information `turn_information`.
    """
    count = len(points)
    rotation, translation = poses[:, :3, :3].copy(), poses[:, :3, 3].copy()
    gradient, carried, back = np.zeros(PARAMETERS), np.zeros((count, 3, PARAMETERS)), np.zeros((count, 3))
    step, moved, new_turn, first = np.zeros((1, PARAMETERS)), points.copy(), turn.copy(), poses[:1].copy()
    damping, stand = 1e-4, True  # whether the equations are those of where it stands
    cost = equations(
        points, slot, rotation, translation, turn, own, theirs, cauchy, damping, matrix, gradient, carried, back, pulls
    ) + turn_information * ((turn[0] - expected) ** 2).sum()  # fmt: skip
    for _ in range(most):
        if not stand:
            equations(
                points, slot, rotation, translation, turn, own, theirs, cauchy, damping, matrix, gradient, carried,
                back, pulls,
            )  # fmt: skip
        for i in range(3):
            matrix[6 + i, 6 + i] += turn_information
            gradient[6 + i] += turn_information * (turn[0, i] - expected[i])
        if not solve_small(matrix, gradient, damping, step[0]):
            return False
        largest = 0.0
        for i in range(PARAMETERS):
            step[0, i] = -step[0, i]
            largest = max(largest, abs(step[0, i]))
        first[0] = move_images(poses[:1], step)[0]
        for i in range(3):
            new_turn[0, i] = turn[0, i] + step[0, 6 + i]
        for n in range(count):
            for j in range(3):
                total = back[n, j]
                for i in range(PARAMETERS):
                    total += carried[n, j, i] * step[0, i]
                moved[n, j] = points[n, j] - total
        rotation[0], translation[0] = first[0, :3, :3], first[0, :3, 3]
        easier = max(damping / 10, 1e-9)
        found = equations(
            moved, slot, rotation, translation, new_turn, own, theirs, cauchy, easier, matrix, gradient, carried,
            back, pulls,
        ) + turn_information * ((new_turn[0] - expected) ** 2).sum()  # fmt: skip
        if found < cost:
            gain = cost - found
            cost, damping, stand = found, easier, True
            poses[0], turn[0] = first[0], new_turn[0]
            points[:] = moved
            if gain < least_gain * cost or largest < least_step:
                break
        else:
            rotation[0], translation[0] = poses[0, :3, :3], poses[0, :3, 3]
            damping, stand = damping * 10, False
            if damping > 1e6:
                break
    equations(
        points, slot, rotation, translation, turn, own, theirs, cauchy, 0.0, matrix, gradient, carried, back, pulls
    )
    for i in range(3):
        matrix[6 + i, 6 + i] += turn_information
        for j in range(PARAMETERS):
            if not np.isfinite(matrix[i, j]):
                return False
    return bool(np.isfinite(poses[0]).all())
