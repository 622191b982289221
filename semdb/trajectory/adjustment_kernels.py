"""The Schur complement of many images, block by block, compiled."""

from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.localization.bundle_kernels import FAST, PARAMETERS, invert_3x3
from semdb.types import BoolArray, FloatArray, IntArray


@kernel
def mark_shared(first: IntArray, observed_image: IntArray, shared: BoolArray) -> None:
    """Marks which images ``[c, c]`` see a point in common; the lesser comes first."""
    for n in range(len(first) - 1):
        for k in range(first[n], first[n + 1]):
            for other in range(k + 1, first[n + 1]):
                shared[observed_image[k], observed_image[other]] = True


@kernel(fastmath=FAST)
def reduce_to_blocks(
    coupling: FloatArray,
    point_blocks: FloatArray,
    point_gradients: FloatArray,
    first: IntArray,
    observed_image: IntArray,
    damping: float,
    place: IntArray,
    blocks: FloatArray,
    gradient: FloatArray,
) -> None:
    """Subtracts from `blocks` ``[b, 9, 9]`` and `gradient` ``[c, 9]`` what the points account for.

    ``place[i, j]``, i <= j, is which block ties images i and j. The observations of point n are ``first[n]`` to
    ``first[n + 1]``, each of another image, in the order of the images.
    """
    inverse = np.empty((3, 3))
    carried = np.empty((PARAMETERS, 3))
    for n in range(len(point_blocks)):
        invert_3x3(point_blocks[n], damping, inverse)
        for k in range(first[n], first[n + 1]):
            one = observed_image[k]
            own = coupling[k]
            for i in range(PARAMETERS):
                a, b, c = own[i, 0], own[i, 1], own[i, 2]
                for j in range(3):
                    carried[i, j] = a * inverse[0, j] + b * inverse[1, j] + c * inverse[2, j]
                gradient[one, i] -= (
                    carried[i, 0] * point_gradients[n, 0]
                    + carried[i, 1] * point_gradients[n, 1]
                    + carried[i, 2] * point_gradients[n, 2]
                )
            for other in range(k, first[n + 1]):
                target = blocks[place[one, observed_image[other]]]
                there = coupling[other]
                for i in range(PARAMETERS):
                    a, b, c = carried[i, 0], carried[i, 1], carried[i, 2]
                    for j in range(PARAMETERS):
                        target[i, j] -= a * there[j, 0] + b * there[j, 1] + c * there[j, 2]


@kernel(fastmath=FAST)
def solve_positive(matrix: FloatArray, right: FloatArray) -> bool:
    """Solves a symmetric positive `matrix` ``[9c, 9c]``, whose upper half is read and lost, for `right`, in place.

    False where it is not positive. As LAPACK's, but the same to the last bit whatever number of threads LAPACK takes.
    """
    size = len(matrix)
    for start in range(0, size, PARAMETERS):
        end = start + PARAMETERS
        for k in range(start, end):
            for m in range(start, k):
                factor = matrix[m, k]
                for j in range(k, size):
                    matrix[k, j] -= factor * matrix[m, j]
            if not matrix[k, k] > 0.0:
                return False
            scale = 1.0 / np.sqrt(matrix[k, k])
            for j in range(k, size):
                matrix[k, j] *= scale
        p0, p1, p2 = matrix[start], matrix[start + 1], matrix[start + 2]
        p3, p4, p5 = matrix[start + 3], matrix[start + 4], matrix[start + 5]
        p6, p7, p8 = matrix[start + 6], matrix[start + 7], matrix[start + 8]
        for i in range(end, size):
            a0, a1, a2, a3, a4, a5, a6, a7, a8 = p0[i], p1[i], p2[i], p3[i], p4[i], p5[i], p6[i], p7[i], p8[i]
            row = matrix[i]
            for j in range(i, size):
                row[j] -= (
                    a0 * p0[j] + a1 * p1[j] + a2 * p2[j]
                    + a3 * p3[j] + a4 * p4[j] + a5 * p5[j]
                    + a6 * p6[j] + a7 * p7[j] + a8 * p8[j]
                )  # fmt: skip
    for k in range(size):
        right[k] /= matrix[k, k]
        for j in range(k + 1, size):
            right[j] -= matrix[k, j] * right[k]
    for k in range(size - 1, -1, -1):
        rest = right[k]
        for j in range(k + 1, size):
            rest -= matrix[k, j] * right[j]
        right[k] = rest / matrix[k, k]
    return True
