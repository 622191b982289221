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
