"""Landmarks of a real recording against things that were written down by eye.

``python -m bench.landmarks.real DATABASE_URL MAP LABELS``. The map has to be ingested and refined, and LABELS is a file
of ``tests/data``: names, classes, and rough places. A confirmed landmark is right when it has a class of a thing and
stands at its place; a second one of the same thing is a duplicate. One that has a class and stands at the place of what
LABELS call ``either`` is left out: whether such things are of the class is arguable. Beside it: in how many keyframes
the detector saw each thing, an object of a class of it the middle of which lies at its place, one thing an object, and
recall among things that it saw in at least three.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.landmarks.scores import SEEN
from semdb.database.landmark_reading import StoredLandmark, load_landmarks
from semdb.database.store import Store, open_store
from semdb.geometry import transform_points


@dataclass(frozen=True, slots=True)
class Tally:
    """Names of things found and missed, and classes of landmarks that are wrong or there twice."""

    found: tuple[str, ...]
    missed: tuple[str, ...]
    wrong: tuple[str, ...]
    twice: tuple[str, ...]

    @property
    def precision(self) -> float:
        number = len(self.found) + len(self.wrong) + len(self.twice)
        return len(self.found) / max(number, 1)

    @property
    def recall(self) -> float:
        return len(self.found) / max(len(self.found) + len(self.missed), 1)

    @property
    def duplicates(self) -> float:
        return len(self.twice) / max(len(self.found) + len(self.wrong) + len(self.twice), 1)


def tally(
    landmarks: Sequence[StoredLandmark], things: Sequence[dict[str, Any]], either: Sequence[dict[str, Any]] = ()
) -> Tally:
    """Confirmed landmarks against things, one to one; those of what may be `either` right or wrong are left out."""
    there = [item for item in landmarks if item.state == "confirmed"]
    cost = np.full((len(there), len(things)), 1e6)
    for row, item in enumerate(there):
        for column, thing in enumerate(things):
            if _is_at(item, thing):
                cost[row, column] = float(np.linalg.norm(np.array(item.position) - thing["place"]))
    rows, columns = linear_sum_assignment(cost)
    matched = {int(r): int(c) for r, c in zip(rows, columns, strict=True) if cost[r, c] < 1e6}
    rest = [k for k in range(len(there)) if k not in matched and not any(_is_at(there[k], one) for one in either)]
    twice = [k for k in rest if cost[k].min(initial=1e6) < 1e6]
    return Tally(
        tuple(things[c]["name"] for c in matched.values()),
        tuple(thing["name"] for k, thing in enumerate(things) if k not in matched.values()),
        tuple(f"{there[k].category} {there[k].id}" for k in rest if k not in twice),
        tuple(f"{there[k].category} {there[k].id}" for k in twice),
    )


def _is_at(landmark: StoredLandmark, thing: dict[str, Any]) -> bool:
    away = float(np.linalg.norm(np.array(landmark.position) - thing["place"]))
    return landmark.category in thing["classes"] and away <= thing["within"]


def keyframes_that_saw(store: Store, map_id: int, things: Sequence[dict[str, Any]]) -> list[int]:
    """In how many keyframes the detector saw each thing: its objects, each taken for the nearest thing of its class."""
    seen: list[set[int]] = [set() for _ in things]
    for one in store.iter_objects(map_id):
        place = transform_points(one.world_from_camera, np.array([one.centroid]))[0]
        away = [
            float(np.linalg.norm(place - thing["place"])) if one.category in thing["classes"] else np.inf
            for thing in things
        ]
        nearest = int(np.argmin(away))
        if away[nearest] <= things[nearest]["within"]:
            seen[nearest].add(one.keyframe)
    return [len(keyframes) for keyframes in seen]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("database")
    parser.add_argument("map")
    parser.add_argument("labels", type=Path)
    given = parser.parse_args()
    labels = json.loads(given.labels.read_text(encoding="utf-8"))
    things = labels["things"]
    with open_store(given.database) as store:
        map_id = store.find_map(given.map).id
        landmarks, _ = load_landmarks(store.engine, map_id)
        seen = dict(zip([thing["name"] for thing in things], keyframes_that_saw(store, map_id, things), strict=True))
    found = tally(landmarks, things, labels.get("either", ()))
    print(f"precision {found.precision:.3f}, recall {found.recall:.3f}, duplicates {found.duplicates:.3f}")
    well = [name for name, number in seen.items() if number >= SEEN]
    known = sum(name in found.found for name in well)
    print(f"seen by the detector in {SEEN} keyframes or more: {len(well)}, of which {known} are landmarks")
    for part in ("found", "missed"):
        print(f"{part}: {', '.join(f'{name} ({seen[name]})' for name in getattr(found, part)) or 'none'}")
    for part in ("wrong", "twice"):
        print(f"{part}: {', '.join(getattr(found, part)) or 'none'}")


if __name__ == "__main__":
    main()
