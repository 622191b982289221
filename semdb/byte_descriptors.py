"""Descriptors of float as signed bytes: a quarter of the room, and products of integers.

Each number of a unit vector is stored as the nearest multiple of 1/172. The scale is one for all maps, so that bytes of
any two can be compared: it is the largest at which the dot product of any two rows of up to 256 numbers fits 16 bits
after rounding ((1.004 * 172 + 8)^2 < 2^15), and numbers up to 0.738 are kept as they are.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.types import Float32Array

SCALE = 172
WIDEST = 256  # numbers of a descriptor
MOST_OF_UNIT = 1.004  # the longest descriptor that is taken for a unit vector

Int8Array = npt.NDArray[np.int8]


def to_bytes(descriptors: npt.NDArray[np.generic]) -> Int8Array | None:
    """Float descriptors ``[n, d]`` as int8; None where they are wider than 256 or longer than unit vectors."""
    values = np.asarray(descriptors, np.float32)
    if values.ndim != 2 or values.shape[1] > WIDEST:
        return None
    if not (np.einsum("ij,ij->i", values, values) <= MOST_OF_UNIT**2).all():
        return None
    return np.asarray(np.clip(np.rint(values * np.float32(SCALE)), -127, 127), np.int8)


def from_bytes(descriptors: Int8Array) -> Float32Array:
    """Float descriptors ``[n, d]`` of those that `to_bytes` gave."""
    return np.asarray(descriptors, np.float32) / np.float32(SCALE)


def as_float(descriptors: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """Descriptors of bytes as float; others as they are."""
    return from_bytes(np.asarray(descriptors, np.int8)) if descriptors.dtype == np.int8 else descriptors


def are_bytes(descriptors: Int8Array) -> bool:
    """Whether rows ``[n, d]`` are such as `to_bytes` gives: products of others would not fit 16 bits."""
    if descriptors.ndim != 2 or descriptors.shape[1] > WIDEST:
        return False
    values = descriptors.astype(np.float32)
    return bool((np.einsum("ij,ij->i", values, values) < 2**15).all())
