"""What changed between two visits: things that appeared, that are gone, and that stand somewhere else.

Only a place that was looked at says that something was not there: of a thing that one visit shows, the other one has to
see through where it stood. Things that were gone here and are new there are assigned to each other one to one, by
class, size and colours; the best assignment is that of the largest sum (Kuhn and Munkres).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.optimize import linear_sum_assignment

from semdb.landmarks.visits import Presence
from semdb.types import Float32Array, FloatArray

LEAST_MOVED_M = 0.04  # a thing that both visits show has moved by at least this,
LEAST_THROUGH = 0.1  # and so much of its points is seen through from the other visit
LEAST_KEYFRAMES = 2  # that show a thing which appeared or disappeared
LEAST_MISSED = 2  # keyframes that look at the place of a flat thing and find none
GLIMPSED = 0.2  # of the points that are seen through where most are hidden
CONTRADICTED = 0.3  # of the points that are seen: something is there
HIDDEN = 0.7  # how sure it is of a thing that it was not there, of whose place next to nothing was seen
LEAST_SCORE, LEAST_FAR, FAR_M = 0.25, 0.45, 2.0  # of a pair that lies together, and of one that lies so far apart
CARRIED_M = 4.0  # a thing that stands so far away is half as likely the same one
SIZE_RATIO = 2.5  # of the sides of two boxes: where they differ so, they are half as alike
UNKNOWN_COLOURS = 0.6
OTHER_CLASS = 0.42  # two names are so much alike at least: all else has to agree


class Change(StrEnum):
    """What happened to a thing between two visits."""

    APPEARED = "appeared"
    DISAPPEARED = "disappeared"
    MOVED = "moved"


@dataclass(frozen=True, slots=True, eq=False)
class SeenIn:
    """What one visit says of a thing; `centre` and `size` ``[3]`` metres of what it saw of it, None without."""

    presence: Presence
    keyframes: int
    points: int
    seen: int
    seen_through: int
    occluded: int
    missed: int
    centre: FloatArray | None
    size: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class VisitedThing:
    """A landmark as two visits see it (None: never in view). `evidence`: probabilities of classes."""

    key: int
    evidence: Mapping[str, float]
    colours: Float32Array | None
    before: SeenIn | None
    after: SeenIn | None


@dataclass(frozen=True, slots=True, eq=False)
class Changed:
    """A change: the thing of the earlier visit, that of the later one (the same where one landmark shows both)."""

    kind: Change
    before: VisitedThing | None
    after: VisitedThing | None
    score: float  # 0..1
    distance: float | None  # metres


def find_changes(things: Sequence[VisitedThing]) -> list[Changed]:
    """All changes, by kind and the keys of the things."""
    found = [change for thing in things if (change := _in_place(thing)) is not None]
    old = [(t, sure) for t in things if (sure := _only(t.before, t.after)) > 0]
    new = [(t, sure) for t in things if (sure := _only(t.after, t.before)) > 0]
    taken: set[int] = set()
    if old and new:
        score = np.array([[alike(one, other) * _both(a, b) for other, b in new] for one, a in old])
        apart = np.array([[_apart(one.before, other.after) or 0.0 for other, _ in new] for one, _ in old])
        least = LEAST_SCORE + (LEAST_FAR - LEAST_SCORE) * np.minimum(apart / FAR_M, 1.0)
        score = np.where(score >= least, score, 0.0)
        for row, column in zip(*linear_sum_assignment(-score), strict=True):
            if score[row, column] > 0:
                one, other = old[row][0], new[column][0]
                taken |= {one.key, other.key}
                found.append(
                    Changed(
                        Change.MOVED, one, other, round(float(score[row, column]), 6), _apart(one.before, other.after)
                    )
                )
    for thing, _ in old:
        if thing.key not in taken and _gone(thing.before, thing.after):
            found.append(Changed(Change.DISAPPEARED, thing, None, _share(thing.after), None))
    for thing, _ in new:
        if thing.key not in taken and _gone(thing.after, thing.before):
            found.append(Changed(Change.APPEARED, None, thing, _share(thing.before), None))
    return sorted(found, key=_rank)


def _both(one: float, other: float) -> float:
    """How sure it is of two things that each is in one visit alone: one of them has to be."""
    return one * other if max(one, other) >= 1.0 else 0.0


def _rank(change: Changed) -> tuple[str, int, int]:
    one, other = change.before, change.after
    return str(change.kind), -1 if one is None else one.key, -1 if other is None else other.key


def _in_place(thing: VisitedThing) -> Changed | None:
    """A thing that both visits show, a little way off: each sees through where only the other one found it."""
    one, other = thing.before, thing.after
    if one is None or other is None or one.centre is None or other.centre is None:
        return None
    through, points = one.seen_through + other.seen_through, one.points + other.points
    distance = _apart(one, other)
    if distance is None or distance < LEAST_MOVED_M or through < LEAST_THROUGH * max(points, 1):
        return None
    return Changed(Change.MOVED, thing, thing, round(min(1.0, 2 * through / points), 6), distance)


def _only(shows: SeenIn | None, other: SeenIn | None) -> float:
    """How sure it is that of two visits one alone shows a thing, 0..1."""
    if shows is None or other is None or shows.presence is not Presence.PRESENT:
        return 0.0
    if other.presence is Presence.ABSENT:
        return 1.0
    if other.presence is not Presence.UNOBSERVED:
        return 0.0
    # where half of it is hidden, or it lies flat and is never seen through: enough if it is found elsewhere, and for
    # nothing else
    glimpsed = other.seen_through >= max(GLIMPSED * other.points, 1)
    if (glimpsed and other.seen_through >= 2 * other.seen) or other.missed >= LEAST_MISSED:
        return 1.0
    if other.seen <= CONTRADICTED * other.points:
        return HIDDEN
    return other.seen_through / (other.seen_through + other.seen) if glimpsed else 0.0


def _gone(shows: SeenIn | None, other: SeenIn | None) -> bool:
    absent = other is not None and other.presence is Presence.ABSENT
    return absent and shows is not None and shows.keyframes >= LEAST_KEYFRAMES


def _share(seen: SeenIn | None) -> float:
    return 0.0 if seen is None else round(seen.seen_through / max(seen.points, 1), 6)


def _apart(one: SeenIn | None, other: SeenIn | None) -> float | None:
    if one is None or other is None or one.centre is None or other.centre is None:
        return None
    return round(float(np.linalg.norm(one.centre - other.centre)), 6)


def alike(one: VisitedThing, other: VisitedThing) -> float:
    """How far two things may be the same one, 0..1: classes, sizes and colours."""
    first, second = one.before, other.after
    if first is None or second is None or first.size is None or second.size is None:
        return 0.0
    names = set(one.evidence) & set(other.evidence)
    classes = sum(float(np.sqrt(one.evidence[name] * other.evidence[name])) for name in sorted(names))
    # a flat thing is as long either way round
    a, b = np.sort(np.maximum(first.size, 0.03)), np.sort(np.maximum(second.size, 0.03))
    off = np.abs(np.log(a / b)) / np.log(SIZE_RATIO)
    size = float(np.exp2(-np.mean(off) * 2))
    colours = UNKNOWN_COLOURS
    if one.colours is not None and other.colours is not None and one.colours.any() and other.colours.any():
        colours = float(np.clip(one.colours @ other.colours, 0, 1))
    distance = _apart(first, second) or 0.0
    return min(1.0, max(classes, OTHER_CLASS)) * size * colours * float(np.exp2(-distance / CARRIED_M))
