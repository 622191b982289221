"""What rows of each kind take, and how fast they are matched.

    python -m bench.rows RECORDING... [--keyframes 25] [--rounds 5]

Ingests each recording once for every SEMDB_DESCRIPTOR_DTYPE (models by SEMDB_DETECTOR and SEMDB_ENCODER) and prints the
means of a keyframe's bytes; then matches each keyframe with the five that follow it, kind after kind in turn in one
run, on one thread. The poses that each gives: SEMDB_DESCRIPTOR_DTYPE=uint8 semdb evaluate RECORDING.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from sqlalchemy import func, select

from semdb.database import tables
from semdb.database.store import Store, open_store
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.localization.matching import match_keypoints
from semdb.localization.views import ClassNumbers, View, make_view
from semdb.settings import settings_with

KINDS = ("float32", "float16", "uint8")
PARTS = (("descriptors", "data"), ("keypoints", "data"), ("cnn_vectors", "vector"), ("objects", "mask"))
FOLLOWING = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--keyframes", type=int, default=25)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--max-keypoints", type=int, default=700)
    arguments = parser.parse_args()
    for recording in arguments.recordings:
        views: dict[str, list[View]] = {}
        with tempfile.TemporaryDirectory() as folder:
            for kind in KINDS:
                url = f"sqlite:///{folder}/{kind}.sqlite3"
                given = {"database_url": url, "descriptor_dtype": kind, "max_keypoints": arguments.max_keypoints}
                options = IngestOptions(keyframes=arguments.keyframes, map_name="m", check=False)
                ingest_recordings([recording], settings_with(given), options)
                with open_store(url) as store:
                    show_bytes(kind, store, recording.name)
                    views[kind] = views_of(store)
        show_times(views, arguments.rounds, recording.name)


def show_bytes(kind: str, store: Store, name: str) -> None:
    count = len(store.keyframe_ids(1))
    sizes = {}
    with store.engine.connect() as connection:
        for table, column in PARTS:
            total = select(func.sum(func.length(tables.metadata.tables[table].c[column])))
            sizes[table] = int(connection.execute(total).scalar() or 0) / count / 1024
    each = ", ".join(f"{table} {size:.1f}" for table, size in sizes.items())
    print(f"{name} {kind}: {sum(sizes.values()):.1f} KiB a keyframe ({each})", flush=True)


def views_of(store: Store) -> list[View]:
    numbers = ClassNumbers()
    stored = store.load_keyframes(store.keyframe_ids(1))
    return [make_view(k.camera, k.keypoints, [o.category for o in k.objects], numbers) for k in stored]


def show_times(views: dict[str, list[View]], rounds: int, name: str) -> None:
    seconds: dict[str, list[float]] = {kind: [] for kind in views}
    for _ in range(rounds + 1):  # the first compiles
        for kind, known in views.items():
            started = time.thread_time()
            for i, one in enumerate(known):
                for other in known[i + 1 : i + 1 + FOLLOWING]:
                    match_keypoints(
                        one.descriptors, other.descriptors, one.classes, other.classes,
                        query_signs=one.signs, keyframe_signs=other.signs,
                    )  # fmt: skip
            seconds[kind].append(time.thread_time() - started)
    best = {kind: float(np.median(times[1:])) for kind, times in seconds.items()}
    each = ", ".join(f"{kind} {1000 * value:.0f} ms" for kind, value in best.items())
    print(f"{name}: {each}; float32 takes {best['float32'] / best['uint8']:.2f} times as long as uint8", flush=True)


if __name__ == "__main__":
    main()
