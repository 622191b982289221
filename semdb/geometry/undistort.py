"""Undoing a lens' distortion, compiled; called by `semdb.geometry.pixels_to_normalized`."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np

from semdb.compiled import kernel


@kernel
def undistort(coefficients, targets, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes to `out` the points ``[n, 2]`` that OpenCV's model distorts to `targets` ``[n, 2]``, both normalised.

    `coefficients` are k1, k2, p1, p2, k3. Newton's method from the target; NaN where it does not arrive.
    """
    k1, k2, p1, p2, k3 = coefficients
    for row in range(len(targets)):
        tx, ty = targets[row, 0], targets[row, 1]
        x, y = tx, ty
        error = np.inf
        for _ in range(21):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - tx
            ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - ty
            error = np.hypot(ex, ey)
            if not error >= 1e-12:
                break
            slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d radial / d x = slope * x
            dxx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            dxy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            dyy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            determinant = dxx * dyy - dxy * dxy
            x -= (dyy * ex - dxy * ey) / determinant
            y -= (dxx * ey - dxy * ex) / determinant
        arrived = error < 1e-6
        out[row, 0] = x if arrived else np.nan
        out[row, 1] = y if arrived else np.nan
