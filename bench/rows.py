"""What rows of each kind take, how fast they are matched, and what poses they give.

    python -m bench.rows RECORDING... [--keyframes 25] [--rounds 5]
    python -m bench.rows RECORDING... --queries 75 [--keyframes 25] [--max-keypoints 1500]

Ingests each recording once for every SEMDB_DESCRIPTOR_DTYPE (models by SEMDB_DETECTOR and SEMDB_ENCODER) and prints the
means of a keyframe's bytes; then matches each keyframe with the five that follow it, kind after kind in turn in one
run, on one thread. With --queries it ingests once, makes copies of the map smaller as `semdb compact` does, refines
each by itself, and asks all of them the same images, each described once.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from sqlalchemy import func, select

import semdb
from semdb.api import Database
from semdb.database import tables
from semdb.database.store import Store, open_store
from semdb.geometry import pose_error
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.localization.matching import match_keypoints
from semdb.localization.views import ClassNumbers, View, make_view
from semdb.recordings import open_recording
from semdb.settings import settings_with
from semdb.types import Description, Frame, Verdict

KINDS = ("float32", "float16", "uint8")
PARTS = (("descriptors", "data"), ("keypoints", "data"), ("cnn_vectors", "vector"), ("objects", "mask"))
FOLLOWING = 5
COPIES = (("float32", None, "original"), ("uint8", "uint8", "original"),
          ("jpeg", None, "jpeg"), ("none", None, "none"), ("uint8, none", "uint8", "none"))  # fmt: skip
FALSE_M, FALSE_DEG, NEAR_M = 0.25, 5.0, 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--keyframes", type=int, default=25)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--max-keypoints", type=int, default=700)
    parser.add_argument("--queries", type=int, help="ask about so many other frames, and show poses instead of times")
    arguments = parser.parse_args()
    for recording in arguments.recordings:
        if arguments.queries is not None:
            show_poses(recording, arguments.keyframes, arguments.queries, arguments.max_keypoints)
            continue
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


def show_poses(path: Path, keyframes: int, queries: int, max_keypoints: int) -> None:
    """Each copy of one map asked the same images."""
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "0.sqlite3"
        with opened(first, max_keypoints) as db:
            db.ingest(path, map="m", keyframes=keyframes, check=False)
        files = [shutil.copy(first, Path(folder) / f"{number}.sqlite3") for number, _ in enumerate(COPIES, start=1)]
        asked: list[tuple[Frame, Description]] = []
        for file, (name, dtype, images) in zip(files, COPIES, strict=True):
            with opened(Path(file), max_keypoints) as db:
                if dtype is not None or images != "original":
                    db.compact("m", dtype=dtype, keep_images=images)
                db.refine("m")
                asked = asked or described(db, path, queries)
                [entry] = db._here.maps().asked("m", "index")
                found = [(frame, entry.localizer.localize(one)) for frame, one in asked]
            errors = np.array(
                [
                    pose_error(answer.world_from_camera, frame.world_from_camera)
                    for frame, answer in found
                    if answer.verdict is Verdict.LOCALIZED and frame.world_from_camera is not None
                ]
            ).reshape(-1, 2)
            wrong = (errors[:, 0] > FALSE_M) | (errors[:, 1] > FALSE_DEG)
            near = (errors[:, 0] <= NEAR_M) & (errors[:, 1] <= FALSE_DEG)
            metres, degrees = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
            print(
                f"{path.name} {name}: {len(errors)} of {len(found)} localized, {near.sum()} within 5 cm and 5 deg, "
                f"{wrong.sum()} false, median {metres * 1000:.2f} mm {degrees:.3f} deg",
                flush=True,
            )


def opened(file: Path, max_keypoints: int) -> Database:
    return semdb.open(f"sqlite:///{file}", descriptor_dtype="float32", max_keypoints=max_keypoints)


def described(db: Database, path: Path, queries: int) -> list[tuple[Frame, Description]]:
    """Frames that are no keyframes, evenly taken, as the map's models see them, by colour alone."""
    [entry] = db._here.maps().asked("m", "index")
    stored = {keyframe.frame_index for keyframe in db.keyframes("m")}
    recording = open_recording(path)
    others = [e for e in recording.entries if e.index not in stored and e.world_from_camera is not None]
    chosen = np.unique(np.linspace(0, len(others) - 1, min(queries, len(others))).astype(int))
    frames = [recording.read(others[number]) for number in chosen]
    return [(f, entry.describer.describe(f.image, None, f.camera, f.instances)) for f in frames]


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
