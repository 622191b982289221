"""Normal equations of the bundle adjustment and their solution, compiled.

Layouts: an image has nine unknowns: translation, rotation (both a left perturbation of ``camera_from_world``) and its
rotation while it was read out. An observation is (x, y) normalised, its sigma, a depth in metres (NaN where there is
none), the row it was seen in, -0.5 at the top of the image to 0.5 at the bottom, and what the noise of the depth is
multiplied by. Observations are sorted by point.
"""

from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.types import FloatArray, IntArray

PARAMETERS = 9  # of an image


@kernel
def depth_sigma(depth: float) -> float:
    """Standard deviation in metres of a structured-light depth of `depth` metres.

    The axial noise that Nguyen, Izadi and Lovell measured (3DIMPVT 2012): 0.0012 + 0.0019 (z - 0.4)^2.
    """
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


@kernel
def _observe(
    x: float,
    y: float,
    z: float,
    u: float,
    v: float,
    sigma: float,
    depth: float,
    looser: float,
    cauchy: float,
    out: FloatArray,
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
        spread = depth_sigma(depth) * looser
        rz = (z - depth) / spread
        depth_weight = 1.0 / np.sqrt(1.0 + rz * rz / cauchy)
        out[0, 2] = rz * depth_weight
        out[3, 2] = depth_weight / spread
        cost += cauchy * np.log1p(rz * rz / cauchy)
    return cost


@kernel
def _in_camera(
    point: FloatArray, rotation: FloatArray, translation: FloatArray, turn: FloatArray, row: float, out: FloatArray
) -> None:
    """The point in the camera (out[0]) and as seen in `row` (out[1]): turned by ``turn * row``, to first order."""
    for i in range(3):
        out[0, i] = rotation[i, 0] * point[0] + rotation[i, 1] * point[1] + rotation[i, 2] * point[2] + translation[i]
    x, y, z = out[0, 0], out[0, 1], out[0, 2]
    out[1, 0] = x + row * (turn[1] * z - turn[2] * y)
    out[1, 1] = y + row * (turn[2] * x - turn[0] * z)
    out[1, 2] = z + row * (turn[0] * y - turn[1] * x)


@kernel
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
    image_blocks[:] = 0.0
    image_gradients[:] = 0.0
    point_blocks[:] = 0.0
    point_gradients[:] = 0.0
    out = np.empty((5, 3))
    local = np.empty((2, 3))
    by_point = np.empty((3, 3))
    by_image = np.empty((3, PARAMETERS))
    cost = 0.0
    for k in range(len(observed)):
        n, c = observed_point[k], observed_image[k]
        row = observed[k, 4]
        pose, w = rotation[c], turn[c]
        _in_camera(points[n], pose, translation[c], w, row, local)
        x, y, z = local[0, 0], local[0, 1], local[0, 2]
        cost += _observe(
            local[1, 0], local[1, 1], local[1, 2],
            observed[k, 0], observed[k, 1], observed[k, 2], observed[k, 3], observed[k, 5], cauchy, out,
        )  # fmt: skip
        chi2[k] = out[4, 0]
        for r in range(3):
            p, q, s = out[r + 1, 0], out[r + 1, 1], out[r + 1, 2]
            # through the turn of the readout, I + row [w]x, then through the pose
            a = p + row * (q * w[2] - s * w[1])
            b = q + row * (s * w[0] - p * w[2])
            d = s + row * (p * w[1] - q * w[0])
            by_image[r, 0], by_image[r, 1], by_image[r, 2] = a, b, d
            # the point turns with the camera by w x p, so row (a, b, d) becomes p x (a, b, d)
            by_image[r, 3], by_image[r, 4], by_image[r, 5] = y * d - z * b, z * a - x * d, x * b - y * a
            by_image[r, 6], by_image[r, 7], by_image[r, 8] = (
                row * (y * s - z * q), row * (z * p - x * s), row * (x * q - y * p),
            )  # fmt: skip
            for j in range(3):
                by_point[r, j] = a * pose[0, j] + b * pose[1, j] + d * pose[2, j]
        _add(by_image, by_point, out, image_blocks[c], image_gradients[c], coupling[k], own_gradients[k])
        _add_point(by_point, out, point_blocks[n], point_gradients[n])
    for c in range(len(image_blocks)):
        for i in range(PARAMETERS):
            for j in range(i):
                image_blocks[c, i, j] = image_blocks[c, j, i]
    return cost


@kernel
def _add(
    by_image: FloatArray,
    by_point: FloatArray,
    out: FloatArray,
    block: FloatArray,
    gradient: FloatArray,
    coupling: FloatArray,
    own: FloatArray,
) -> None:
    """Adds one observation to its image (upper triangle of `block`), and fills what couples image and point."""
    for i in range(PARAMETERS):
        a, b, c = by_image[0, i], by_image[1, i], by_image[2, i]
        own[i] = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
        gradient[i] += own[i]
        for j in range(i, PARAMETERS):
            block[i, j] += a * by_image[0, j] + b * by_image[1, j] + c * by_image[2, j]
        for j in range(3):
            coupling[i, j] = a * by_point[0, j] + b * by_point[1, j] + c * by_point[2, j]


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

    The observations of point n are ``first[n]`` to ``first[n + 1]``.
    """
    inverse = np.empty((3, 3))
    carried = np.empty((PARAMETERS, 3))
    for n in range(len(point_blocks)):
        invert_3x3(point_blocks[n], damping, inverse)
        for k in range(first[n], first[n + 1]):
            one = PARAMETERS * observed_image[k]
            for i in range(PARAMETERS):
                a, b, c = coupling[k, i, 0], coupling[k, i, 1], coupling[k, i, 2]
                total = 0.0
                for j in range(3):
                    carried[i, j] = a * inverse[0, j] + b * inverse[1, j] + c * inverse[2, j]
                    total += carried[i, j] * point_gradients[n, j]
                gradient[one + i] -= total
            for other in range(first[n], first[n + 1]):
                two = PARAMETERS * observed_image[other]
                for i in range(PARAMETERS):
                    a, b, c = carried[i, 0], carried[i, 1], carried[i, 2]
                    for j in range(PARAMETERS):
                        reduced[one + i, two + j] -= (
                            a * coupling[other, j, 0] + b * coupling[other, j, 1] + c * coupling[other, j, 2]
                        )


@kernel
def scatter_of_points(
    own_gradients: FloatArray,
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    first: IntArray,
    observed_image: IntArray,
    scatter: FloatArray,
) -> None:
    """Adds to `scatter` ``[9c, 9c]`` the outer products of what each point, eliminated, adds to the gradient."""
    inverse = np.empty((3, 3))
    for n in range(len(point_blocks)):
        invert_3x3(point_blocks[n], 0.0, inverse)
        count = first[n + 1] - first[n]
        pulls = np.empty((count, PARAMETERS))
        for k in range(first[n], first[n + 1]):
            for i in range(PARAMETERS):
                total = own_gradients[k, i]
                for j in range(3):
                    for r in range(3):
                        total -= coupling[k, i, r] * inverse[r, j] * point_gradients[n, j]
                pulls[k - first[n], i] = total
        for one in range(count):
            for two in range(count):
                row, column = PARAMETERS * observed_image[first[n] + one], PARAMETERS * observed_image[first[n] + two]
                for i in range(PARAMETERS):
                    for j in range(PARAMETERS):
                        scatter[row + i, column + j] += pulls[one, i] * pulls[two, j]


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
