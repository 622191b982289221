"""Landmarks of many rendered rooms in one map against exact instance truth.

``python -m bench.landmarks.together [--rooms N] [--first SEED] [--keyframes N] [--settings NAME ...]``. Rooms of so
many seeds, the middles of neighbours 20 m apart, are one map of one recording; settings and scores are those of
``bench.landmarks``. *Across*: landmarks with sightings of two rooms.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

from bench.landmarks.__main__ import SETTINGS
from bench.landmarks.rooms import (
    RenderedRoom,
    TrueThing,
    class_numbers,
    render_room,
    rooms_parser,
    seen_keyframes,
    true_things,
)
from bench.landmarks.scores import HEADER, score
from semdb.landmarks.build import SeenKeyframe, find_landmarks
from semdb.landmarks.sizes import sizes_of
from semdb.landmarks.values import Landmarks
from semdb.recordings.synthetic.room import build_room

PLACE = 10_000  # what the labels of one room are greater by than those of the one before


class Building:
    """Keyframes of rooms beside each other, as each setting has them, with labels and things of all of them."""

    def __init__(self, settings: Sequence[str], numbers: dict[str, int]) -> None:
        self.numbers = numbers
        self.keyframes: dict[str, list[SeenKeyframe]] = {name: [] for name in settings}
        self.labels: dict[str, list[list[int]]] = {name: [] for name in settings}
        self.things: dict[int, TrueThing] = {}
        self._rooms = 0

    def add(self, room: RenderedRoom) -> None:
        base = PLACE * self._rooms
        self._rooms += 1
        self.things |= {base + label: thing for label, thing in true_things(room).items()}
        for name in self.keyframes:
            mine, labels = seen_keyframes(room, self.numbers, SETTINGS[name])
            self.keyframes[name] += mine
            self.labels[name] += [[base + label for label in frame] for frame in labels]


def across(found: Landmarks, labels: Sequence[Sequence[int]]) -> int:
    """How many landmarks have sightings of two rooms."""
    rooms = ({labels[m.keyframe][m.ordinal] // PLACE for m in thing.members} for thing in found.landmarks)
    return sum(len(of) > 1 for of in rooms)


def rooms_of(first: int, rooms: int, keyframes: int, width: int) -> Iterator[RenderedRoom]:
    """The rooms of so many seeds, each at its own place."""
    for number in range(rooms):
        yield render_room(first + number, keyframes, width, place=number)


def names_of(first: int, rooms: int) -> dict[str, int]:
    """A number for every name that things of these rooms may go by; nothing is rendered."""

    class Named:
        def __init__(self, seed: int) -> None:
            self.classes = build_room(seed).classes()

    return class_numbers([Named(first + number) for number in range(rooms)])  # type: ignore[misc]


def main() -> None:
    parser = rooms_parser(__doc__, rooms=20)
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=["exact", "mistakes"])
    given = parser.parse_args()
    building = Building(given.settings, names_of(given.first, given.rooms))
    for number, room in enumerate(rooms_of(given.first, given.rooms, given.keyframes, given.width)):
        building.add(room)
        print(f"room {number + 1} of {given.rooms}", flush=True)
    print(f"{'':24}{HEADER}{'across':>8}{'seconds':>9}")
    for name, keyframes in building.keyframes.items():
        start = time.process_time()
        found = find_landmarks(keyframes, len(building.numbers), sizes=sizes_of(list(building.numbers)))
        seconds = time.process_time() - start
        line = score(found.landmarks, building.labels[name], building.things, list(building.numbers)).line
        print(f"{name:24}{line}{across(found, building.labels[name]):8d}{seconds:9.0f}", flush=True)


if __name__ == "__main__":
    main()
