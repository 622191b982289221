"""What changed between two recordings of a map: frozen values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Crop:
    """Where a recording shows a landmark best: `box` (x1, y1, x2, y2) in the image of a keyframe."""

    keyframe_id: int
    frame_index: int
    box: tuple[float, float, float, float]

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {"keyframe": self.keyframe_id, "frame_index": self.frame_index, "box": list(self.box)}


@dataclass(frozen=True, slots=True)
class Visited:
    """What a recording says of a landmark: `presence` is present, absent or unobserved.

    Of `points` that other recordings saw of it so many were `seen`, `seen_through`, `occluded`; the rest was out of
    view. `missed`: keyframes that look at its place and show none. `position` and `size` are of what was seen of it.
    """

    presence: str
    keyframes: int = 0
    points: int = 0
    seen: int = 0
    seen_through: int = 0
    occluded: int = 0
    missed: int = 0
    position: Three | None = None
    size: Three | None = None
    crop: Crop | None = None

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {
            "presence": self.presence,
            "keyframes": self.keyframes,
            "points": self.points,
            "seen": self.seen,
            "seen_through": self.seen_through,
            "occluded": self.occluded,
            "missed": self.missed,
            "position": None if self.position is None else list(self.position),
            "size": None if self.size is None else list(self.size),
            "crop": None if self.crop is None else self.crop.as_dict(),
        }


@dataclass(frozen=True, slots=True)
class ComparedLandmark:
    """A landmark as two recordings see it."""

    landmark_id: int
    category: str
    state: str
    before: Visited
    after: Visited

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {
            "landmark": self.landmark_id,
            "category": self.category,
            "state": self.state,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
        }


@dataclass(frozen=True, slots=True)
class LandmarkChange:
    """`kind` is appeared, disappeared or moved; `other_landmark_id` the landmark that it is now, where that is another.

    `score` is the share of its points that was seen through, or how much the two are alike; `distance` in metres.
    """

    kind: str
    category: str
    landmark_id: int
    other_landmark_id: int | None
    score: float
    distance: float | None
    before: Visited
    after: Visited

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {
            "kind": self.kind,
            "category": self.category,
            "landmark": self.landmark_id,
            "other_landmark": self.other_landmark_id,
            "score": self.score,
            "distance": self.distance,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
        }


@dataclass(frozen=True, slots=True)
class Changes:
    """What changed in a map from one recording to another one, and what both say of each landmark."""

    map: str
    before: str  # names of recordings
    after: str
    changes: tuple[LandmarkChange, ...]
    landmarks: tuple[ComparedLandmark, ...]

    @property
    def counts(self) -> Mapping[str, int]:
        """How many changes of each kind, landmarks that both show and that only one of them had in view."""
        kinds = [change.kind for change in self.changes]
        pairs = [(item.before.presence, item.after.presence) for item in self.landmarks]
        return {
            **{kind: kinds.count(kind) for kind in ("appeared", "disappeared", "moved")},
            "in_both": pairs.count(("present", "present")),
            "not_looked_at": sum("unobserved" in pair for pair in pairs),
        }

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        return {
            "map": self.map,
            "between": [self.before, self.after],
            "counts": dict(self.counts),
            "changes": [change.as_dict() for change in self.changes],
            "landmarks": [item.as_dict() for item in self.landmarks],
        }
