"""What answers look like, for the OpenAPI document. Answers themselves are made by `values` and not checked again."""

from __future__ import annotations

from typing import Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

Vector3 = list[float]
Matrix = list[list[float]]
ItemT = TypeVar("ItemT")


POSE = {"position": [-0.19, 1.35, 1.42], "quat_wxyz": [0.394, -0.49, -0.596, 0.5]}
MATRIX = [[-0.21, 0.19, -0.96, -0.19], [0.98, 0.02, -0.21, 1.35], [-0.02, -0.98, -0.19, 1.42], [0.0, 0.0, 0.0, 1.0]]
_CAMERA = {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "distortion": []}
_KEYFRAME = {
    "id": 1,
    "map": "office",
    "recording": "rgbd_dataset_freiburg1_desk",
    "frame_index": 12,
    "timestamp_ns": 1305031452791720000,
    "camera": _CAMERA,
    "pose": POSE,
    "world_from_camera": MATRIX,
}
_OBJECT = {
    "id": None,
    "category": "chair",
    "score": 0.93,
    "box": [60.0, 40.0, 259.0, 199.0],
    "position": [0.4, 1.9, 0.5],
    "extent": [0.5, 0.9, 0.5],
}
_CANDIDATE = {"keyframe": 1, "recording": "rgbd_dataset_freiburg1_desk", "frame_index": 12}
ANSWER = {
    "image": "image",
    "frame_index": None,
    "timestamp_ns": None,
    "verdict": "localized",
    "map": "office",
    "pose": POSE,
    "world_from_camera": MATRIX,
    "covariance": [[1e-6 if row == column else 0.0 for column in range(6)] for row in range(6)],
    "confidence": 0.99,
    "inliers": 322,
    "stage": "filtered",
    "reason": "322 inliers",
    "ranked_share": 0.2,
    "keyframes_matched": 3,
    "candidates": [{**_CANDIDATE, "class_score": 0.8, "cosine": 0.97, "inliers": 322}],
    "refinements": {"points": "none"},
    "objects": [_OBJECT],
    "notes": ["camera of the images: that of the map's keyframes (--camera or --like name another)"],
    "timing_ms": {"total": 56.0},
}


def example(content: dict[str, Any]) -> ConfigDict:
    """The configuration of a model with an example."""
    return ConfigDict(extra="allow", json_schema_extra={"examples": [content]})


class Model(BaseModel):
    """An object whose members may become more."""

    model_config = ConfigDict(extra="allow")


class Problem(Model):
    """An error (RFC 9457)."""

    type: str = Field(examples=["urn:semdb:problem:not-found"])
    title: str = Field(examples=["Not found"])
    status: int = Field(examples=[404])
    detail: str = Field(examples=["there is no map 'attic'"])
    request_id: str = Field(examples=["6f1c2a0b9d3e4f58"])


class Page(Model, Generic[ItemT]):
    """Part of a list. `next` is the address of what follows, `after` (or `before`) its key; null at the end."""

    items: list[ItemT]
    next: str | None = Field(examples=["/v1/maps/office/keyframes?after=100"])
    key: str | None = Field(examples=["100"])


class Map(Model):
    """A world frame."""

    name: str = Field(examples=["office"])
    id: int
    keyframes: int = Field(examples=[40])
    recordings: int = Field(examples=[1])


class ModelOf(Model):
    """A network or feature that made rows."""

    role: str = Field(examples=["features"])
    name: str = Field(examples=["surf"])
    sha256: str
    config: str


class Step(Model):
    """A step of `semdb refine` that was run."""

    kind: str = Field(examples=["landmarks"])
    current: bool
    computed_at: str
    rows: int


class MapDetail(Map):
    """A world frame, how it is described, and which way is up."""

    models: list[ModelOf]
    refinements: list[Step]
    up: Vector3 | None = Field(examples=[[0.0, 0.0, 1.0]])


class Recording(Model):
    """A recording of a map, what is planned and stored of it. `source` only for role admin."""

    id: int
    map: str
    map_id: int
    name: str
    format: str
    source: str | None
    state: str = Field(examples=["complete"])
    frame_count: int
    items: dict[str, int]
    keyframes: int
    objects: int
    keypoints: int
    image_bytes: int


class CameraModel(Model):
    """Intrinsics in pixels, OpenCV's distortion k1, k2, p1, p2[, k3]."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float]


class Pose(Model):
    """Of the camera in the map: metres, camera axes x right, y down, z forward."""

    position: Vector3
    quat_wxyz: list[float]


class Keyframe(Model):
    """A keyframe without what is large."""

    model_config = example(_KEYFRAME)

    id: int
    map: str
    recording: str
    frame_index: int
    timestamp_ns: int | None
    camera: CameraModel
    pose: Pose
    world_from_camera: Matrix


class Mask(Model):
    """Pixels of an object, COCO's uncompressed RLE: `size` is height and width, `counts` go down the columns."""

    size: list[int]
    counts: list[int]


class SeenObject(Model):
    """An object of an image: box x1, y1, x2, y2 in pixels, place and size in metres where there is depth."""

    id: int | None
    category: str = Field(examples=["chair"])
    score: float
    box: list[float]
    position: Vector3 | None
    extent: Vector3 | None
    mask: Mask | None = None


class Objects(Model):
    """The objects of a keyframe, by ordinal."""

    keyframe: int
    objects: list[SeenObject]


class KeypointColumns(Model):
    """Keypoints column by column, by object; points in metres in the camera's frame."""

    categories: list[str]
    x: list[float]
    y: list[float]
    size: list[float]
    angle: list[float]
    response: list[float]
    laplacian: list[int]
    object_index: list[int]
    points: list[list[float | None]]


class CandidateModel(Model):
    """A keyframe that was looked at."""

    keyframe: int
    recording: str
    frame_index: int
    class_score: float | None
    cosine: float | None
    inliers: int


class OtherPose(Model):
    """A pose elsewhere that the image fits too, with so many keypoints."""

    world_from_camera: Matrix
    inliers: int


class MatchedModel(Model):
    """Pixels of the image, and those of the best keyframe that they match; the pose rests on them."""

    keyframe: int
    query_xy: list[list[float]]
    keyframe_xy: list[list[float]]


class Answer(Model):
    """Where an image was taken. A pose for all but `failed`, which is an answer, too; `coarse` is good to 0.5 m."""

    model_config = example(ANSWER)

    image: str
    frame_index: int | None = Field(description="as it was given, and the time")
    timestamp_ns: int | None
    verdict: Literal["localized", "ambiguous", "coarse", "failed"]
    map: str
    pose: Pose | None
    world_from_camera: Matrix | None
    covariance: Matrix | None = Field(description="6x6: translation (m), then rotation (rad)")
    others: list[OtherPose] = Field(default_factory=list, description="that stand against this one, best first")
    confidence: float | None
    inliers: int
    stage: str
    reason: str
    ranked_share: float = Field(description="of the map's keyframes, by the filter by class")
    keyframes_matched: int
    candidates: list[CandidateModel]
    refinements: dict[str, str] = Field(description="by step of `semdb refine`: what of it was used")
    objects: list[SeenObject]
    notes: list[str] = Field(description="what was assumed")
    timing_ms: dict[str, float | None]
    matches: MatchedModel | None = Field(None, description="where they were asked for")


class BatchItem(Model):
    """The answer for one image, or why it could not be read."""

    answer: Answer | None
    problem: Problem | None


class Batch(Model):
    """Answers in the order of the images."""

    items: list[BatchItem]


class DeletedModel(Model):
    """What was deleted."""

    recordings: int
    keyframes: int


class Relation(Model):
    """How a landmark stands to another one."""

    landmark: int
    kind: str = Field(examples=["on"])
    other_landmark: int
    score: float


class Landmark(Model):
    """A thing that several keyframes see."""

    id: int
    map: str
    category: str
    probability: float
    position: Vector3
    covariance: Matrix
    classes: dict[str, float] = Field(description="what it was taken for, and how surely")
    box: dict[str, Any] = Field(description="`size` in metres, `yaw` about the map's up")
    state: str = Field(examples=["confirmed"])
    sightings: int
    keyframes: int
    missed: int
    seen_through: int
    first_seen_ns: int | None
    last_seen: dict[str, Any] = Field(description="`recording`, `frame_index`, `timestamp_ns`")
    relations: list[Relation] | None = Field(None, description="where one landmark is asked for")


class Found(Model):
    """Landmarks that were asked for, the best first; where none surely is one, `missing` says why."""

    understood: dict[str, dict[str, Any]]
    hits: list[dict[str, Any]]
    missing: dict[str, Any] | None


class ChangesModel(Model):
    """What changed between two recordings, as `semdb changes --json` prints it."""

    map: str
    between: list[str] = Field(description="the names of both", examples=[["monday", "friday"]])
    counts: dict[str, int]
    changes: list[dict[str, Any]]
    landmarks: list[dict[str, Any]] = Field(description="what both say of each")


class Link(Model):
    """What ties two keyframes together."""

    map: str
    keyframe: int
    recording: str
    frame_index: int
    other_keyframe: int
    other_recording: str
    other_frame_index: int
    kind: str
    state: str
    inliers: int
    off_m: float | None
    off_deg: float | None
    reason: str
    provenance: str
    first_from_second: Matrix
    information: Matrix


class Query(Model):
    """A localization that was logged; `map` where one is asked for."""

    id: int
    map: str | None = None
    created_at: str
    image: str
    verdict: str
    pose: Pose | None
    world_from_camera: Matrix | None
    confidence: float
    inliers: int
    stage: str
    reason: str
    candidates: list[dict[str, Any]]
    timing_ms: dict[str, float | None]


class CoverageModel(Model):
    """What a map's keyframes cover, or are near a place."""

    available: bool
    map: str
    keyframes: int
    position: Vector3 | None
    radius_m: float
    near: int
    nearest_m: float | None
    nearest_keyframe: int | None
    low: Vector3 | None
    high: Vector3 | None
    directions: list[int]


class Health(Model):
    """The process answers."""

    status: Literal["ok"]
    version: str


class Ready(Model):
    """Whether localizations can be answered, and what is in the way where not."""

    ready: bool
    checks: dict[str, str]
