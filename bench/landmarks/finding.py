"""How long `semdb find` takes in a database of many landmarks.

``python -m bench.landmarks.finding [--landmarks N] [--per-map N] [--url URL]``. Made-up landmarks of 80 classes in maps
of 1000, each with ten relations, and one in five may be of another class; URL is that of an empty database with the
schema (default: a temporary SQLite file).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from sqlalchemy import insert, select

from semdb.api.finding import find
from semdb.database import landmark_tables
from semdb.database.ids import SharedIds
from semdb.database.store import Store, open_store

KINDS = ("near", "next_to", "on", "under", "above")
QUESTIONS = (
    {},
    {"near": "class 7"},
    {"on": "class 9"},
    {"near": "class 3", "not_near": "class 5", "origin": (1, 2, 0)},
)


def fill(store: Store, number: int, per_map: int = 1000) -> None:
    """Writes `number` landmarks."""
    rng = np.random.default_rng(0)
    names = [f"class {k}" for k in range(80)]
    ids = SharedIds(store.engine).categories(names)
    keys = [ids[name] for name in names]
    made = 0
    for k in range(-(-number // per_map)):
        map_id = store.ensure_map(f"map {k}")
        count = min(per_map, number - made)
        places = rng.uniform(-20, 20, (count, 3))
        zeros = dict.fromkeys(landmark_tables.COVARIANCE_COLUMNS, 0.0)
        classes = [keys[int(rng.integers(80))] for _ in range(count)]
        rows = [
            {
                **{"id": made + n + 1, "map_id": map_id, "category_id": classes[n]},
                **{"probability": float(rng.uniform(0.5, 1)), "evidence": "{}", **zeros},
                **dict(zip("xyz", map(float, places[n]), strict=True)),
                **{"size_x": 0.3, "size_y": 0.3, "size_z": 0.3, "yaw": 0.0, "sightings": 4, "keyframes": 4},
                **{"missed": 0, "seen_through": 0, "state": "confirmed"},
            }
            for n in range(count)
        ]
        related = {
            (made + n + 1, KINDS[int(rng.integers(5))], made + int(rng.integers(count)) + 1)
            for n in range(count)
            for _ in range(10)
        }
        perhaps = [
            {
                **{"landmark_id": made + n + 1, "category_id": keys[int(rng.integers(80))], "map_id": map_id},
                "probability": float(rng.uniform(0.002, 0.5)),
            }
            for n in range(count)
            if rng.random() < 0.2
        ]
        with store.engine.begin() as connection:
            connection.execute(insert(landmark_tables.landmarks), rows)
            connection.execute(insert(landmark_tables.landmark_categories), perhaps)
            connection.execute(
                insert(landmark_tables.landmark_relations),
                [
                    {
                        **{"landmark_id": a, "kind": kind, "other_landmark_id": b},
                        **{"score": float(rng.uniform(0.3, 1)), "other_category_id": classes[b - made - 1]},
                        **{"category_id": classes[a - made - 1], "map_id": map_id},
                    }
                    for a, kind, b in sorted(related)
                ],
            )
        made += count


def measure(store: Store, questions: int = 200) -> list[tuple[float, float]]:
    """Milliseconds of each of so many questions, in one map and in all: on the wall, and of this processor."""
    rng = np.random.default_rng(1)
    maps = [info.name for info in store.maps()]
    taken = []
    for k in range(questions):
        asked = dict(QUESTIONS[k % len(QUESTIONS)])
        if k % 8 < 6:
            asked["map"] = maps[int(rng.integers(len(maps)))]
        start, worked = time.perf_counter(), time.process_time()
        find(store, f"class {int(rng.integers(80))}", **asked)  # type: ignore[arg-type]
        taken.append(((time.perf_counter() - start) * 1000, (time.process_time() - worked) * 1000))
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=100_000)
    parser.add_argument("--per-map", type=int, default=1000)
    parser.add_argument("--url")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        url = given.url or f"sqlite:///{Path(folder) / 'landmarks.sqlite3'}"
        with open_store(url, create=True) as store:
            with store.engine.connect() as connection:
                empty = connection.execute(select(landmark_tables.landmarks.c.id).limit(1)).first() is None
            if empty:
                fill(store, given.landmarks, given.per_map)
            measure(store, 8)
            taken = measure(store)
    asked = np.arange(len(taken)) % 8
    for name, rows in (("in one map", asked < 6), ("in all maps", asked >= 6), ("all", asked >= 0)):
        p50, p95 = np.percentile(np.array(taken)[rows], (50, 95), axis=0)
        print(f"{name}: p50 {p50[0]:.1f} ms, p95 {p95[0]:.1f} ms; of one core {p50[1]:.1f} and {p95[1]:.1f} ms")


if __name__ == "__main__":
    main()
