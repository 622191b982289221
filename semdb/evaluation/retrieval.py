"""How good the coarse step is by itself: does a keyframe that sees the place come early?

A keyframe sees the place when it is within 0.3 m and 20 degrees of the query's true pose. Queries without any such
keyframe say nothing about retrieval and are left out; a result says how many are counted.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import pose_error
from semdb.types import BoolArray, FloatArray

NEAR_TRANSLATION_M = 0.3
NEAR_ROTATION_DEG = 20.0
FIRST = (1, 3, 10)


@dataclass(frozen=True, slots=True)
class Reach:
    """What a map has of one place. `rank` is the position, from 1, of the first keyframe near enough; None beyond 10.

    `nearest_translation_m`, `nearest_rotation_deg` are of the keyframe nearest in pose.
    """

    reachable: bool
    rank: int | None
    nearest_translation_m: float
    nearest_rotation_deg: float


@dataclass(frozen=True, slots=True)
class Retrieval:
    """`queries` have a keyframe near enough; `first_1`, `first_3`, `first_10` are shares of these, 0..1."""

    queries: int
    first_1: float | None
    first_3: float | None
    first_10: float | None


def near_keyframes(pose: FloatArray, poses: FloatArray) -> BoolArray:
    """Which of `poses` ``[n, 4, 4]`` are within 0.3 m and 20 degrees of `pose`."""
    return _near(_errors(pose, poses))


def _errors(pose: FloatArray, poses: FloatArray) -> FloatArray:
    """Metres and degrees ``[n, 2]`` from `pose` to `poses` ``[n, 4, 4]``."""
    return np.array([pose_error(other, pose) for other in poses]).reshape(-1, 2)


def _near(errors: FloatArray) -> BoolArray:
    return np.asarray((errors[:, 0] <= NEAR_TRANSLATION_M) & (errors[:, 1] <= NEAR_ROTATION_DEG))


def reach(pose: FloatArray, poses: FloatArray, order: Sequence[int] | None) -> Reach:
    """`order` are positions in `poses` ``[n, 4, 4]``, the best first; None where a method does not retrieve."""
    errors = _errors(pose, poses)
    near = _near(errors)
    nearest = int(np.argmin(errors[:, 0] / NEAR_TRANSLATION_M + errors[:, 1] / NEAR_ROTATION_DEG))
    rank = None
    if order is not None:
        rank = next((i for i, position in enumerate(order[: max(FIRST)], start=1) if near[position]), None)
    return Reach(bool(near.any()), rank, float(errors[nearest, 0]), float(errors[nearest, 1]))


def retrieval_figures(reachable: Iterable[bool], ranks: Iterable[int | None]) -> Retrieval:
    """Shares over the queries that are reachable; None where there is none."""
    counted = [rank for there, rank in zip(reachable, ranks, strict=True) if there]

    def share(first: int) -> float | None:
        return sum(rank is not None and rank <= first for rank in counted) / len(counted) if counted else None

    return Retrieval(len(counted), share(1), share(3), share(10))
