"""Normal equations of a step between two images, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel
from semdb.localization.bundle_kernels import move_images

CAUCHY_SQUARED = 4.0  # (2 sigma)^2, as in the adjustment of pairs
FARTHEST = 0.2  # m and rad: a step of the solution beyond is none
UNKNOWNS = 9  # translation, left rotation, turn during the readout


@kernel
def step_equations(
    points: Any, observed: Any, rotation: Any, translation: Any, turn: Any, equations: Any, gradient: Any, chi2: Any
) -> None:
    """Fills `equations` ``[9, 9]``, `gradient` ``[9]`` and the squared residuals `chi2` ``[n]``, over their variance.

    `points` ``[n, 3]`` are in the camera before, `observed` ``[n, 4]`` (x, y, sigma, row of the image) in the one
    after; the first two normalised, as in `semdb.localization.bundle_kernels`.
    """
    equations[:] = 0.0
    gradient[:] = 0.0
    rows = np.empty((2, UNKNOWNS))
    for n in range(len(points)):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        x = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c + translation[0]
        y = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c + translation[1]
        z = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c + translation[2]
        row, sigma = observed[n, 3], observed[n, 2]
        wx, wy, wz = row * turn[0], row * turn[1], row * turn[2]
        ahead = max(z + wx * y - wy * x, 1e-3)
        u, v = (x + wy * z - wz * y) / ahead, (y + wz * x - wx * z) / ahead
        rx, ry = (u - observed[n, 0]) / sigma, (v - observed[n, 1]) / sigma
        square = rx * rx + ry * ry
        chi2[n] = square
        weight = 1.0 / (1.0 + square / CAUCHY_SQUARED)
        scale = 1.0 / (ahead * sigma)
        for r in range(2):
            if r == 0:
                p, q, s = scale, 0.0, -u * scale
            else:
                p, q, s = 0.0, scale, -v * scale
            d, e, f = p + q * wz - s * wy, q + s * wx - p * wz, s + p * wy - q * wx
            rows[r, 0], rows[r, 1], rows[r, 2] = d, e, f
            rows[r, 3], rows[r, 4], rows[r, 5] = y * f - z * e, z * d - x * f, x * e - y * d
            rows[r, 6], rows[r, 7], rows[r, 8] = row * (y * s - z * q), row * (z * p - x * s), row * (x * q - y * p)
        for i in range(UNKNOWNS):
            gradient[i] += weight * (rows[0, i] * rx + rows[1, i] * ry)
            for j in range(i + 1):
                equations[i, j] += weight * (rows[0, i] * rows[0, j] + rows[1, i] * rows[1, j])
    for i in range(UNKNOWNS):
        for j in range(i):
            equations[j, i] = equations[i, j]


@kernel
def solve_step(
    points: Any, observed: Any, prior: Any, expected: Any, rounds: int, still: float,
    pose: Any, turn: Any, equations: Any, gradient: Any, chi2: Any,
) -> bool:  # fmt: skip
    """Moves `pose` ``[4, 4]`` and `turn` ``[3]`` to where the squared residuals are least, under a Cauchy loss.

    Gauss and Newton's steps, at most `rounds`, until one is less than `still` (m, rad). `prior` ``[3]`` is the
    information on the turn, of which `expected` is known. False where the equations have no solution nearby.
    """
    rotation, translation = np.empty((3, 3)), np.empty(3)
    for _ in range(rounds):
        for i in range(3):
            translation[i] = pose[i, 3]
            for j in range(3):
                rotation[i, j] = pose[i, j]
        step_equations(points, observed, rotation, translation, turn, equations, gradient, chi2)
        for i in range(3):
            equations[6 + i, 6 + i] += prior[i]
            gradient[6 + i] += prior[i] * (turn[i] - expected[i])
        change = _solved(equations, gradient)
        most = 0.0
        for i in range(UNKNOWNS):
            if not abs(change[i]) < FARTHEST:
                return False
            most = max(most, abs(change[i]))
        pose[:] = move_images(pose.reshape(1, 4, 4), change.reshape(1, UNKNOWNS))[0]
        for i in range(3):
            turn[i] += change[6 + i]
        if most < still:
            break
    return True


@kernel
def _solved(equations: Any, gradient: Any) -> Any:
    """The step ``[9]`` against `gradient`, by elimination without pivots; NaN where the matrix is not positive."""
    rows = equations.copy()
    step = -gradient
    for i in range(UNKNOWNS):
        if not rows[i, i] > 1e-12 * equations[i, i]:
            step[:] = np.nan
            return step
        for k in range(i + 1, UNKNOWNS):
            factor = rows[k, i] / rows[i, i]
            for j in range(i, UNKNOWNS):
                rows[k, j] -= factor * rows[i, j]
            step[k] -= factor * step[i]
    for i in range(UNKNOWNS - 1, -1, -1):
        for j in range(i + 1, UNKNOWNS):
            step[i] -= rows[i, j] * step[j]
        step[i] /= rows[i, i]
    return step


@kernel
def largest_difference(at: Any, values: Any, order: Any, chosen: Any, radius: float, found: Any) -> None:
    """Of each of the `chosen` points, how far the `values` ``[n]`` of others at most `radius` from it are off its own.

    `order` sorts the columns of the points `at` ``[n, 2]``. Fills `found`, one for each of the chosen.
    """
    for k in range(len(chosen)):
        own = chosen[k]
        x, y = at[own, 0], at[own, 1]
        low, high = 0, len(order)
        while low < high:
            middle = (low + high) // 2
            if at[order[middle], 0] < x - radius:
                low = middle + 1
            else:
                high = middle
        most = 0.0
        while low < len(order):
            n = order[low]
            dx, dy = at[n, 0] - x, at[n, 1] - y
            if dx > radius:
                break
            if dx * dx + dy * dy <= radius * radius:
                most = max(most, abs(values[n] - values[own]))
            low += 1
        found[k] = most
