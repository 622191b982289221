"""How much patches of one image look like those of another nearby, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel
from semdb.localization.alignment_kernels import LEAST_CONTRAST, RADIUS, SIDE, _inside, _sample

OUTSIDE = -2.0  # the patch, or where it should be, is not in the image
PLAIN = -3.0  # the patch shows nothing
REACH = 3  # pixels


@kernel(fastmath=True)
def _patch(image: Any, x: float, y: float, step: float, warp: Any, out: Any) -> float:
    """Fills `out` ``[n]`` with the samples about (x, y), their mean taken off; returns the sum of their squares."""
    k, total = 0, 0.0
    for v in range(-RADIUS, RADIUS + 1):
        for u in range(-RADIUS, RADIUS + 1):
            value = _sample(
                image, x + step * (warp[0, 0] * u + warp[0, 1] * v), y + step * (warp[1, 0] * u + warp[1, 1] * v)
            )
            out[k] = value
            total += value
            k += 1
    mean, squares = total / k, 0.0
    for i in range(k):
        out[i] -= mean
        squares += out[i] * out[i]
    return squares


@kernel(fastmath=True)
def compare_patches(
    template: Any, image: Any, at: Any, warp: Any, step: Any, guess: Any, likeness: Any, roughness: Any
) -> None:
    """Fills `likeness` ``[n]``: how the patch of `template` about `at` ``[n, 2]`` correlates with that of `image` about
    `guess` ``[n, 2]``, or up to `REACH` pixels beside it, where it is best; or `OUTSIDE`, or `PLAIN`.

    Both images are uint8. `warp` ``[n, 2, 2]`` maps offsets in the template to offsets in the image; samples are `step`
    ``[n]`` template pixels apart. `roughness` ``[n, 2]`` are the mean squared differences between neighbouring samples,
    of the template and of the image at the guess: how sharp each is.
    """
    count = SIDE * SIDE
    own, seen, straight = np.empty(count, np.float32), np.empty(count, np.float32), np.eye(2)
    for n in range(len(at)):
        s, m = step[n], warp[n]
        likeness[n] = OUTSIDE
        wide = s * RADIUS * max(abs(m[0, 0]) + abs(m[0, 1]), abs(m[1, 0]) + abs(m[1, 1]))
        det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        if not (0.1 < det < 10.0) or not _inside(template, at[n, 0], at[n, 1], s * RADIUS):
            continue
        if not _inside(image, guess[n, 0], guess[n, 1], wide + REACH):
            continue
        energy = _patch(template, at[n, 0], at[n, 1], s, straight, own)
        likeness[n] = PLAIN
        if energy < LEAST_CONTRAST * count:
            continue
        roughness[n, 0] = _roughness_of(own)
        _patch(image, guess[n, 0], guess[n, 1], s, m, seen)
        roughness[n, 1] = _roughness_of(seen)
        best, x, y = -1.0, guess[n, 0], guess[n, 1]
        for around in (2, 1):  # coarse to fine
            middle_x, middle_y = x, y
            for v in range(-1, 2):
                for u in range(-1, 2):
                    if around == 1 and u == 0 and v == 0:
                        continue
                    other = _patch(image, middle_x + around * u, middle_y + around * v, s, m, seen)
                    shared = 0.0
                    for k in range(count):
                        shared += own[k] * seen[k]
                    likeness_here = shared / np.sqrt(max(energy * other, 1e-6))
                    if likeness_here > best:
                        best, x, y = likeness_here, middle_x + around * u, middle_y + around * v
        likeness[n] = best


@kernel(fastmath=True)
def _roughness_of(patch: Any) -> float:
    """Mean squared difference between neighbours of a patch of SIDE x SIDE samples."""
    total = 0.0
    for v in range(SIDE):
        for u in range(SIDE - 1):
            total += (patch[v * SIDE + u + 1] - patch[v * SIDE + u]) ** 2
            total += (patch[(u + 1) * SIDE + v] - patch[u * SIDE + v]) ** 2
    mean: float = total / (2 * SIDE * (SIDE - 1))
    return mean
