"""Alignment of small patches to a fraction of a pixel, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

RADIUS = 5  # samples on each side of the centre
SIDE = 2 * RADIUS + 1
RIM = SIDE + 2  # with what the gradients of the outermost need
ROUNDS = 8
FAR = 3.0  # pixels: what moves further has found something else
STILL = 0.02  # pixels: below, the next round would change nothing
LEAST_CONTRAST = 4.0  # variance of the patch, in grey values squared
LEAST_GRADIENT = 1.0  # determinant of the mean gradients' outer product: less is an edge, or nothing


@kernel(fastmath=True)
def _sample(image: Any, x: float, y: float) -> float:
    """Bilinear; the caller keeps (x, y) inside."""
    left, top = int(x), int(y)
    a, b = np.float32(x - left), np.float32(y - top)
    upper, lower = image[top], image[top + 1]
    first = upper[left] + a * (np.float32(upper[left + 1]) - upper[left])
    second = lower[left] + a * (np.float32(lower[left + 1]) - lower[left])
    value: float = first + b * (second - first)
    return value


@kernel
def _inside(image: Any, x: float, y: float, reach: float) -> bool:
    return x - reach >= 0 and y - reach >= 0 and x + reach < image.shape[1] - 1 and y + reach < image.shape[0] - 1


# inlined: a process that compiles this would else run another copy of it, with other last bits, than one that loads it
@kernel(fastmath=True, forceinline=True)
def _linear_basis(template: Any, x: float, y: float, step: float, warp: Any, grid: Any, basis: Any) -> None:
    """Fills `basis` ``[4, n]``: the patch's change as it moves by a pixel of the other image in x, y; itself; one."""
    a, b, c, d = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    for v in range(RIM):
        for u in range(RIM):
            grid[v, u] = _sample(template, x + step * (u - RADIUS - 1), y + step * (v - RADIUS - 1))
    scale = -0.5 / (step * (a * d - b * c))
    k = 0
    for v in range(1, RIM - 1):
        for u in range(1, RIM - 1):
            gx, gy = (grid[v, u + 1] - grid[v, u - 1]) * scale, (grid[v + 1, u] - grid[v - 1, u]) * scale
            basis[0, k], basis[1, k] = gx * d - gy * c, gy * a - gx * b
            basis[2, k], basis[3, k] = grid[v, u], 1.0
            k += 1


@kernel(fastmath=True)
def _products(basis: Any, seen: Any, out: Any) -> None:
    for i in range(4):
        total = 0.0
        for k in range(seen.size):
            total += basis[i, k] * seen[k]
        out[i] = total


@kernel
def _invert_4x4(matrix: Any, work: Any, inverse: Any) -> bool:
    """Fills `inverse` by elimination without pivots, which a positive definite matrix allows; False where it is not."""
    for i in range(4):
        for j in range(4):
            work[i, j] = matrix[i, j]
            inverse[i, j] = 1.0 if i == j else 0.0
    for i in range(4):
        if not work[i, i] > 1e-12 * matrix[i, i]:
            return False
        scale = 1.0 / work[i, i]
        for j in range(4):
            work[i, j] *= scale
            inverse[i, j] *= scale
        for k in range(4):
            factor = work[k, i]
            if k != i:
                for j in range(4):
                    work[k, j] -= factor * work[i, j]
                    inverse[k, j] -= factor * inverse[i, j]
    return True


@kernel(fastmath=True)
def align_patches(
    template: Any, image: Any, at: Any, warp: Any, step: Any, guess: Any, found: Any, likeness: Any
) -> None:
    """Where `image` shows the patches of `template` around `at` ``[n, 2]``, from `guess` ``[n, 2]`` on, into `found`.

    Both images are uint8. `warp` ``[n, 2, 2]`` maps offsets in the template to offsets in the image; samples are `step`
    ``[n]`` template pixels apart. `likeness` is the correlation of the two patches, -1 where there is no answer.

    Gain and offset of the brightness are free. The gradients are the template's, so the equations are linear and the
    same in every round (inverse compositional alignment: Baker and Matthews, Lucas-Kanade 20 years on, IJCV 2004).
    """
    count = SIDE * SIDE
    grid = np.empty((RIM, RIM))
    basis, seen = np.empty((4, count)), np.empty(count)
    normal, work, inverse = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    right = np.empty(4)
    for n in range(len(at)):
        likeness[n] = -1.0
        s, m = step[n], warp[n]
        det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        reach = s * RADIUS * max(abs(m[0, 0]) + abs(m[0, 1]), abs(m[1, 0]) + abs(m[1, 1]))
        if not (0.1 < det < 10.0) or not _inside(template, at[n, 0], at[n, 1], s * (RADIUS + 1)):
            continue
        _linear_basis(template, at[n, 0], at[n, 1], s, m, grid, basis)
        for i in range(4):
            _products(basis, basis[i], normal[i])
        contrast = normal[2, 2] - normal[2, 3] * normal[2, 3] / count
        shape = normal[0, 0] * normal[1, 1] - normal[0, 1] * normal[0, 1]
        if contrast < LEAST_CONTRAST * count or shape < LEAST_GRADIENT * count * count:
            continue
        if not _invert_4x4(normal, work, inverse):
            continue
        x, y, moved = guess[n, 0], guess[n, 1], FAR
        for _ in range(ROUNDS):
            if not _inside(image, x, y, reach) or (x - guess[n, 0]) ** 2 + (y - guess[n, 1]) ** 2 > FAR * FAR:
                moved = FAR
                break
            k = 0
            for v in range(-RADIUS, RADIUS + 1):
                for u in range(-RADIUS, RADIUS + 1):
                    seen[k] = _sample(image, x + s * (m[0, 0] * u + m[0, 1] * v), y + s * (m[1, 0] * u + m[1, 1] * v))
                    k += 1
            _products(basis, seen, right)
            gain = 0.0
            dx = dy = 0.0
            for i in range(4):
                gain += inverse[2, i] * right[i]
                dx += inverse[0, i] * right[i]
                dy += inverse[1, i] * right[i]
            if not (0.2 < gain < 5.0):
                moved = FAR
                break
            dx, dy = dx / gain, dy / gain
            x, y, moved = x + dx, y + dy, abs(dx) + abs(dy)
            if moved < STILL:
                break
        if moved > 5 * STILL:
            continue
        variance = (seen * seen).sum() - right[3] * right[3] / count
        shared = right[2] - right[3] * normal[2, 3] / count
        likeness[n] = shared / np.sqrt(max(variance * contrast, 1e-9))
        found[n, 0], found[n, 1] = x, y
