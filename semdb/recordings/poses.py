"""Poses as files have them: 16 numbers, or 12, of which a rigid motion is made or a reason why not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semdb.errors import RecordingError
from semdb.files import fields_of, parse_number
from semdb.geometry import FARTHEST_POSE_M, pose_from, project_to_so3
from semdb.recordings.lines import TOO_FAR, BadLine, read_lines
from semdb.types import FloatArray

ROTATION_TOLERANCE = 0.02  # matrices of real data sets are off by up to 4e-4


def rigid_pose(matrix: npt.ArrayLike) -> FloatArray:
    """The pose ``[4, 4]`` of a matrix ``[4, 4]`` or ``[3, 4]``, its rotation projected to SO(3).

    Raises ValueError with the reason for what is no rigid motion.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape not in ((4, 4), (3, 4)):
        raise ValueError("is no matrix of 4 by 4 numbers")
    if not np.isfinite(m).all():
        raise ValueError("has a number that is not finite")
    if m.shape == (4, 4) and np.abs(m[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise ValueError("is no rigid motion: its last row is not 0 0 0 1")
    rotation = m[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not off <= ROTATION_TOLERANCE or np.linalg.det(rotation) <= 0:
        raise ValueError(f"is no rotation (R^T R differs from the identity by {off:.2g})")
    if np.abs(m[:3, 3]).max() > FARTHEST_POSE_M:
        raise ValueError(TOO_FAR)
    return pose_from(project_to_so3(rotation), m[:3, 3])


def numbers_of(text: str) -> list[float]:
    """The numbers of a line; see `semdb.files.fields_of`. Raises ValueError with the reason."""
    return [parse_number(part) for part in fields_of(text)[0]]


def pose_of_numbers(values: Sequence[float]) -> FloatArray:
    """The pose of 16 (or 12) numbers row by row. Raises ValueError with the reason."""
    if len(values) not in (12, 16):
        raise ValueError(f"needs the 16 numbers of a matrix, but has {len(values)}")
    return rigid_pose(np.reshape(values, (-1, 4)))


def read_matrix_lines(path: Path) -> tuple[list[FloatArray | str], list[BadLine]]:
    """One pose for each line of 16 numbers, or the reason why it is none; and the lines that are none.

    Raises RecordingError when no line is one.
    """
    found: list[FloatArray | str] = []
    bad: list[BadLine] = []
    for number, line in read_lines(path):
        try:
            found.append(pose_of_numbers(numbers_of(line)))
        except ValueError as error:
            found.append(f"{path.name} line {number}: {error}")
            bad.append(BadLine(number, str(error)))
    if len(bad) == len(found):
        where = f", line {bad[0].line}: {bad[0].reason}" if bad else ": has no pose"
        raise RecordingError(f"{path}{where}; lines of the 16 numbers of a matrix are needed")
    return found, bad
