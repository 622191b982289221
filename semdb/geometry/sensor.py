"""What depth sensors measure how well."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.types import FloatArray


def depth_noise(depth: npt.NDArray[np.floating]) -> FloatArray:
    """Standard deviation in metres ``[n]`` of measured depths ``[n]`` in metres (`sensor_kernels.depth_sigma`)."""
    from semdb.geometry.sensor_kernels import depth_sigma  # numba takes half a second to import

    return np.asarray(depth_sigma(depth), np.float64)  # type: ignore[arg-type]  # compiled: takes arrays too
