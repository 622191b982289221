"""What answers for viewers look like, for the OpenAPI document."""

from __future__ import annotations

from pydantic import Field

from semdb.service.schemas import Model, Vector3


class Sighting(Model):
    """An object that shows a landmark: `ordinal` among those of its keyframe, `box` in pixels."""

    landmark: int
    object: int
    ordinal: int
    keyframe: int
    recording: str
    frame_index: int
    timestamp_ns: int | None
    category: str
    score: float
    box: list[float]
    coverage: float
    visibility: float


class Sightings(Model):
    """Objects that show landmarks, by time."""

    sightings: list[Sighting]


class Visit(Model):
    """What a recording says of a landmark: `presence` is present, absent or unobserved; in how many keyframes."""

    recording: str
    presence: str
    keyframes: int
    points: int
    seen: int
    seen_through: int
    occluded: int
    missed: int
    position: Vector3 | None
    size: Vector3 | None


class LandmarkHistory(Sightings):
    """Objects that show a landmark, by time, and what each recording says of it."""

    visits: list[Visit]
    next: str | None = Field(description="address of the next page of sightings; null at the end")
    key: str | None = Field(description="key of the last one, where more follow")


class KeyframeColumns(Model):
    """Keyframes by id. `recording` and `camera` are places in the lists of those, a position three numbers."""

    recordings: list[str]
    cameras: list[dict[str, float]]
    id: list[int]
    recording: list[int]
    camera: list[int]
    frame_index: list[int]
    timestamp_ns: list[int | None]
    position: list[float]
    quat_wxyz: list[float]


class LandmarkColumns(Model):
    """Landmarks by id. `category`, `state` are places in lists; `covariance` is xx, xy, xz, yy, yz, zz."""

    categories: list[str]
    states: list[str]
    id: list[int]
    category: list[int]
    state: list[int]
    probability: list[float]
    position: list[float]
    covariance: list[float]
    size: list[float]
    yaw: list[float]
    keyframes: list[int]
    last_seen_ns: list[int | None]


class LinkColumns(Model):
    """Accepted links between keyframes, by ids; `kind` is a place in `kinds`."""

    kinds: list[str]
    kind: list[int]
    keyframe: list[int]
    other_keyframe: list[int]
    inliers: list[int]


class Scene(Model):
    """A map as viewers draw it."""

    map: str
    up: Vector3 | None
    keyframes: KeyframeColumns
    landmarks: LandmarkColumns
    links: LinkColumns
