"""What ties keyframes together: relative poses with how sure they are, and what became of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from semdb.types import BoolArray, FloatArray, IntArray


class EdgeKind(StrEnum):
    """Between which keyframes an edge runs."""

    ODOMETRY = "odometry"  # that follow each other
    LOOP = "loop"  # of one trajectory, seen again after a while
    SESSION = "session"  # of different recordings, or of pieces of one that tracking did not join


class EdgeState(StrEnum):
    """Whether an edge counts."""

    ACCEPTED = "accepted"
    CONTRADICTED = "contradicted"  # verified by its images, but others say otherwise
    FAILED = "failed"  # its images do not bear it


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """The pose of keyframe `second` in the frame of keyframe `first` (their numbers), and why it is believed.

    `information` ``[6, 6]`` is of a right perturbation of `first_from_second`: translation (m) then rotation (rad), in
    the frame of the second camera.
    """

    first: int
    second: int
    kind: EdgeKind
    first_from_second: FloatArray  # [4, 4]
    information: FloatArray  # [6, 6]
    inliers: int
    state: EdgeState = EdgeState.ACCEPTED
    reason: str = ""  # one line for people


@dataclass(frozen=True, slots=True, eq=False)
class EdgeArrays:
    """Edges as the pose graph takes them."""

    first: IntArray  # [m]
    second: IntArray  # [m]
    first_from_second: FloatArray  # [m, 4, 4]
    information: FloatArray  # [m, 6, 6]
    robust: BoolArray  # [m] those that may be wrong

    def __len__(self) -> int:
        return len(self.first)


def stack_edges(edges: Sequence[Edge]) -> EdgeArrays:
    """`edges` as arrays; those that are no odometry may be wrong."""
    return EdgeArrays(
        np.array([edge.first for edge in edges], np.int32),
        np.array([edge.second for edge in edges], np.int32),
        np.array([edge.first_from_second for edge in edges]).reshape(-1, 4, 4),
        np.array([edge.information for edge in edges]).reshape(-1, 6, 6),
        np.array([edge.kind is not EdgeKind.ODOMETRY for edge in edges], np.bool_),
    )
