"""Whether the first hit of a search is right, in rendered rooms.

``python -m bench.landmarks.searching [--rooms N] [--first SEED] [--keyframes N]``. The landmarks of each room are a map
of one SQLite file, and the statement of ``semdb find`` is asked: every class that stands near, on, or not near another
class, and every class as seen from a few keyframes. True is what the same rules say of the true boxes of all things
that any keyframe shows. A question is asked where it has an answer for sure: where a thing that the detector found in
three keyframes has such a relation (a score of 0.7 or more; not near: 0.3 or less) to one that it found in three. The
first hit is right when it is a thing of that class which stands so (one half); nothing found is wrong. From a place,
also when no thing of the class is nearer by more than half a metre. *None where none is*: questions of the same kinds
that no thing is an answer to (0.3 or less), and how many of them find nothing. Needs no model file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import insert

from bench.landmarks.__main__ import SETTINGS
from bench.landmarks.rooms import (
    RenderedRoom,
    TrueThing,
    class_numbers,
    confusion_of,
    render_room,
    rooms_parser,
    seen_keyframes,
    true_things,
)
from bench.landmarks.scores import SEEN, as_landmark, main_label
from semdb.api.finding import find
from semdb.database import landmark_tables
from semdb.database.ids import SharedIds
from semdb.database.landmark_search import NEAR, ON
from semdb.database.store import Store, open_store
from semdb.landmarks.boxes import upright_axes
from semdb.landmarks.build import SeenKeyframe, find_landmarks
from semdb.landmarks.evidence import perhaps
from semdb.landmarks.relations import find_relations
from semdb.landmarks.sizes import sizes_of
from semdb.landmarks.values import Landmark, Landmarks
from semdb.types import FloatArray

UP = np.array([0.0, 0.0, 1.0])
SURE, HALF, NONE = 0.7, 0.5, 0.3
PLACES = 4  # keyframes of a room from which is asked
NEARER_M = 0.5
Scores = Mapping[tuple[int, str], float]  # of a thing and a class: the surest such relation


@dataclass(frozen=True, slots=True)
class Question:
    """A search, by the options of `find`, and labels of things: those that answer it, those that make it a question."""

    kind: str
    what: str
    asked: Mapping[str, Any]
    right: frozenset[int]
    sure: bool  # an answer is there and was seen well; otherwise there is none


@dataclass(frozen=True, slots=True)
class Tally:
    """Of the questions of a kind: asked, first hit right, nothing found; and of those without answer: asked, none."""

    asked: int = 0
    right: int = 0
    nothing: int = 0
    empty: int = 0
    none: int = 0

    def __add__(self, other: Tally) -> Tally:
        names = ("asked", "right", "nothing", "empty", "none")
        return Tally(*(getattr(self, name) + getattr(other, name) for name in names))


def questions(things: Mapping[int, TrueThing], seen: frozenset[int], places: Sequence[FloatArray]) -> list[Question]:
    """All questions of a room; `seen` are the things that the detector found in three keyframes."""
    keys = sorted(things)
    names = sorted({thing.category for thing in things.values()})
    of = {key: things[key].category for key in keys}
    related = find_relations([as_landmark(things[key], names) for key in keys], names, UP, 0.02)

    def scores(kinds: Sequence[str], among: frozenset[int]) -> dict[tuple[int, str], float]:
        found: dict[tuple[int, str], float] = {}
        for r in related:
            if r.kind in kinds and keys[r.other] in among:
                pair = keys[r.one], of[keys[r.other]]
                found[pair] = max(found.get(pair, 0.0), r.score)
        return found

    every = frozenset(keys)
    near, on = scores(NEAR, every), scores(ON, every)
    sure = {"near": scores(NEAR, seen), "on": scores(ON, seen)}
    listed: list[Question] = []
    for what in names:
        mine = [key for key in keys if of[key] == what]
        for other in names:
            for kind, truth in (("near", near), ("on", on)):
                right = frozenset(key for key in mine if truth.get((key, other), 0.0) >= HALF)
                well = any(key in seen and sure[kind].get((key, other), 0.0) >= SURE for key in mine)
                best = max(truth.get((key, other), 0.0) for key in mine)
                if well or best < NONE:
                    listed.append(Question(kind, what, {kind: other}, right, well))
            right = frozenset(key for key in mine if near.get((key, other), 0.0) < HALF)
            if any(key in seen and near.get((key, other), 0.0) < NONE for key in mine) and len(right) < len(mine):
                listed.append(Question("not near", what, {"not_near": other}, right, True))
        if not any(key in seen for key in mine):
            continue
        for place in places:
            away = {key: float(np.linalg.norm(things[key].box.centre - place)) for key in mine}
            least = min(value for key, value in away.items() if key in seen)
            right = frozenset(key for key, value in away.items() if value <= least + NEARER_M)
            x, y, z = (float(value) for value in place)
            listed.append(Question("from a place", what, {"origin": (x, y, z)}, right, True))
    return listed


def write(
    store: Store, map_name: str, found: Landmarks, names: Sequence[str], keyframes: Sequence[SeenKeyframe]
) -> list[int]:
    """The landmarks of keyframes as rows; their ids."""

    def named_of(thing: Landmark) -> list[int]:
        return [int(keyframes[m.keyframe].category[m.ordinal]) for m in thing.members]

    ids = SharedIds(store.engine).categories(names)
    map_id = store.ensure_map(map_name)
    axes = upright_axes(found.gravity.up)
    with store.engine.begin() as connection:
        first = (
            int(connection.execute(landmark_tables.landmarks.select().with_only_columns(_greatest())).scalar() or 0) + 1
        )
        keys = [first + number for number in range(len(found.landmarks))]
        rows = []
        for key, one in zip(keys, found.landmarks, strict=True):
            across = one.box.axes[:, 0] @ axes
            sides = dict(zip(("size_x", "size_y", "size_z"), map(float, one.box.size), strict=True))
            rows.append(
                {
                    **{"id": key, "map_id": map_id, "category_id": ids[names[one.category]], "evidence": "{}"},
                    **dict(zip("xyz", map(float, one.box.centre), strict=True)),
                    **{
                        "probability": one.probability,
                        **dict.fromkeys(landmark_tables.COVARIANCE_COLUMNS, 0.0),
                        **sides,
                    },
                    **{"yaw": float(np.arctan2(across[1], across[0])), "sightings": len(one.members)},
                    **{"keyframes": one.keyframes, "missed": one.missed, "seen_through": one.seen_through},
                    "state": str(one.state),
                }
            )
        connection.execute(insert(landmark_tables.landmarks), rows)
        related = [
            {
                **{"landmark_id": keys[r.one], "kind": str(r.kind), "other_landmark_id": keys[r.other]},
                **{"score": r.score, "other_category_id": ids[names[found.landmarks[r.other].category]]},
                **{"category_id": ids[names[found.landmarks[r.one].category]], "map_id": map_id},
            }
            for r in find_relations(found.landmarks, names, found.gravity.up)
        ]
        others = [
            {"landmark_id": key, "category_id": ids[names[k]], "map_id": map_id, "probability": share}
            for key, one in zip(keys, found.landmarks, strict=True)
            for k, share in perhaps(one.evidence, one.category, named_of(one)).items()
        ]
        for table, listed in (
            (landmark_tables.landmark_relations, related),
            (landmark_tables.landmark_categories, others),
        ):
            if listed:
                connection.execute(insert(table), listed)
    return keys


def _greatest() -> Any:
    from sqlalchemy import func

    return func.max(landmark_tables.landmarks.c.id)


@dataclass(frozen=True, slots=True)
class Asked:
    """A question with the label of its first hit, None where nothing was found."""

    question: Question
    hit: int | None
    category: str | None

    @property
    def is_right(self) -> bool:
        return self.hit is not None and self.hit in self.question.right


def ask(store: Store, room: RenderedRoom, setting: str) -> Iterator[Asked]:
    """All questions of a room, of what a detector with the mistakes of a setting makes of it."""
    numbers, things = class_numbers([room]), true_things(room)
    keyframes, labels = seen_keyframes(room, numbers, SETTINGS[setting])
    found = find_landmarks(
        keyframes, len(numbers), confusion_of(keyframes, len(numbers)), sizes=sizes_of(list(numbers))
    )
    counts: dict[int, int] = {}
    for frame in labels:
        for label in set(frame):
            counts[label] = counts.get(label, 0) + 1
    seen = frozenset(key for key in things if counts.get(key, 0) >= SEEN and things[key].keyframes >= SEEN)
    name = f"room {room.seed}, {setting}"
    keys = write(store, name, found, list(numbers), keyframes)
    label_of = {key: main_label(one, labels) for key, one in zip(keys, found.landmarks, strict=True)}
    places = [frame.pose[:3, 3] for frame in room.frames[:: max(1, len(room.frames) // PLACES)]]
    for question in questions(things, seen, places):
        answer = find(store, question.what, map=name, limit=1, **question.asked)
        hit = answer.hits[0] if answer.hits else None
        yield Asked(question, None if hit is None else label_of[hit.landmark_id], None if hit is None else hit.category)


def tallies(asked: Sequence[Asked]) -> dict[str, Tally]:
    """By kind of question."""
    found: dict[str, Tally] = {}
    for one in asked:
        right, nothing = int(one.is_right), int(one.hit is None)
        of = Tally(1, right, nothing, 0, 0) if one.question.sure else Tally(0, 0, 0, 1, nothing)
        found[one.question.kind] = found.get(one.question.kind, Tally()) + of
    return found


def main() -> None:
    parser = rooms_parser(__doc__)
    given = parser.parse_args()
    asked: dict[str, list[Asked]] = {name: [] for name in SETTINGS}
    with (
        tempfile.TemporaryDirectory() as folder,
        open_store(f"sqlite:///{Path(folder) / 'rooms.sqlite3'}", create=True) as store,
    ):
        for seed in range(given.first, given.first + given.rooms):
            room = render_room(seed, given.keyframes, given.width)
            for name in asked:
                asked[name] += ask(store, room, name)
            print(f"room {seed}", flush=True)
    print(f"{'':24}{'kind':14}{'asked':>7}{'right':>7}{'share':>7}{'nothing':>9}{'none where none is':>20}")
    for name, answers in asked.items():
        found = tallies(answers)
        found["all"] = sum(found.values(), Tally())
        for kind, one in found.items():
            share, rest = one.right / max(one.asked, 1), f"{one.none:10d} of {one.empty}"
            print(f"{name:24}{kind:14}{one.asked:7d}{one.right:7d}{share:7.3f}{one.nothing:9d}{rest}")


if __name__ == "__main__":
    main()
