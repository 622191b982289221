"""What is found of a trajectory: poses with covariances, keyframes, edges, pieces, and what was left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.odometry import FrameState
from semdb.trajectory.upright import Up
from semdb.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FramePose:
    """One frame. `piece` is 0 for the trajectory that is used; pieces that nothing joined have worlds of their own.

    `covariance` ``[6, 6]``: translation (m) then rotation (rad, left perturbation in the world frame), against the
    first keyframe of the piece.
    """

    position: int  # among the frames given, from 0
    state: FrameState
    reason: str = ""  # why it has no pose
    piece: int = -1
    world_from_camera: FloatArray | None = None  # [4, 4]
    covariance: FloatArray | None = None
    before_closing: FloatArray | None = None  # [4, 4] of odometry alone, in the world of its own piece before joining
    keyframe: int = -1  # its number where it is one

    @property
    def placed(self) -> bool:
        return self.world_from_camera is not None


@dataclass(frozen=True, slots=True)
class Drift:
    """How far odometry was off between the two keyframes of an accepted closure, over `path_m` of way."""

    first: int  # keyframe numbers
    second: int
    metres: float
    degrees: float
    path_m: float


@dataclass(frozen=True, slots=True)
class PieceSummary:
    """A stretch that is one trajectory: number (0 is the largest), frames with a pose, keyframes, first and last.

    `up` is what tells gravity in its world: where it is known, z is up, to `up.sigma_deg`.
    """

    number: int
    frames: int
    keyframes: int
    first_position: int
    last_position: int
    up: Up | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """The trajectory of a sequence of frames. Edges name keyframes by number, `keyframes` says which frames they are.

    The world of a piece has its origin at its first keyframe. Where surfaces tell which way is up it is turned so: z
    up, and x where the first keyframe looks, level; else its axes are those of the first keyframe. `readout_s` is the
    time from the first row of an image to the last, as the images show it (0 where they show none).
    """

    frames: tuple[FramePose, ...]
    keyframes: tuple[int, ...]  # positions, by number
    edges: tuple[Edge, ...]
    pieces: tuple[PieceSummary, ...]
    drifts: tuple[Drift, ...]
    readout_s: float
    timing_s: Mapping[str, float]

    def count(self, state: FrameState) -> int:
        """How many frames are in `state`."""
        return sum(frame.state is state for frame in self.frames)

    @property
    def up(self) -> Up | None:
        """Up of the largest piece, in its world: z, or None where gravity is not known."""
        return self.pieces[0].up if self.pieces else None

    @property
    def used(self) -> tuple[FramePose, ...]:
        """Frames of the largest piece."""
        return tuple(frame for frame in self.frames if frame.placed and frame.piece == 0)

    def closures(self, state: EdgeState = EdgeState.ACCEPTED) -> tuple[Edge, ...]:
        """Edges that are no odometry and are in `state`."""
        return tuple(edge for edge in self.edges if edge.kind is not EdgeKind.ODOMETRY and edge.state is state)
