"""What depth sensors measure how well."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.types import FloatArray

AT_LEAST_M, GROWTH_PER_M, NEAREST_M = 0.0012, 0.0019, 0.4


def depth_noise(depth: npt.ArrayLike) -> FloatArray:
    """Standard deviation in metres ``[n]`` of structured-light depths ``[n]`` in metres.

    The axial noise that Nguyen, Izadi and Lovell measured (3DIMPVT 2012): 0.0012 + 0.0019 (z - 0.4)^2.
    """
    z = np.asarray(depth, np.float64)
    noise: FloatArray = AT_LEAST_M + GROWTH_PER_M * (z - NEAREST_M) ** 2
    return noise
