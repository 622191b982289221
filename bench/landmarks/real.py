"""Landmarks of a real recording against things that were written down by eye.

``python -m bench.landmarks.real DATABASE_URL MAP LABELS``. The map has to be ingested and refined, and LABELS is a file
of ``tests/data``: names, classes, and rough places. A confirmed landmark is right when it has a class of a thing and
stands at its place; a second one of the same thing is a duplicate.
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

from semdb.database.landmark_reading import StoredLandmark, load_landmarks
from semdb.database.store import open_store


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


def tally(landmarks: Sequence[StoredLandmark], things: Sequence[dict[str, Any]]) -> Tally:
    """Confirmed landmarks against things, one to one."""
    there = [item for item in landmarks if item.state == "confirmed"]
    cost = np.full((len(there), len(things)), 1e6)
    for row, item in enumerate(there):
        for column, thing in enumerate(things):
            away = float(np.linalg.norm(np.array(item.position) - thing["place"]))
            if item.category in thing["classes"] and away <= thing["within"]:
                cost[row, column] = away
    rows, columns = linear_sum_assignment(cost)
    matched = {int(r): int(c) for r, c in zip(rows, columns, strict=True) if cost[r, c] < 1e6}
    rest = [k for k in range(len(there)) if k not in matched]
    twice = [k for k in rest if cost[k].min(initial=1e6) < 1e6]
    return Tally(
        tuple(things[c]["name"] for c in matched.values()),
        tuple(thing["name"] for k, thing in enumerate(things) if k not in matched.values()),
        tuple(f"{there[k].category} {there[k].id}" for k in rest if k not in twice),
        tuple(f"{there[k].category} {there[k].id}" for k in twice),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("database")
    parser.add_argument("map")
    parser.add_argument("labels", type=Path)
    given = parser.parse_args()
    things = json.loads(given.labels.read_text(encoding="utf-8"))["things"]
    with open_store(given.database) as store:
        landmarks, _ = load_landmarks(store.engine, store.find_map(given.map).id)
    found = tally(landmarks, things)
    print(f"precision {found.precision:.3f}, recall {found.recall:.3f}, duplicates {found.duplicates:.3f}")
    for name in ("found", "missed", "wrong", "twice"):
        print(f"{name}: {', '.join(getattr(found, name)) or 'none'}")


if __name__ == "__main__":
    main()
