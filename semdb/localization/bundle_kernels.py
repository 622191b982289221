"""Normal equations of the bundle adjustment and their solution, compiled.

Layouts: an image has nine unknowns: translation, rotation (both a left perturbation of ``camera_from_world``) and its
rotation while it was read out. An observation is (x, y) normalised, its sigma, a depth in metres (NaN where there is
none), the row it was seen in, -0.5 at the top of the image to 0.5 at the bottom, and what the noise of the depth is
multiplied by. Observations are sorted by point.
"""

from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.geometry.sensor import AT_LEAST_M, GROWTH_PER_M, NEAREST_M
from semdb.types import FloatArray, IntArray

PARAMETERS = 9  # of an image
WIDTH = 12  # of a row of residuals with its Jacobian: 9 parameters, the residual, and room to whole vector registers
RESIDUAL = 9  # where the residual is in it
GREAT = 1e60  # a product greater than that is not to grow on
# sums may be taken in another order, for vector instructions; what is no number stays none
FAST = {"reassoc", "contract", "nsz", "arcp"}


@kernel
def depth_sigma(depth: float) -> float:
    """What `semdb.geometry.sensor.depth_noise` says of one depth; here, since kernels of one file compile together."""
    return AT_LEAST_M + GROWTH_PER_M * (depth - NEAREST_M) ** 2


@kernel(fastmath=FAST, forceinline=True)
def _observe(
    points: FloatArray,
    n: int,
    rotation: FloatArray,
    translation: FloatArray,
    turn: FloatArray,
    c: int,
    observed: FloatArray,
    k: int,
    cauchy: float,
    rows: FloatArray,
    by_point: FloatArray,
) -> tuple[float, float]:
    """Weighted residuals of observation `k`, of point `n` in image `c`. Whole arrays: to cut them costs more.

    Fills `rows` ``[3, 12]`` (Jacobian by the image's parameters, residual) and `by_point` ``[3, 4]`` (Jacobian by the
    world point); the third row, of the depth, is zero where there is none. Returns the squared pixel residual over its
    variance, and what the robust cost grows by, as the argument of a logarithm.
    """
    sigma, depth, row = observed[k, 2], observed[k, 3], observed[k, 4]
    x = (
        rotation[c, 0, 0] * points[n, 0]
        + rotation[c, 0, 1] * points[n, 1]
        + rotation[c, 0, 2] * points[n, 2]
        + translation[c, 0]
    )
    y = (
        rotation[c, 1, 0] * points[n, 0]
        + rotation[c, 1, 1] * points[n, 1]
        + rotation[c, 1, 2] * points[n, 2]
        + translation[c, 1]
    )
    z = (
        rotation[c, 2, 0] * points[n, 0]
        + rotation[c, 2, 1] * points[n, 1]
        + rotation[c, 2, 2] * points[n, 2]
        + translation[c, 2]
    )
    wx, wy, wz = (
        row * turn[c, 0],
        row * turn[c, 1],
        row * turn[c, 2],
    )  # to first order, the camera turned by that in this row
    ahead = max(z + wx * y - wy * x, 1e-3)
    u, v = (x + wy * z - wz * y) / ahead, (y + wz * x - wx * z) / ahead
    rx, ry = (u - observed[k, 0]) / sigma, (v - observed[k, 1]) / sigma
    chi2 = rx * rx + ry * ry
    growth = 1.0 + chi2 / cauchy
    weight = 1.0 / np.sqrt(growth)
    scale = weight / (ahead * sigma)
    for r in range(3):
        # Jacobian by the point as seen: (p, q, s)
        if r == 0:
            p, q, s, residual = scale, 0.0, -u * scale, rx * weight
        elif r == 1:
            p, q, s, residual = 0.0, scale, -v * scale, ry * weight
        elif np.isnan(depth):
            p, q, s, residual = 0.0, 0.0, 0.0, 0.0
        else:
            spread = depth_sigma(depth) * observed[k, 5]
            rz = (ahead - depth) / spread
            growth_of_depth = 1.0 + rz * rz / cauchy
            growth *= growth_of_depth
            weight = 1.0 / np.sqrt(growth_of_depth)
            p, q, s, residual = 0.0, 0.0, weight / spread, rz * weight
        # through the turn of the readout, I + row [w]x, then through the pose
        a, b, d = p + q * wz - s * wy, q + s * wx - p * wz, s + p * wy - q * wx
        # the point turns with the camera by w x p, so row (a, b, d) becomes p x (a, b, d)
        rows[r, 0], rows[r, 1], rows[r, 2] = a, b, d
        rows[r, 3], rows[r, 4], rows[r, 5] = y * d - z * b, z * a - x * d, x * b - y * a
        rows[r, 6], rows[r, 7], rows[r, 8] = row * (y * s - z * q), row * (z * p - x * s), row * (x * q - y * p)
        rows[r, RESIDUAL] = residual
        for j in range(3):
            by_point[r, j] = a * rotation[c, 0, j] + b * rotation[c, 1, j] + d * rotation[c, 2, j]
    return chi2, growth


@kernel(fastmath=FAST)
def normal_equations(
    points: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    turn: FloatArray,
    observed_point: IntArray,
    observed_image: IntArray,
    observed: FloatArray,
    cauchy: float,
    image_blocks: FloatArray,
    image_gradients: FloatArray,
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    chi2: FloatArray,
    own_gradients: FloatArray,
) -> float:
    """Fills the blocks (all after `cauchy`) and returns the robust cost.

    `rotation` ``[c, 3, 3]``, `translation` ``[c, 3]``: camera_from_world; `turn` ``[c, 3]`` radians per readout;
    `observed` ``[k, 6]`` is (x, y, sigma, depth, row, factor of the depth's noise). Filled: ``[c, 9, 9]``, ``[c, 9]``,
    ``[k, 9, 3]``, ``[m, 3, 3]``, ``[m, 3]``, ``[k]``, and ``[k, 9]``: what each observation adds to the gradients.
    """
    point_blocks[:] = 0.0
    point_gradients[:] = 0.0
    sums = np.zeros((len(image_blocks), PARAMETERS, WIDTH))
    rows, by_point = np.zeros((3, WIDTH)), np.zeros((3, 4))
    cost, product = 0.0, 1.0  # one logarithm of many factors
    for k in range(len(observed)):
        n, c = observed_point[k], observed_image[k]
        chi2[k], growth = _observe(points, n, rotation, translation, turn, c, observed, k, cauchy, rows, by_point)
        product *= growth
        if product > GREAT:
            cost += np.log(product)
            product = 1.0
        _add(rows, by_point, sums, c, coupling, own_gradients, k)
        _add_point(rows, by_point, point_blocks, point_gradients, n)
    for c in range(len(image_blocks)):
        for i in range(PARAMETERS):
            image_gradients[c, i] = sums[c, i, RESIDUAL]
            for j in range(PARAMETERS):
                image_blocks[c, i, j] = sums[c, i, j]
    total: float = cauchy * (cost + np.log(product))
    return total


@kernel(fastmath=FAST, forceinline=True)
def _add(
    rows: FloatArray, by_point: FloatArray, sums: FloatArray, c: int, coupling: FloatArray, own: FloatArray, k: int
) -> None:
    """Adds observation `k` to the sums ``[9, 12]`` of its image `c`, and fills what couples image and point."""
    for i in range(PARAMETERS):
        p, q, s = rows[0, i], rows[1, i], rows[2, i]
        for j in range(WIDTH):
            sums[c, i, j] += p * rows[0, j] + q * rows[1, j] + s * rows[2, j]
        for j in range(3):
            coupling[k, i, j] = p * by_point[0, j] + q * by_point[1, j] + s * by_point[2, j]
        own[k, i] = p * rows[0, RESIDUAL] + q * rows[1, RESIDUAL] + s * rows[2, RESIDUAL]


@kernel(fastmath=FAST, forceinline=True)
def _add_point(rows: FloatArray, by_point: FloatArray, blocks: FloatArray, gradients: FloatArray, n: int) -> None:
    for i in range(3):
        p, q, s = by_point[0, i], by_point[1, i], by_point[2, i]
        gradients[n, i] += p * rows[0, RESIDUAL] + q * rows[1, RESIDUAL] + s * rows[2, RESIDUAL]
        for j in range(3):
            blocks[n, i, j] += p * by_point[0, j] + q * by_point[1, j] + s * by_point[2, j]


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


@kernel(fastmath=FAST)
def reduce_to_images(
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    first: IntArray,
    observed_image: IntArray,
    damping: float,
    reduced: FloatArray,
    gradient: FloatArray,
) -> None:
    """Subtracts from `reduced` ``[9c, 9c]`` and `gradient` ``[9c]`` what the points account for (Schur complement).

    The observations of point n are ``first[n]`` to ``first[n + 1]``, each of another image, in the order of the images.
    """
    inverse = np.empty((3, 3))
    carried = np.empty((PARAMETERS, 3))
    for n in range(len(point_blocks)):
        invert_3x3(point_blocks[n], damping, inverse)
        for k in range(first[n], first[n + 1]):
            own = coupling[k]
            one = PARAMETERS * observed_image[k]
            for i in range(PARAMETERS):
                a, b, c = own[i, 0], own[i, 1], own[i, 2]
                for j in range(3):
                    carried[i, j] = a * inverse[0, j] + b * inverse[1, j] + c * inverse[2, j]
                gradient[one + i] -= (
                    carried[i, 0] * point_gradients[n, 0]
                    + carried[i, 1] * point_gradients[n, 1]
                    + carried[i, 2] * point_gradients[n, 2]
                )
                for j in range(i + 1):
                    reduced[one + j, one + i] -= carried[j, 0] * a + carried[j, 1] * b + carried[j, 2] * c
            for other in range(k + 1, first[n + 1]):
                two = PARAMETERS * observed_image[other]
                there = coupling[other]
                for i in range(PARAMETERS):
                    a, b, c = carried[i, 0], carried[i, 1], carried[i, 2]
                    line = reduced[one + i]
                    for j in range(PARAMETERS):
                        line[two + j] -= a * there[j, 0] + b * there[j, 1] + c * there[j, 2]
    for i in range(len(reduced)):
        for j in range(i):
            reduced[i, j] = reduced[j, i]


@kernel
def move_images(poses: FloatArray, step: FloatArray) -> FloatArray:
    """Poses ``[c, 4, 4]`` after the steps ``[c, 9]``: turned by the exponential of ``step[3:6]``, then shifted."""
    moved = np.zeros_like(poses)
    turn = np.empty((3, 3))
    for c in range(len(poses)):
        x, y, z = step[c, 3], step[c, 4], step[c, 5]
        square = x * x + y * y + z * z
        angle = np.sqrt(square)
        sine = np.sin(angle) / angle if angle > 1e-8 else 1.0
        half = (1.0 - np.cos(angle)) / square if angle > 1e-4 else 0.5 - square / 24
        turn[0, 0], turn[1, 1] = 1 - half * (y * y + z * z), 1 - half * (x * x + z * z)
        turn[2, 2] = 1 - half * (x * x + y * y)
        turn[0, 1], turn[1, 0] = half * x * y - sine * z, half * x * y + sine * z
        turn[0, 2], turn[2, 0] = half * x * z + sine * y, half * x * z - sine * y
        turn[1, 2], turn[2, 1] = half * y * z - sine * x, half * y * z + sine * x
        for i in range(3):
            for j in range(4):
                moved[c, i, j] = turn[i, 0] * poses[c, 0, j] + turn[i, 1] * poses[c, 1, j] + turn[i, 2] * poses[c, 2, j]
            moved[c, i, 3] += step[c, i]
        moved[c, 3, 3] = 1.0
    return moved


@kernel
def pulls_of_groups(
    own_gradients: FloatArray,
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    first: IntArray,
    observed_image: IntArray,
    group: IntArray,
    pulls: FloatArray,
) -> None:
    """Adds to `pulls` ``[groups, 9c]`` what the points, eliminated, add to the gradient; point n to ``group[n]``."""
    inverse = np.empty((3, 3))
    for n in range(len(point_blocks)):
        invert_3x3(point_blocks[n], 0.0, inverse)
        for k in range(first[n], first[n + 1]):
            one = PARAMETERS * observed_image[k]
            for i in range(PARAMETERS):
                total = own_gradients[k, i]
                for j in range(3):
                    for r in range(3):
                        total -= coupling[k, i, r] * inverse[r, j] * point_gradients[n, j]
                pulls[group[n], one + i] += total


@kernel
def move_points(
    points: FloatArray,
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    first: IntArray,
    observed_image: IntArray,
    damping: float,
    step: FloatArray,
) -> FloatArray:
    """The points ``[m, 3]`` after the step that goes with `step` ``[c, 9]`` of the images."""
    moved = points.copy()
    inverse = np.empty((3, 3))
    rest = np.empty(3)
    for n in range(len(points)):
        invert_3x3(point_blocks[n], damping, inverse)
        for j in range(3):
            rest[j] = point_gradients[n, j]
        for k in range(first[n], first[n + 1]):
            c = observed_image[k]
            for i in range(PARAMETERS):
                for j in range(3):
                    rest[j] += coupling[k, i, j] * step[c, i]
        for i in range(3):
            moved[n, i] -= inverse[i, 0] * rest[0] + inverse[i, 1] * rest[1] + inverse[i, 2] * rest[2]
    return moved
