"""What the store takes and returns: frozen values, never rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any

from semdb.database.pose_records import PlannedPoses
from semdb.types import (
    Camera,
    Description,
    Float32Array,
    FloatArray,
    ImageQuality,
    Keypoints,
    ModelInfo,
    ObjectGeometry,
)


class RecordingState(StrEnum):
    PLANNED = "planned"
    INGESTING = "ingesting"
    COMPLETE = "complete"
    DELETING = "deleting"


class ItemState(StrEnum):
    PENDING = "pending"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    DELETED = "deleted"  # its keyframe was deleted on purpose: another ingest does not bring it back


class ChangeKind(StrEnum):
    ADDED = "added"
    DELETED = "deleted"
    REDESCRIBED = "redescribed"
    MOVED = "moved"  # its pose is another, or it came from another map or went to one


@dataclass(frozen=True, slots=True)
class MapInfo:
    id: int
    name: str
    keyframes: int
    recordings: int


@dataclass(frozen=True, slots=True, eq=False)
class ImageKind:
    """Where the image of a keyframe is from, and the first bytes of what is stored of it."""

    keyframe_id: int
    recording_id: int
    frame_index: int
    head: bytes


@dataclass(frozen=True, slots=True)
class MapHead:
    """What a program that keeps a map in memory looks at before each query: equal heads, the same models and steps.

    What happens to the keyframes is not in it; `refined` has a line for each step of `semdb refine` that was run, and
    one for frames beside the keyframes, `measured` one of how far the poses of its recordings are off, which ingest
    measures after the last keyframe.
    """

    id: int
    name: str
    models: tuple[ModelInfo, ...]
    refined: tuple[str, ...]
    holds_keyframes: bool = field(compare=False)
    damage: str = ""  # why the map cannot be asked, where its rows are damaged
    measured: str = ""


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """What is to be ingested. `fingerprint` (at most 64 characters) tells recordings of one name apart.

    `extends` is that of the stored plan to which this one adds keyframes.
    """

    name: str
    format: str
    source: str
    frame_count: int
    fingerprint: str
    frame_indexes: tuple[int, ...]  # of the keyframes
    extends: str = ""
    poses: PlannedPoses | None = None  # estimated ones; None: the recording brings its own


@dataclass(frozen=True, slots=True)
class PlannedRecording:
    """`pending`: frame indexes that are not stored yet, ascending, the `failed` of earlier runs among them."""

    recording_id: int
    map_id: int
    pending: tuple[int, ...]
    stored: tuple[int, ...]
    failed: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class RowOptions:
    """How rows are stored: `descriptor_dtype` of a `KeyframeRecord`, and what `kept_images` keeps of image files."""

    descriptor_dtype: str = "float32"
    keep_images: str = "original"


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeRecord:
    """One keyframe with all that is stored of it. `image_bytes` and `depth_bytes` are the files as they are stored."""

    frame_index: int
    timestamp_ns: int | None
    camera: Camera
    world_from_camera: FloatArray  # [4, 4]
    image_bytes: bytes
    depth_bytes: bytes | None
    depth_scale: float | None
    depth_registration: str
    description: Description
    descriptor_dtype: str = "float32"  # of descriptors of float: or "float16", "uint8", "auto" (as the map has them)
    quality: ImageQuality | None = None  # None: not known


@dataclass(frozen=True, slots=True)
class WriteResult:
    keyframe_id: int
    created: bool  # False: the keyframe was there before


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    recording_id: int
    map_id: int
    map: str
    name: str
    format: str
    source: str
    state: RecordingState
    frame_count: int
    items: Mapping[str, int]  # ItemState -> number of keyframes of the plan
    keyframes: int
    objects: int
    keypoints: int
    image_bytes: int  # colour and depth files


@dataclass(frozen=True, slots=True)
class RecordingFinding:
    """What a recording's images contradict: `value` is what fits, `option` what would mend it."""

    kind: str
    certain: bool
    value: str
    option: str
    message: str


@dataclass(frozen=True, slots=True)
class FailedItem:
    recording_id: int
    frame_index: int
    attempts: int
    error: str


@dataclass(frozen=True, slots=True)
class ScoredKeyframe:
    keyframe_id: int
    class_score: float  # 0..1


@dataclass(frozen=True, slots=True, eq=False)
class StoredObject:
    id: int
    ordinal: int
    category: str
    score: float
    box: Float32Array  # [4] x1, y1, x2, y2
    geometry: ObjectGeometry


@dataclass(frozen=True, slots=True, eq=False)
class StoredKeyframe:
    id: int
    map_id: int
    recording_id: int
    recording: str
    frame_index: int
    timestamp_ns: int | None
    camera: Camera
    world_from_camera: FloatArray  # [4, 4]
    objects: tuple[StoredObject, ...]  # by ordinal
    keypoints: Keypoints


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeHead:
    """A keyframe without what is large."""

    id: int
    map: str
    recording: str
    frame_index: int
    timestamp_ns: int | None
    camera: Camera
    world_from_camera: FloatArray  # [4, 4]


@dataclass(frozen=True, slots=True, eq=False)
class StoredImage:
    """The files as recorded. Formats are ``png``, ``jpeg`` or ``""``; no depth: None, scale None."""

    rgb: bytes
    rgb_format: str
    depth: bytes | None
    depth_format: str
    depth_scale: float | None
    depth_registration: str


@dataclass(frozen=True, slots=True)
class UsedCamera:
    """A camera, and a recording whose keyframes it took."""

    map: str
    recording: str
    camera: Camera


@dataclass(frozen=True, slots=True)
class Change:
    id: int
    keyframe_id: int
    kind: ChangeKind


@dataclass(frozen=True, slots=True)
class ChangeMark:
    """The log of changes of a map after some id: a number and two sums that differ when anything was added."""

    newest: int  # 0: nothing there
    rows: int
    sum_of_ids: int


@dataclass(frozen=True, slots=True, eq=False)
class MapObject:
    """A detected object that has a place in its map. `keyframe` numbers keyframes by recording's name and frame."""

    keyframe: int
    category: str
    score: float
    world_from_camera: FloatArray  # [4, 4]
    centroid: tuple[float, float, float]  # camera frame, metres
    extent: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ClassConfusion:
    """The detector takes `category` for `other` in a share of `weight` millionths, seen in `pairs` pairs of objects."""

    category: str
    other: str
    pairs: int
    weight: int


@dataclass(frozen=True, slots=True)
class ListedKeyframe:
    id: int
    recording: str
    frame_index: int


@dataclass(frozen=True, slots=True, eq=False)
class KeyframePoints:
    """Refined points of a keyframe, in the order of its keypoints: X, Y, Z (camera frame) and the sigma of Z, metres.

    NaN where nothing was found. `fused` counts those whose point was measured too, `triangulated` the others.
    """

    keyframe_id: int
    points: Float32Array  # [n, 4]
    fused: int
    triangulated: int


@dataclass(frozen=True, slots=True)
class Refinement:
    """A step of `semdb refine`. `current`: the map is still as it was then."""

    map_id: int
    map: str
    kind: str
    current: bool
    computed_at: datetime
    parameters: Mapping[str, Any]
    rows: int


@dataclass(frozen=True, slots=True)
class Deleted:
    """What a deletion removed."""

    recordings: int
    keyframes: int
