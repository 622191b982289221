"""Where poses come from and what ties keyframes together, as the store takes and returns them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any

import numpy as np

from semdb.types import FloatArray


class PoseSource(StrEnum):
    """Who says where the camera was."""

    RECORDED = "recorded"
    ESTIMATED = "estimated"


class World(StrEnum):
    """Whose world frame the poses of a recording are in."""

    RECORDING = "recording"  # that of the poses it brings: recordings of one map share it
    FIRST_KEYFRAME = "first_keyframe"  # that of its first keyframe, turned upright where gravity could be told
    ALIGNED = "aligned"  # that of the map, into which it was moved


class LinkKind(StrEnum):
    """Between which keyframes a link runs."""

    ODOMETRY = "odometry"  # that follow each other
    LOOP = "loop"  # of one trajectory, seen again after a while
    SESSION = "session"  # of different recordings


class LinkState(StrEnum):
    """Whether a link counts."""

    ACCEPTED = "accepted"
    CONTRADICTED = "contradicted"  # its images bear it, but others say otherwise
    FAILED = "failed"  # its images do not bear it


class OperationKind(StrEnum):
    """What moved keyframes."""

    ALIGN = "align"
    REFINE = "refine"


@dataclass(frozen=True, slots=True, eq=False)
class RecordingPoses:
    """Where the poses of a recording come from. `upright`: z is up; None where nobody knows.

    `map_from_recording` ``[4, 4]`` takes poses as they were recorded or planned into the map: what is still to be
    stored of a recording that was moved goes through it.
    """

    source: PoseSource = PoseSource.RECORDED
    world: World = World.RECORDING
    upright: bool | None = None
    map_from_recording: FloatArray = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """The pose of one keyframe in the frame of another, and why it is believed.

    `information` ``[6, 6]`` is of a right perturbation of `first_from_second`: translation (m) then rotation (rad), in
    the frame of the second camera. `first` and `second` are keyframe ids, or frame indexes in a plan.
    """

    first: int
    second: int
    kind: LinkKind
    first_from_second: FloatArray  # [4, 4]
    information: FloatArray  # [6, 6]
    inliers: int
    state: LinkState = LinkState.ACCEPTED
    reason: str = ""  # one line for people
    provenance: str = ""  # what found it


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPoses:
    """Estimated poses that a plan brings: ``[4, 4]`` by frame index, covariances ``[6, 6]`` where known, links."""

    upright: bool
    poses: Mapping[int, FloatArray]
    covariances: Mapping[int, FloatArray] = field(default_factory=dict)
    links: tuple[Link, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PoseOperation:
    """What moved keyframes, when, and where the recording was before; `undone_at` when that was taken back."""

    id: int
    kind: OperationKind
    map_id: int
    recording_id: int | None
    from_map_id: int | None
    from_map: str | None
    from_name: str | None
    parameters: Mapping[str, Any]
    created_at: datetime
    undone_at: datetime | None


@dataclass(frozen=True, slots=True, eq=False)
class MovedRecording:
    """A recording that goes into another map under `name`, or stays in its own; `map_id` is where it was read."""

    recording_id: int
    map_id: int
    name: str
    target_from_map: FloatArray  # [4, 4] what takes the poses of what is still to be stored along


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """Keyframes and recordings that move into the map `map_id` in one step.

    `before` and `after` ``[4, 4]`` by keyframe id: the poses that were read, and those to be. `covariances` ``[6, 6]``
    replace those of the keyframes that have any here; others that move lose theirs. `relied_on` are poses of keyframes
    that stay, and from which it was found out where the others go. `counted` is how many keyframes the map had when all
    of it was read to be moved: none may come in meanwhile, which would be left behind.
    """

    kind: OperationKind
    map_id: int
    before: Mapping[int, FloatArray]
    after: Mapping[int, FloatArray]
    recordings: tuple[MovedRecording, ...] = ()
    links: tuple[Link, ...] = ()
    covariances: Mapping[int, FloatArray] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    relied_on: Mapping[int, FloatArray] = field(default_factory=dict)
    counted: int | None = None
