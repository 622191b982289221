"""Is a covariance true? Errors over what it says of them, position and rotation apart.

The error of a pose is (position in the world, rotation vector in the world), as its covariance is:
`geometry.pose_offset`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from semdb.types import FloatArray

POSITION, ROTATION = slice(0, 3), slice(3, 6)
DIMENSIONS = 3


@dataclass(frozen=True, slots=True)
class Nees:
    """Normalised errors squared of many answers: medians (2.4 where covariances are true), and the shares inside the
    ellipsoids that should hold 50 % and 95 % of the truths, the lesser of position and rotation.
    """

    position: float
    rotation: float
    inside_50: float
    inside_95: float


def normalised_error(offset: FloatArray, covariance: FloatArray, part: slice) -> float:
    """Error squared over its variance of a `part` of `offset` ``[6]``: chi-square distributed where all is true."""
    return float(offset[part] @ np.linalg.pinv(covariance[part, part], hermitian=True) @ offset[part])


def nees_figures(errors: Sequence[tuple[float, float]]) -> Nees | None:
    """Of the normalised errors (position, rotation) of answers; None without any."""
    if not errors:
        return None
    found = np.array(errors, np.float64)
    inside = {level: (found <= chi2.ppf(level, DIMENSIONS)).mean(axis=0).min() for level in (0.50, 0.95)}
    position, rotation = np.median(found, axis=0)
    return Nees(float(position), float(rotation), float(inside[0.50]), float(inside[0.95]))


def held_shares(errors: Sequence[tuple[float, float]], levels: FloatArray) -> FloatArray:
    """Shares ``[levels, 2]`` of position and rotation inside the ellipsoids that should hold each of `levels`."""
    found = np.array(errors, np.float64).reshape(-1, 2)
    bounds = chi2.ppf(levels, DIMENSIONS)
    shares: FloatArray = (found[None] <= bounds[:, None, None]).mean(axis=1)
    return shares
