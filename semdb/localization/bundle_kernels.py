"""Normal equations of the bundle adjustment and their solution, compiled.

Layouts: `pose` is ``camera_from_world`` ``[4, 4]``; an observation is (x, y) normalised, its sigma, and a depth in
metres (NaN where there is none); a point's own blocks are 3x3, what couples it to the pose is 6x3.
"""

from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.types import FloatArray, IntArray


@kernel
def depth_sigma(depth: float) -> float:
    """Standard deviation in metres of a structured-light depth of `depth` metres.

    The axial noise that Nguyen, Izadi and Lovell measured (3DIMPVT 2012): 0.0012 + 0.0019 (z - 0.4)^2.
    """
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


@kernel
def _observe(
    x: float, y: float, z: float, u: float, v: float, sigma: float, depth: float, cauchy: float, out: FloatArray
) -> float:
    """Weighted residuals (out[0, :]) and their Jacobian by the camera-frame point (out[1:4, :], one row each).

    Returns the robust cost; out[4, 0] is the squared pixel residual over its variance.
    """
    z = max(z, 1e-3)
    inverse = 1.0 / (z * sigma)
    rx, ry = (x / z - u) / sigma, (y / z - v) / sigma
    chi2 = rx * rx + ry * ry
    weight = 1.0 / np.sqrt(1.0 + chi2 / cauchy)
    out[:] = 0.0
    out[0, 0], out[0, 1] = rx * weight, ry * weight
    out[1, 0], out[1, 2] = inverse * weight, -x / z * inverse * weight
    out[2, 1], out[2, 2] = inverse * weight, -y / z * inverse * weight
    out[4, 0] = chi2
    cost: float = cauchy * np.log1p(chi2 / cauchy)
    if not np.isnan(depth):
        spread = depth_sigma(depth)
        rz = (z - depth) / spread
        depth_weight = 1.0 / np.sqrt(1.0 + rz * rz / cauchy)
        out[0, 2] = rz * depth_weight
        out[3, 2] = depth_weight / spread
        cost += cauchy * np.log1p(rz * rz / cauchy)
    return cost


@kernel
def normal_equations(
    pose: FloatArray,
    points: FloatArray,
    query: FloatArray,
    keyframe_point: IntArray,
    keyframe: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    cauchy: float,
    pose_block: FloatArray,
    pose_gradient: FloatArray,
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    query_chi2: FloatArray,
) -> float:
    """Fills the blocks (all but the inputs before `cauchy`) and returns the robust cost.

    `query` ``[m, 4]`` and `keyframe` ``[k, 4]`` are (x, y, sigma, depth); `rotation` ``[k, 3, 3]`` and `translation`
    ``[k, 3]`` are keyframe_from_world of each observation.
    """
    pose_block[:] = 0.0
    pose_gradient[:] = 0.0
    point_blocks[:] = 0.0
    point_gradients[:] = 0.0
    out = np.empty((5, 3))
    by_point = np.empty((3, 3))
    by_pose = np.empty((3, 6))
    cost = 0.0
    for n in range(len(points)):
        x = pose[0, 0] * points[n, 0] + pose[0, 1] * points[n, 1] + pose[0, 2] * points[n, 2] + pose[0, 3]
        y = pose[1, 0] * points[n, 0] + pose[1, 1] * points[n, 1] + pose[1, 2] * points[n, 2] + pose[1, 3]
        z = pose[2, 0] * points[n, 0] + pose[2, 1] * points[n, 1] + pose[2, 2] * points[n, 2] + pose[2, 3]
        cost += _observe(x, y, z, query[n, 0], query[n, 1], query[n, 2], query[n, 3], cauchy, out)
        query_chi2[n] = out[4, 0]
        for r in range(3):
            a, b, c = out[r + 1, 0], out[r + 1, 1], out[r + 1, 2]
            by_pose[r, 0], by_pose[r, 1], by_pose[r, 2] = a, b, c
            # the point turns with the camera by w x p, so row (a, b, c) becomes p x (a, b, c)
            by_pose[r, 3], by_pose[r, 4], by_pose[r, 5] = y * c - z * b, z * a - x * c, x * b - y * a
            for j in range(3):
                by_point[r, j] = a * pose[0, j] + b * pose[1, j] + c * pose[2, j]
        for i in range(6):
            pose_gradient[i] += by_pose[0, i] * out[0, 0] + by_pose[1, i] * out[0, 1] + by_pose[2, i] * out[0, 2]
            for j in range(6):
                pose_block[i, j] += (
                    by_pose[0, i] * by_pose[0, j] + by_pose[1, i] * by_pose[1, j] + by_pose[2, i] * by_pose[2, j]
                )
            for j in range(3):
                coupling[n, i, j] = (
                    by_pose[0, i] * by_point[0, j] + by_pose[1, i] * by_point[1, j] + by_pose[2, i] * by_point[2, j]
                )
        _add_point(by_point, out, point_blocks[n], point_gradients[n])
    for k in range(len(keyframe)):
        n = keyframe_point[k]
        turn = rotation[k]
        x = turn[0, 0] * points[n, 0] + turn[0, 1] * points[n, 1] + turn[0, 2] * points[n, 2] + translation[k, 0]
        y = turn[1, 0] * points[n, 0] + turn[1, 1] * points[n, 1] + turn[1, 2] * points[n, 2] + translation[k, 1]
        z = turn[2, 0] * points[n, 0] + turn[2, 1] * points[n, 1] + turn[2, 2] * points[n, 2] + translation[k, 2]
        cost += _observe(x, y, z, keyframe[k, 0], keyframe[k, 1], keyframe[k, 2], keyframe[k, 3], cauchy, out)
        for r in range(3):
            for j in range(3):
                by_point[r, j] = out[r + 1, 0] * turn[0, j] + out[r + 1, 1] * turn[1, j] + out[r + 1, 2] * turn[2, j]
        _add_point(by_point, out, point_blocks[n], point_gradients[n])
    return cost


@kernel
def _add_point(by_point: FloatArray, out: FloatArray, block: FloatArray, gradient: FloatArray) -> None:
    for i in range(3):
        gradient[i] += by_point[0, i] * out[0, 0] + by_point[1, i] * out[0, 1] + by_point[2, i] * out[0, 2]
        for j in range(3):
            block[i, j] += (
                by_point[0, i] * by_point[0, j] + by_point[1, i] * by_point[1, j] + by_point[2, i] * by_point[2, j]
            )


@kernel
def invert_3x3(block: FloatArray, damping: float, inverse: FloatArray) -> None:
    """Inverse of a symmetric positive block with its diagonal grown by the share `damping`."""
    grow = 1.0 + damping
    a, b, c = block[0, 0] * grow + 1e-12, block[0, 1], block[0, 2]
    d, e, f = block[1, 1] * grow + 1e-12, block[1, 2], block[2, 2] * grow + 1e-12
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * m00 + b * m01 + c * m02)
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = m00 * scale, m01 * scale, m02 * scale
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = m01 * scale, (a * f - c * c) * scale, (b * c - a * e) * scale
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = m02 * scale, (b * c - a * e) * scale, (a * d - b * b) * scale


@kernel
def reduce_to_pose(
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    damping: float,
    reduced: FloatArray,
    gradient: FloatArray,
) -> None:
    """Subtracts from `reduced` ``[6, 6]`` and `gradient` ``[6]`` what the points account for (Schur complement)."""
    inverse = np.empty((3, 3))
    carried = np.empty((6, 3))
    for n in range(len(coupling)):
        invert_3x3(point_blocks[n], damping, inverse)
        for i in range(6):
            for j in range(3):
                carried[i, j] = (
                    coupling[n, i, 0] * inverse[0, j]
                    + coupling[n, i, 1] * inverse[1, j]
                    + coupling[n, i, 2] * inverse[2, j]
                )
            for j in range(3):
                gradient[i] -= carried[i, j] * point_gradients[n, j]
        for i in range(6):
            for j in range(6):
                reduced[i, j] -= (
                    carried[i, 0] * coupling[n, j, 0]
                    + carried[i, 1] * coupling[n, j, 1]
                    + carried[i, 2] * coupling[n, j, 2]
                )


@kernel
def move_points(
    points: FloatArray,
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    damping: float,
    pose_step: FloatArray,
) -> FloatArray:
    """The points ``[m, 3]`` after the step that goes with `pose_step` ``[6]``."""
    moved = points.copy()
    inverse = np.empty((3, 3))
    rest = np.empty(3)
    for n in range(len(points)):
        invert_3x3(point_blocks[n], damping, inverse)
        for j in range(3):
            rest[j] = point_gradients[n, j]
            for i in range(6):
                rest[j] += coupling[n, i, j] * pose_step[i]
        for i in range(3):
            moved[n, i] -= inverse[i, 0] * rest[0] + inverse[i, 1] * rest[1] + inverse[i, 2] * rest[2]
    return moved
