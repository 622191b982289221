"""Values of the tables of landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from semdb.types import Camera, Float32Array, FloatArray


@dataclass(frozen=True, slots=True)
class GravityRow:
    """Which way is up in a map (unit vector), and where its floor is: points x with ``up @ x == floor``."""

    up: tuple[float, float, float]
    up_certainty: float
    floor: float | None
    floor_certainty: float
    given: bool


@dataclass(frozen=True, slots=True)
class LandmarkSighting:
    """An object that shows a landmark."""

    object_id: int
    coverage: float
    visibility: float


@dataclass(frozen=True, slots=True)
class LandmarkView:
    """An object that shows a landmark well; `distance` of the camera in metres."""

    object_id: int
    quality: float
    distance: float


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkVisit:
    """What a recording says of a landmark: see `semdb.landmarks.visits.Visit`. `recording` is a name in the map.

    `position` and `size` are of what that recording saw of it; None where it did not.
    """

    recording: str
    presence: str
    keyframes: int
    points: int
    seen: int
    seen_through: int
    occluded: int
    missed: int
    position: tuple[float, float, float] | None
    size: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkRow:
    """A landmark as it is stored, but for its id. `perhaps`: other classes that it may be, with their probabilities."""

    category: str
    probability: float
    evidence: Mapping[str, float]
    position: tuple[float, float, float]
    covariance: FloatArray  # [3, 3]
    size: tuple[float, float, float]
    yaw: float
    keyframes: int
    missed: int
    seen_through: int
    state: str
    first_keyframe_id: int
    last_keyframe_id: int
    first_seen_ns: int | None
    last_seen_ns: int | None
    sightings: tuple[LandmarkSighting, ...]
    views: tuple[LandmarkView, ...]
    visits: tuple[LandmarkVisit, ...] = ()
    appearance: Float32Array | None = None
    perhaps: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LandmarkRelation:
    """By numbers of landmarks in a list."""

    one: int
    kind: str
    other: int
    score: float


@dataclass(frozen=True, slots=True)
class CompletedClass:
    """How strongly a keyframe shows a class at least, landmarks included that were missed in it: see `class_score`."""

    keyframe_id: int
    category: str
    upper: int
    lower: int


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkSet:
    """All that is stored of the landmarks of a map."""

    landmarks: tuple[LandmarkRow, ...]
    relations: tuple[LandmarkRelation, ...]
    gravity: GravityRow
    completed: tuple[CompletedClass, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeObject:
    """An object of a keyframe with its mask, as stored."""

    id: int
    category: str
    score: float
    mask: bytes
    height: float = 0.5  # of the middle of its box in the image, 0 at the top to 1 at the bottom


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeDepth:
    """What landmarks are made of: a keyframe's pose, files (as recorded, depth None without) and objects by ordinal."""

    id: int
    recording: str
    frame_index: int
    timestamp_ns: int | None
    camera: Camera
    world_from_camera: FloatArray  # [4, 4]
    rgb: bytes
    depth: bytes | None
    depth_scale: float | None
    depth_registration: str
    objects: tuple[KeyframeObject, ...]
