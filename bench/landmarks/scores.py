"""How well landmarks agree with the things that are there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.landmarks.rooms import LEAST_SIDE, TrueThing
from semdb.landmarks.boxes import intersection_over_union
from semdb.landmarks.relations import find_relations
from semdb.landmarks.values import Landmark, LandmarkState

SEEN = 3  # keyframes in which the detector found a thing: from here on it has to be there
THRESHOLDS = (0.25, 0.5)


@dataclass(frozen=True, slots=True)
class Score:
    """Counts over the confirmed landmarks of one or more maps."""

    things: int  # seen in at least three keyframes
    landmarks: int  # confirmed
    found: tuple[int, int]  # of the things, at each threshold
    wrong: tuple[int, int]  # landmarks that are none of the things, however rarely seen
    duplicates: int  # landmarks of a thing that has another one
    right_class: int  # of the landmarks that are a thing
    class_of: int  # landmarks that are a thing
    centres: tuple[float, ...]  # metres, of matched landmarks
    pairs: tuple[int, int, int]  # of sightings: joined rightly, joined wrongly, left apart wrongly

    def f1(self, which: int) -> float:
        found, wrong = self.found[which], self.wrong[which]
        return 2 * found / max(2 * found + wrong + self.things - found, 1)

    @property
    def line(self) -> str:
        right, joined, apart = self.pairs
        precision, recall = right / max(right + joined, 1), right / max(right + apart, 1)
        centre = float(np.median(self.centres)) if self.centres else float("nan")
        return (
            f"{self.things:7d}{self.landmarks:10d}{self.f1(0):8.3f}{self.f1(1):8.3f}"
            f"{self.duplicates / max(self.landmarks, 1):12.4f}{centre:10.4f}"
            f"{self.right_class / max(self.class_of, 1):8.3f}{precision:11.4f}{recall:9.4f}"
        )


HEADER = (
    f"{'things':>7}{'landmarks':>10}{'F1 .25':>8}{'F1 .5':>8}{'duplicates':>12}{'centre m':>10}{'class':>8}"
    f"{'pairs P':>11}{'pairs R':>9}"
)


def score(
    landmarks: Sequence[Landmark],
    labels: Sequence[Sequence[int]],
    things: Mapping[int, TrueThing],
    names: Sequence[str],
) -> Score:
    """`labels` are the true labels of the objects of each keyframe, `things` the truth by label."""
    sightings: dict[int, int] = {}
    for frame in labels:
        for label in set(frame):
            sightings[label] = sightings.get(label, 0) + 1
    wanted = [k for k in things if things[k].keyframes >= SEEN and sightings.get(k, 0) >= SEEN]
    there = [thing for thing in landmarks if thing.state is LandmarkState.CONFIRMED]
    keys = sorted(things)
    overlap = np.zeros((len(there), len(keys)))
    for row, thing in enumerate(there):
        for column, key in enumerate(keys):
            box = things[key].box
            if np.linalg.norm(box.centre - thing.box.centre) < (box.size.max() + thing.box.size.max()):
                own = replace(thing.box, size=np.maximum(thing.box.size, LEAST_SIDE))
                overlap[row, column] = intersection_over_union(own, box)
    found, wrong, centres, right, classes = [], [], [], 0, 0
    for threshold in THRESHOLDS:
        rows, columns = linear_sum_assignment(-np.where(overlap >= threshold, 1 + overlap, 0.0))
        matched = {keys[c]: int(r) for r, c in zip(rows, columns, strict=True) if overlap[r, c] >= threshold}
        found.append(sum(key in matched for key in wanted))
        wrong.append(len(there) - len(matched))
        if threshold == THRESHOLDS[0]:
            for key, row in matched.items():
                centres.append(float(np.linalg.norm(there[row].box.centre - things[key].box.centre)))
                right += names[there[row].category] == things[key].category
                classes += 1
    main = [main_label(thing, labels) for thing in there]
    pairs = _pairs(landmarks, labels)
    duplicates = len(main) - len(set(main))
    return Score(
        *(len(wanted), len(there), (found[0], found[1]), (wrong[0], wrong[1]), duplicates),
        *(right, classes, tuple(centres), pairs),
    )


def main_label(thing: Landmark, labels: Sequence[Sequence[int]]) -> int:
    """The label that most of a landmark's sightings have."""
    counts: dict[int, int] = {}
    for member in thing.members:
        label = labels[member.keyframe][member.ordinal]
        counts[label] = counts.get(label, 0) + 1
    return max(counts, key=lambda label: (counts[label], -label))


def _pairs(landmarks: Sequence[Landmark], labels: Sequence[Sequence[int]]) -> tuple[int, int, int]:
    total: dict[int, int] = {}
    right, joined = 0, 0
    for thing in landmarks:
        counts: dict[int, int] = {}
        for member in thing.members:
            label = labels[member.keyframe][member.ordinal]
            counts[label] = counts.get(label, 0) + 1
            total[label] = total.get(label, 0) + 1
        same = sum(n * (n - 1) // 2 for n in counts.values())
        right += same
        joined += len(thing.members) * (len(thing.members) - 1) // 2 - same
    return right, joined, sum(n * (n - 1) // 2 for n in total.values()) - right


def relation_counts(
    landmarks: Sequence[Landmark],
    labels: Sequence[Sequence[int]],
    things: Mapping[int, TrueThing],
    names: Sequence[str],
    kinds: Sequence[str] = ("on", "in", "under", "above", "next_to", "near"),
) -> dict[str, tuple[int, int, int]]:
    """Relations of the landmarks against those of the true boxes: right, wrong, missed, by kind.

    Between confirmed landmarks, one of each thing, with scores of at least one half; where the true boxes give 0.3 to
    0.7 it may be either.
    """
    there = {main_label(thing, labels): thing for thing in landmarks if thing.state is LandmarkState.CONFIRMED}
    keys = sorted(key for key in there if key in things)
    up = np.array([0.0, 0.0, 1.0])
    true = [as_landmark(things[key], names) for key in keys]

    def scores_of(of: Sequence[Landmark]) -> dict[tuple[int, str, int], float]:
        return {(r.one, str(r.kind), r.other): r.score for r in find_relations(of, names, up, 0.05)}

    found, wanted = (
        scores_of([replace(there[key], category=t.category) for key, t in zip(keys, true, strict=True)]),
        scores_of(true),
    )
    counts = {}
    for kind in kinds:
        mine = {key: value for key, value in found.items() if key[1] == kind}
        theirs = {key: value for key, value in wanted.items() if key[1] == kind}
        right = sum(value >= 0.5 and mine.get(key, 0) >= 0.5 for key, value in theirs.items())
        missed = sum(value > 0.7 and mine.get(key, 0) < 0.5 for key, value in theirs.items())
        wrong = sum(value >= 0.5 and theirs.get(key, 0) < 0.3 for key, value in mine.items())
        counts[kind] = (right, wrong, missed)
    return counts


def as_landmark(thing: TrueThing, names: Sequence[str]) -> Landmark:
    """A true thing as if it were a landmark that is known to a millimetre."""
    category = list(names).index(thing.category)
    evidence, sure = np.zeros(len(names)), np.eye(3) * 1e-6
    return Landmark((), category, 1.0, evidence, thing.box, sure, 3, 0, 0, 0, 0, LandmarkState.CONFIRMED, ())


def summed(scores: Sequence[Score]) -> Score:
    """One score of several maps."""

    def pair(name: str) -> tuple[int, int]:
        return sum(getattr(s, name)[0] for s in scores), sum(getattr(s, name)[1] for s in scores)

    right, joined, apart = (sum(s.pairs[k] for s in scores) for k in range(3))
    return Score(
        *(sum(s.things for s in scores), sum(s.landmarks for s in scores), pair("found"), pair("wrong")),
        *(sum(s.duplicates for s in scores), sum(s.right_class for s in scores), sum(s.class_of for s in scores)),
        *(tuple(c for s in scores for c in s.centres), (right, joined, apart)),
    )
