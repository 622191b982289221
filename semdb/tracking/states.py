"""What tracking says of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from semdb.types import FloatArray


class TrackState(StrEnum):
    """What a pose is worth; only ``tracking`` ones are measured in the map in this frame."""

    INITIALISING = "initialising"  # found once, waits for a second answer that agrees
    TRACKING = "tracking"
    COASTING = "coasting"  # carried on by motion alone, with a covariance that grows
    LOST = "lost"  # no pose


class TrackSource(StrEnum):
    """Where a pose comes from."""

    TRACKED = "tracked"  # keyframes near to where it was expected
    RELOCALISED = "relocalised"  # looked for in the whole map
    ODOMETRY = "odometry"  # the robot's, or the step seen between two images
    PREDICTED = "predicted"  # it went on as it went
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPose:
    """One frame. `world_from_camera` ``[4, 4]`` and `covariance` ``[6, 6]`` (translation in m, rotation in rad, left
    perturbation in the world) are None when lost. `measured` is the pose of this image alone, where it gave one.
    """

    state: TrackState
    source: TrackSource
    world_from_camera: FloatArray | None
    covariance: FloatArray | None
    inliers: int
    reason: str
    latency_ms: float
    confidence: float | None = None  # of a relocalization
    measured: FloatArray | None = None
    map_from_odom: FloatArray | None = None  # [4, 4], where odometry is given
