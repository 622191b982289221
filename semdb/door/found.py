"""What a search for things answers with: frozen values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from semdb.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """A keyframe from which a landmark was well seen: a place to go to, and `box` (x1, y1, x2, y2) the crop there."""

    keyframe_id: int
    recording: str
    frame_index: int
    world_from_camera: FloatArray  # [4, 4]
    box: tuple[float, float, float, float]
    distance: float  # metres

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        from semdb.geometry import quat_wxyz_from_rotation

        pose = self.world_from_camera
        return {
            "keyframe": self.keyframe_id,
            "recording": self.recording,
            "frame_index": self.frame_index,
            "pose": {
                "position": [float(v) for v in pose[:3, 3]],
                "quat_wxyz": [float(v) for v in quat_wxyz_from_rotation(pose[:3, :3])],
            },
            "crop": list(self.box),
            "distance": self.distance,
        }


@dataclass(frozen=True, slots=True)
class Evidence:
    """An object that shows a landmark."""

    object_id: int
    keyframe_id: int
    recording: str
    frame_index: int
    category: str
    score: float
    coverage: float
    visibility: float

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {name: getattr(self, name) for name in self.__slots__}


@dataclass(frozen=True, slots=True, eq=False)
class FoundLandmark:
    """A hit. `parts` are what its `score` is the product of: class, near, on, not_near, state, distance."""

    landmark_id: int
    map: str
    category: str
    probability: float
    position: tuple[float, float, float]
    covariance: FloatArray  # [3, 3] square metres
    size: tuple[float, float, float]
    yaw: float
    state: str
    sightings: int
    keyframes: int
    last_recording: str | None
    last_frame_index: int | None
    last_keyframe_id: int | None
    last_seen_ns: int | None
    score: float
    parts: Mapping[str, float]
    distance: float | None  # metres from where one asked from
    evidence: tuple[Evidence, ...]  # the clearest ones
    viewpoint: Viewpoint | None

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {
            "landmark": self.landmark_id,
            "map": self.map,
            "category": self.category,
            "probability": self.probability,
            "position": list(self.position),
            "covariance": self.covariance.tolist(),
            "box": {"size": list(self.size), "yaw": self.yaw},
            "state": self.state,
            "sightings": self.sightings,
            "keyframes": self.keyframes,
            "last_seen": {
                "recording": self.last_recording,
                "frame_index": self.last_frame_index,
                "keyframe": self.last_keyframe_id,
                "timestamp_ns": self.last_seen_ns,
            },
            "score": self.score,
            "parts": dict(self.parts),
            "distance": self.distance,
            "evidence": [item.as_dict() for item in self.evidence],
            "viewpoint": None if self.viewpoint is None else self.viewpoint.as_dict(),
        }


@dataclass(frozen=True, slots=True)
class Missing:
    """Why nothing was found, or nothing that surely is one: `reason` is never_seen, gone or not_looked_at; `usual` says
    where such things stand.
    """

    reason: str
    text: str
    candidates: tuple[Mapping[str, Any], ...] = ()  # landmarks that were it, or would be
    usual: tuple[Mapping[str, Any], ...] = ()  # relation, category, count

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {
            "reason": self.reason,
            "text": self.text,
            "candidates": [dict(item) for item in self.candidates],
            "usual_places": [dict(item) for item in self.usual],
        }


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The answer of a search. `understood` says of each part of the question which classes it was taken for.

    Beside `missing` there are hits where things that are rather something else were found.
    """

    understood: Mapping[str, Mapping[str, Any]]
    hits: tuple[FoundLandmark, ...]
    missing: Missing | None
    statement: Callable[[], str] = field(repr=False)

    @property
    def sql(self) -> str:
        """The statement that the database was asked, values in place."""
        return self.statement()

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {
            "understood": {name: dict(item) for name, item in self.understood.items()},
            "hits": [hit.as_dict() for hit in self.hits],
            "missing": None if self.missing is None else self.missing.as_dict(),
        }
