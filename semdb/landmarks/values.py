"""What the computation of landmarks gives: frozen values, with keyframes and objects by number."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from semdb.landmarks.boxes import Box
from semdb.landmarks.expected import ExpectedView
from semdb.landmarks.gravity import Gravity
from semdb.landmarks.visits import Visit
from semdb.types import Float32Array, FloatArray


class LandmarkState(StrEnum):
    """`tentative`: too few keyframes see it; `gone`: later ones see through the place where it stood."""

    TENTATIVE = "tentative"
    CONFIRMED = "confirmed"
    GONE = "gone"


@dataclass(frozen=True, slots=True)
class Member:
    """An object that shows a landmark: `visibility` is the share of the landmark's points that its keyframe sees,
    `coverage` the share of those that lie in its mask.
    """

    keyframe: int
    ordinal: int
    coverage: float
    visibility: float


@dataclass(frozen=True, slots=True)
class BestView:
    """A keyframe from which a landmark is well seen, and the object there; `distance` in metres."""

    keyframe: int
    ordinal: int
    quality: float  # 0..1
    distance: float


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """A thing. Keyframes are numbered by recording's name and frame, classes as in what it was computed from."""

    members: tuple[Member, ...]  # by keyframe and ordinal
    category: int
    probability: float
    evidence: FloatArray  # [classes] probabilities
    box: Box
    covariance: FloatArray  # [3, 3] of the box's centre, square metres
    keyframes: int  # that show it
    missed: int  # keyframes that should show it and do not
    seen_through: int  # keyframes that see what is behind its place
    first: int  # keyframe
    last: int
    state: LandmarkState
    views: tuple[BestView, ...]  # the best first
    colours: Float32Array | None = None  # the mean of its sightings', see `appearance`
    visits: tuple[Visit, ...] = ()  # by number of the recording
    expected: tuple[ExpectedView, ...] = ()  # by keyframe: those that see it and have no object there

    @property
    def key(self) -> tuple[int, int]:
        """Of all landmarks of a map, another one each: its first sighting."""
        return self.members[0].keyframe, self.members[0].ordinal


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """All landmarks of a map, by their first sightings, and what was found out on the way."""

    landmarks: tuple[Landmark, ...]
    gravity: Gravity
    moved_m: float  # median motion of the keyframes until their depths agreed
    without_place: int  # objects that have no depth
