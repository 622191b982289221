"""Noise of a depth sensor, compiled: for other kernels, which cannot call `semdb.geometry.sensor`."""

from __future__ import annotations

from semdb.compiled import kernel


@kernel
def depth_sigma(depth: float) -> float:
    """Standard deviation in metres of a structured-light depth of `depth` metres.

    The axial noise that Nguyen, Izadi and Lovell measured (3DIMPVT 2012): 0.0012 + 0.0019 (z - 0.4)^2.
    """
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2
