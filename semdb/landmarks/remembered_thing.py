"""Landmarks as arrays and back, so that what did not change is made once: all of them but what they are called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.landmarks.boxes import Box
from semdb.landmarks.expected import ExpectedView
from semdb.landmarks.memo import Arrays
from semdb.landmarks.values import BestView, Landmark, LandmarkState, Member
from semdb.landmarks.visits import Presence, Visit
from semdb.types import FloatArray, Int64Array

THING = "thing"  # kind of what is remembered
_STATES, _PRESENCES = list(LandmarkState), list(Presence)


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """Keyframes that have to do with a thing, ascending. What is remembered has them, and recordings, by rank."""

    keyframes: Int64Array  # [k]
    candidates: Int64Array  # those of them that may have it in view
    recordings: Int64Array  # [r] of the keyframes, ascending
    recording: Int64Array  # [k] rank of the recording of each keyframe

    def rank(self, keyframes: Int64Array) -> Int64Array:
        """Where keyframes stand among these."""
        return np.searchsorted(self.keyframes, keyframes)


def thing_arrays(thing: Landmark, around: Around, asked: Sequence[tuple[str, str]]) -> Arrays:
    """A landmark as arrays, with what was asked for to make it."""

    def ranks(keyframes: Sequence[int]) -> Int64Array:
        return around.rank(np.array(keyframes, np.int64))

    visits = thing.visits
    numbers = [
        (_PRESENCES.index(v.presence), v.keyframes, v.points, v.seen, v.seen_through, v.occluded, v.missed)
        for v in visits
    ]
    recordings = np.searchsorted(around.recordings, np.array([v.recording for v in visits], np.int64))
    boxed = np.array([v.box is not None for v in visits], np.int64)
    found = {
        "box": np.concatenate([_of_box(thing.box), thing.covariance]),
        "numbers": np.array([thing.missed, thing.seen_through, _STATES.index(thing.state)], np.int32),
        "shares": np.array([(m.coverage, m.visibility) for m in thing.members], np.float64).reshape(-1, 2),
        "view": np.stack(
            [ranks([v.keyframe for v in thing.views]), np.array([v.ordinal for v in thing.views], np.int64)]
        ),
        "views": np.array([(v.quality, v.distance) for v in thing.views], np.float64).reshape(-1, 2),
        "expect": ranks([v.keyframe for v in thing.expected]),
        "expected": np.array([(v.share, v.height, v.size) for v in thing.expected], np.float64).reshape(-1, 3),
        "visits": np.column_stack([recordings, boxed, np.array(numbers, np.int64).reshape(-1, 7)]),
        "boxes": np.array([_of_box(v.box) for v in visits if v.box is not None], np.float64).reshape(-1, 5, 3),
        "asked": np.array([f"{kind} {name}".encode() for kind, name in asked], np.bytes_),
    }
    return found if thing.colours is None else {**found, "colours": thing.colours}


def thing_from(found: Arrays, around: Around, objects: Sequence[tuple[int, int]]) -> Landmark:
    """A landmark of its `objects` (keyframe, ordinal) as `thing_arrays` has it; it is called nothing."""
    missed, seen_through, state = found["numbers"].tolist()
    keyframes, recordings = around.keyframes.tolist(), around.recordings.tolist()
    view, expect = found["view"].tolist(), found["expect"].tolist()
    boxes = iter(found["boxes"])
    visits = []
    for number, boxed, presence, shows, points, seen, through, occluded, absent in found["visits"].tolist():
        box = _box_of(next(boxes)) if boxed else None
        counts = (shows, points, seen, through, occluded, absent)
        visits.append(Visit(recordings[number], _PRESENCES[presence], *counts, box))
    members = tuple(Member(k, o, *pair) for (k, o), pair in zip(objects, found["shares"].tolist(), strict=True))
    return Landmark(
        members=members,
        category=-1,
        probability=0.0,
        evidence=np.empty(0),
        box=_box_of(found["box"][:5]),
        covariance=found["box"][5:],
        keyframes=len({member.keyframe for member in members}),
        missed=missed,
        seen_through=seen_through,
        first=members[0].keyframe,
        last=members[-1].keyframe,
        state=_STATES[state],
        views=tuple(
            BestView(keyframes[k], o, *pair) for k, o, pair in zip(*view, found["views"].tolist(), strict=True)
        ),
        colours=found.get("colours"),
        visits=tuple(visits),
        expected=tuple(
            ExpectedView(keyframes[k], *values) for k, values in zip(expect, found["expected"].tolist(), strict=True)
        ),
    )


def _of_box(box: Box) -> FloatArray:
    return np.concatenate([box.centre[None], box.size[None], box.axes])


def _box_of(rows: FloatArray) -> Box:
    return Box(rows[0], rows[1], rows[2:5])
