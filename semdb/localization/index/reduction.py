"""Vectors made small for a fast scan: principal components as 8-bit codes. What it finds is ranked again exactly.

The inner product with a query q is ``q.mean + sum_j (axes_j . q) z_j`` plus what lies outside of the axes, with ``z =
axes (x - mean)``. The first term is the same for all keyframes. A code is ``z_j / scale_j`` rounded to -127..127; the
scales are multiplied into the query, which stays in floating point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.localization.index.kernels import CodeArray
from semdb.types import Float32Array

SAMPLE = 4096  # vectors that the components are found from
ROUNDS = 2  # of the subspace iteration
EXTRA = 16  # components more than asked for while iterating
LARGEST = 127


@dataclass(frozen=True, slots=True, eq=False)
class Reduction:
    """A basis of principal components and the steps of their codes."""

    mean: Float32Array  # [d]
    axes: Float32Array  # [components, d], orthonormal rows
    scales: Float32Array  # [components]
    fitted_on: int  # how many vectors there were

    def encode(self, vectors: Float32Array) -> CodeArray:
        """Codes int8 ``[n, components]`` of vectors ``[n, d]``."""
        codes = vectors @ self.axes.T
        codes -= self.axes @ self.mean
        codes /= self.scales
        return np.clip(np.rint(codes, out=codes), -LARGEST, LARGEST, out=codes).astype(np.int8)

    def query(self, vector: Float32Array) -> tuple[Float32Array, float]:
        """What codes are multiplied with ``[components]``, and what is added: an estimate of the inner product."""
        return (self.axes @ vector) * self.scales, float(self.mean @ vector)


def sample_rows(count: int, size: int = SAMPLE) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Evenly spaced rows of `count`, at most `size`."""
    return np.unique(np.linspace(0, max(0, count - 1), min(count, size)).astype(np.int64))


def fit_reduction(sample: Float32Array, components: int, fitted_on: int) -> Reduction:
    """The first principal components of `sample` ``[n, d]`` (at most n and d of them), the same for the same sample.

    Randomised subspace iteration from a fixed seed (Halko, Martinsson and Tropp, SIAM Review 2011, algorithm 4.4).
    """
    mean = sample.mean(axis=0, dtype=np.float64).astype(np.float32)
    centred = sample - mean
    count = max(1, min(components, *sample.shape))
    wide = min(count + EXTRA, *sample.shape)
    basis = np.random.default_rng(0).normal(size=(sample.shape[1], wide)).astype(np.float32)
    for _ in range(ROUNDS):
        basis = np.linalg.qr(centred.T @ (centred @ basis))[0]
    projected = centred @ basis
    values, rotation = np.linalg.eigh((projected.T @ projected).astype(np.float64))
    order = np.argsort(values)[::-1][:count]
    axes = np.ascontiguousarray((basis @ rotation[:, order].astype(np.float32)).T, np.float32)
    spread = np.quantile(np.abs(centred @ axes.T), 0.9995, axis=0)
    scales = np.maximum(spread / LARGEST, 1e-9).astype(np.float32)
    return Reduction(mean, axes, scales, fitted_on)
