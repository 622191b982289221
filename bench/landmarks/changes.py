"""Changes between two visits of rendered rooms, against what was moved and taken away.

``python -m bench.landmarks.changes [--rooms N] [--first SEED] [--keyframes N]``. A first visit of each room and
a second one, in which about half of the chairs and small things have moved and 15 % of the small ones are gone, are one
map; once in that order, and once the other way round, so that what was taken away appears. Settings are those of
``bench.landmarks``. What is told counts as right where it is so: a thing that was moved is not where it was, whether
or not it was found elsewhere. What has to be told: each thing that the detector found in three keyframes of both
visits, and whose middle moved by 5 cm, as moved; each that it found in three keyframes and that was taken away. Not one
thing may be called absent whose place was not looked at. *Looked at* is the recall of those that could be told: of
which exact depth shows at least half of where it was in the other visit, and of where it is now in the first. Seeds
below 403 were tuned on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.landmarks.__main__ import SETTINGS
from bench.landmarks.rooms import Mistakes, RenderedRoom, class_numbers, render_visit, rooms_parser, seen_keyframes
from bench.landmarks.scores import SEEN, main_label
from semdb.landmarks.build import SeenKeyframe, find_landmarks
from semdb.landmarks.changes import Change, SeenIn, VisitedThing, find_changes
from semdb.landmarks.sizes import sizes_of
from semdb.landmarks.values import Landmark
from semdb.landmarks.visits import Presence, Visit
from semdb.types import FloatArray

LEAST_MOVED_M = 0.05
TAKEN = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class TwoVisits:
    """A room as two visits find it; labels of what was moved (with where to), and of what was taken away between."""

    visits: tuple[RenderedRoom, RenderedRoom]
    apart: dict[int, float]  # metres, of all that moved
    taken: frozenset[int]
    back: bool = False  # the second visit comes first: what was taken away appears


def render_two(seed: int, keyframes: int = 24, width: int = 640) -> TwoVisits:
    """Two visits of the room of a seed."""
    first, second = (render_visit(seed, keyframes, width, share) for share in (None, TAKEN))
    apart = {
        label: float(np.linalg.norm(first.places[label][:3, 3] - second.places[label][:3, 3])) for label in second.moved
    }
    return TwoVisits((first.room, second.room), apart, frozenset(second.taken))


def turned(two: TwoVisits) -> TwoVisits:
    """The same, the other way round."""
    return replace(two, visits=(two.visits[1], two.visits[0]), back=not two.back)


@dataclass(frozen=True, slots=True)
class Told:
    """Counts: what was told, what of it is wrong, what had to be told and was, and absent ones not looked at."""

    told: int
    wrong: int
    wanted: int
    found: int
    looked: int
    looked_found: int
    unlooked: int
    kinds: tuple[tuple[str, int], ...]

    @property
    def line(self) -> str:
        kinds = ", ".join(f"{count} {kind}" for kind, count in self.kinds)
        precision, recall = 1 - self.wrong / max(self.told, 1), self.found / max(self.wanted, 1)
        looked = self.looked_found / max(self.looked, 1)
        return (
            f"{self.told:6d}{precision:11.3f}{self.wanted:8d}{recall:9.3f}{self.looked:11d}{looked:9.3f}"
            f"{self.unlooked:10d}   {kinds}"
        )


HEADER = f"{'told':>6}{'precision':>11}{'wanted':>8}{'recall':>9}{'looked at':>11}{'recall':>9}{'unlooked':>10}"


def measure(two: TwoVisits, mistakes: Mistakes) -> Told:
    """What is told of two visits, against what was done to the room."""
    numbers = class_numbers(two.visits)
    keyframes: list[SeenKeyframe] = []
    labels: list[list[int]] = []
    counts: list[Counter[int]] = []
    for number, room in enumerate(two.visits):
        other = replace(room, seed=room.seed + 1000 * number)  # other mistakes
        mine, true = seen_keyframes(other, numbers, mistakes, recording=number)
        keyframes += mine
        labels += true
        counts.append(Counter(label for frame in true for label in set(frame)))
    found = find_landmarks(keyframes, len(numbers), sizes=sizes_of(list(numbers))).landmarks
    main = [main_label(thing, labels) for thing in found]
    changes = find_changes([visited(k, thing, list(numbers)) for k, thing in enumerate(found)])
    wrong, right = 0, set()
    gone_kind, new_kind = Change.DISAPPEARED, Change.APPEARED
    taken_kind = new_kind if two.back else gone_kind
    for change in changes:
        things = [main[thing.key] for thing in (change.before, change.after) if thing is not None]
        moved = all(label in two.apart for label in things) and len(set(things)) == 1
        taken = change.kind is taken_kind and things[0] in two.taken
        wrong += not (moved or taken)
        if taken or (moved and change.kind is Change.MOVED):
            right.add(things[0])
    wanted = {
        label
        for label, apart in two.apart.items()
        if apart >= LEAST_MOVED_M and all(count[label] >= SEEN for count in counts)
    } | {label for label in two.taken if counts[int(two.back)][label] >= SEEN}
    looked = {label for label in wanted if _looked_at(two, label)}
    return Told(
        *(len(changes), wrong, len(wanted), len(wanted & right), len(looked), len(looked & right)),
        sum(_unlooked(thing, main[k], two) for k, thing in enumerate(found)),
        tuple(sorted(Counter(str(change.kind) for change in changes).items())),
    )


def _looked_at(two: TwoVisits, label: int) -> bool:
    """Whether each visit had half of where the other one saw a thing in view, and nothing in front of it."""
    one, other = two.visits
    if label in two.taken:
        return _in_view(other, one, label) if two.back else _in_view(one, other, label)
    return _in_view(one, other, label) and _in_view(other, one, label)


def _in_view(shows: RenderedRoom, looks: RenderedRoom, label: int, step: int = 4, near: float = 0.02) -> bool:
    camera, parts = shows.camera, []
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    for frame in shows.frames:
        mine = frame.labels[v, u] == label
        z = frame.depth[v, u][mine].astype(np.float64)
        rays = np.stack([(u[mine] - camera.cx) / camera.fx * z, (v[mine] - camera.cy) / camera.fy * z, z], axis=1)
        parts.append(rays @ frame.pose[:3, :3].T + frame.pose[:3, 3])
    points = np.concatenate(parts)
    seen = np.zeros(len(points), np.bool_)
    for frame in looks.frames:
        local = (points - frame.pose[:3, 3]) @ frame.pose[:3, :3]
        ahead = local[:, 2] > 0.1
        z = np.where(ahead, local[:, 2], 1.0)
        x = np.rint(local[:, 0] / z * camera.fx + camera.cx).astype(int)
        y = np.rint(local[:, 1] / z * camera.fy + camera.cy).astype(int)
        inside = ahead & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        seen[inside] |= frame.depth[y[inside], x[inside]] > z[inside] - near
    return bool(len(points)) and bool(seen.mean() >= 0.5)


def _unlooked(thing: Landmark, label: int, two: TwoVisits) -> int:
    """Visits that call a thing absent which is there, or at whose place they did not look."""
    wrong = 0
    for visit in thing.visits:
        if visit.presence is Presence.ABSENT:
            there = label not in two.apart and label not in two.taken
            wrong += there or visit.seen_through == 0
    return wrong


def visited(key: int, thing: Landmark, names: Sequence[str]) -> VisitedThing:
    """A landmark of two recordings, 0 and 1, as changes are found from."""
    by_number = {visit.recording: visit for visit in thing.visits}
    evidence = {name: float(value) for name, value in zip(names, thing.evidence, strict=True) if value > 0.0005}
    return VisitedThing(key, evidence, thing.colours, _seen(by_number.get(0)), _seen(by_number.get(1)))


def _seen(visit: Visit | None) -> SeenIn | None:
    if visit is None:
        return None
    box: tuple[FloatArray | None, FloatArray | None] = (None, None)
    if visit.box is not None:
        box = visit.box.centre, visit.box.size
    counts = (visit.points, visit.seen, visit.seen_through, visit.occluded, visit.missed)
    return SeenIn(visit.presence, visit.keyframes, *counts, *box)


def summed(found: Sequence[Told]) -> Told:
    """One of several rooms."""
    kinds: Counter[str] = Counter()
    for one in found:
        kinds.update(dict(one.kinds))
    names = ("told", "wrong", "wanted", "found", "looked", "looked_found", "unlooked")
    counts = [sum(getattr(one, name) for one in found) for name in names]
    return Told(*counts, tuple(sorted(kinds.items())))


def main() -> None:
    parser = rooms_parser(__doc__)
    given = parser.parse_args()
    found: dict[str, list[Told]] = {name: [] for name in SETTINGS}
    for seed in range(given.first, given.first + given.rooms):
        two = render_two(seed, given.keyframes, given.width)
        for name, mistakes in SETTINGS.items():
            found[name] += [measure(two, mistakes), measure(turned(two), mistakes)]
        print(f"room {seed}: {len(two.apart)} moved, {len(two.taken)} taken away", flush=True)
    print(f"{'':24}{HEADER}")
    for name, of_rooms in found.items():
        print(f"{name:24}{summed(of_rooms).line}")


if __name__ == "__main__":
    main()
