"""What tracking answers with for each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from semdb.door.values import Posed
from semdb.geometry import quat_wxyz_from_rotation
from semdb.shown import for_terminal
from semdb.tracking.states import TrackSource, TrackState
from semdb.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tracked(Posed):
    """Where a moving camera is. `world_from_camera` ``[4, 4]`` and `covariance` ``[6, 6]`` are None when ``lost``.

    The pose is metres in the map's world, the covariance of translation (m), then rotation (rad, left perturbation in
    the world). Only in the state ``tracking`` is the pose measured in the map in this image. `inliers` are its
    keypoints that agree with keyframes. `map_from_odom` ``[4, 4]`` corrects the robot's odometry, where that is given:
    it is the last one measured. `latency_ms` is from the decoded image to the answer.
    """

    image: str
    time_s: float
    state: TrackState
    source: TrackSource
    map: str
    world_from_camera: FloatArray | None
    covariance: FloatArray | None
    inliers: int
    reason: str
    latency_ms: float
    confidence: float | None = None  # of a relocalization
    map_from_odom: FloatArray | None = None
    frame_index: int | None = None
    timestamp_ns: int | None = None
    smoothed: bool = False  # frames after it took part

    @property
    def tracking(self) -> bool:
        """Whether the pose is measured in the map, and to be relied on."""
        return self.state is TrackState.TRACKING

    def as_dict(self) -> dict[str, Any]:
        """What ``semdb track --json-lines`` prints for a frame."""
        return {
            "image": self.image,
            "frame_index": self.frame_index,
            "timestamp_ns": self.timestamp_ns,
            "time_s": self.time_s,
            "state": str(self.state),
            "source": str(self.source),
            "map": self.map,
            "pose": _pose_dict(self.world_from_camera),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "inliers": self.inliers,
            "confidence": self.confidence,
            "reason": self.reason,
            "map_from_odom": _pose_dict(self.map_from_odom),
            "smoothed": self.smoothed,
            "latency_ms": self.latency_ms,
        }

    def __repr__(self) -> str:
        where = f"{self.state} ({self.source}) in map {self.map}"
        if self.position is not None:
            x, y, z = self.position
            where += f" at {x:.3f} {y:.3f} {z:.3f} m, sigma {1000 * self.sigma_m:.1f} mm {self.sigma_deg:.2f} deg"
        return for_terminal(f"<{self.image}: {where}; {self.latency_ms:.0f} ms>")


def _pose_dict(pose: FloatArray | None) -> dict[str, list[float]] | None:
    if pose is None:
        return None
    return {"position": pose[:3, 3].tolist(), "quat_wxyz": quat_wxyz_from_rotation(pose[:3, :3]).tolist()}
