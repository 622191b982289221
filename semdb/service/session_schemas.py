"""What answers about tracked cameras look like, for the OpenAPI document."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from semdb.service.schemas import ANSWER, MATRIX, POSE, Matrix, Model, Pose, Vector3, example

_TRACKED = {
    "image": "image",
    "frame_index": None,
    "timestamp_ns": 1_700_000_000_000_000_000,
    "time_s": 1_700_000_000.0,
    "state": "tracking",
    "source": "tracked",
    "map": "office",
    "pose": POSE,
    "world_from_camera": MATRIX,
    "covariance": ANSWER["covariance"],
    "inliers": 210,
    "confidence": None,
    "reason": "210 keypoints agree with 4 keyframes",
    "map_from_odom": None,
    "map_from_odom_matrix": None,
    "smoothed": False,
    "latency_ms": 21.0,
    "frames": 12,
    "notes": [],
}


class Session(Model):
    """A camera that is tracked: where its frames go. `tracking`: an answer knows the ones before."""

    session: str
    map: str
    seconds: int = Field(description="how long it is valid")
    idle_seconds: float = Field(description="after so long without a frame the camera is looked for anew")
    frames: str = Field(examples=["/v1/sessions/SESSION/frames"])
    stream: str = Field(examples=["/v1/sessions/SESSION/stream"])
    tracking: bool


class Tracked(Model):
    """Where a moving camera is. Only in the state `tracking` is the pose measured in the map in this image."""

    model_config = example(_TRACKED)

    image: str
    frame_index: int | None = Field(description="as it was given, and the time")
    timestamp_ns: int | None
    time_s: float
    state: Literal["initialising", "tracking", "coasting", "lost"]
    source: Literal["tracked", "relocalised", "odometry", "predicted", "none"]
    map: str
    pose: Pose | None
    world_from_camera: Matrix | None
    covariance: Matrix | None = Field(description="6x6: translation (m), then rotation (rad)")
    inliers: int
    confidence: float | None = Field(description="of a pose that was looked for in the whole map")
    reason: str
    map_from_odom: Pose | None = Field(description="corrects the odometry, where frames bring it")
    map_from_odom_matrix: Matrix | None
    smoothed: bool
    latency_ms: float
    frames: int = Field(description="of this camera so far, as this process knows it: 1 where it is looked for anew")
    notes: list[str] = Field(description="what was assumed")


class Ended(Model):
    """The camera was let go."""

    ended: bool


class Watched(Model):
    """A camera that is tracked: its last answer, and where it came from. `age_s`: so long ago its last frame came."""

    camera: str = Field(examples=["9f2c51aa"])
    frames: int
    age_s: float
    path: list[Vector3]
    state: str
    pose: Pose | None
    covariance: Matrix | None
    confidence: float | None
    reason: str | None
    timestamp_ns: int | None
    frame_index: int | None


class LiveCameras(Model):
    """The cameras that this process tracks in a map."""

    map: str
    cameras: list[Watched]
