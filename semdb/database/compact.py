"""Keypoints in 16 bytes each instead of 36, for maps that are to be small: what is stored beside float16 descriptors.

Layout: an array blob (`semdb.database.codecs`) of uint16 with the magic ``SDBK``. First 13 float32: offset and step of
x, y, size, X, Y and Z, and the unit of the responses. Then eight columns with a number for each keypoint: x, y and size
in steps from the offset; the angle in 1/16384 of a turn, times four, plus the sign of the Laplacian plus one; the
response as float16 in its unit; X, Y and Z in steps, 65535 for a keypoint without depth.

A step is 1/65534 of what the values of a keyframe span: for 640 pixels at most 0.005 pixels are lost, for 6 m 0.05 mm.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.types import Float32Array

COLUMNS = 8
STEPS = 65534
NO_POINT = 65535
_LINEAR = (0, 1, 2, 6, 7, 8)  # columns of the float32 rows that are stored in steps
_TURN = 1 << 14
_SCALES = 2 * (2 * len(_LINEAR) + 1)  # uint16 that the scales take

UInt16Array = npt.NDArray[np.uint16]


def compact(packed: Float32Array) -> UInt16Array | None:
    """Rows of keypoints float32 ``[n, 9]`` (`codecs.KEYPOINT_COLUMNS`) as uint16 ``[26 + 8 n]``.

    None where they do not fit: an angle outside of [0, 360], a Laplacian other than -1, 0 and 1, a value that is not
    finite (but points, where all three are NaN), a negative response.
    """
    known = np.isfinite(packed[:, 6:]).all(axis=1)
    fits = (
        np.isfinite(packed[:, :6]).all()
        and np.isnan(packed[~known, 6:]).all()
        and ((packed[:, 3] >= 0) & (packed[:, 3] <= 360)).all()
        and np.isin(packed[:, 5], (-1, 0, 1)).all()
        and (packed[:, 4] >= 0).all()
    )
    if not fits:
        return None
    columns = np.zeros((COLUMNS, len(packed)), dtype="<u2")
    scales = np.zeros(2 * len(_LINEAR) + 1, dtype="<f4")
    for number, column in enumerate(_LINEAR):
        target = columns[number if column < 3 else number + 2]
        rows = known if column >= 6 else np.ones(len(packed), dtype=np.bool_)
        target[~rows] = NO_POINT
        values = packed[rows, column]
        if not len(values):
            continue
        offset, step = values.min(), np.float32((np.float64(values.max()) - values.min()) / STEPS)
        scales[2 * number : 2 * number + 2] = offset, step
        steps = np.zeros(len(values)) if step == 0 else np.rint((values.astype(np.float64) - offset) / step)
        target[rows] = np.minimum(steps, STEPS)
    angle = np.rint(packed[:, 3].astype(np.float64) * (_TURN / 360)).astype(np.int64) % _TURN
    columns[3] = 4 * angle + packed[:, 5].astype(np.int64) + 1
    unit = packed[:, 4].max(initial=0)
    scales[-1] = unit
    if unit > 0:
        columns[4] = (packed[:, 4] / unit).astype("<f2").view("<u2")
    return np.concatenate([scales.view("<u2"), columns.ravel()])


def expand(numbers: UInt16Array) -> Float32Array | None:
    """Rows float32 ``[n, 9]`` of what `compact` gave; None for an array that is none of its."""
    if numbers.ndim != 1 or numbers.dtype != np.dtype("<u2") or len(numbers) < _SCALES:
        return None
    if (len(numbers) - _SCALES) % COLUMNS:
        return None
    scales = numbers[:_SCALES].view("<f4")
    columns = numbers[_SCALES:].reshape(COLUMNS, -1)
    packed = np.empty((columns.shape[1], 9), dtype=np.float32)
    for number, column in enumerate(_LINEAR):
        source = columns[number if column < 3 else number + 2]
        offset, step = scales[2 * number : 2 * number + 2].astype(np.float64)
        packed[:, column] = offset + step * source
    packed[columns[5] == NO_POINT, 6:] = np.nan
    packed[:, 3] = (columns[3] >> 2) * (360 / _TURN)
    packed[:, 4] = columns[4].view("<f2").astype(np.float32) * scales[-1]
    packed[:, 5] = (columns[3] & 3).astype(np.float32) - 1
    return packed
