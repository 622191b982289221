"""How fast recordings become rows: the overlapped pipeline against one thread, the writer alone, and its memory.

``python -m bench.ingest [RECORDING...] [--keyframes N] [--server] [--writer] [--memory FRAMES] [--json FILE]``,
SEMDB_DETECTOR and SEMDB_ENCODER as for `semdb ingest`. For each recording: keyframes per second of one thread that
does everything in turn and of the pipeline with SEMDB_THREADS threads, both in this run, and the pipeline's time over
that of its networks alone, run by as many threads; into SQLite or, with `--server`, a MariaDB of its own. `--writer`
stores made-up keyframes of 1500 keypoints in such a server. `--memory` ingests that many small frames with the
training-free models and prints the resident memory on the way.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import cv2

from semdb.cli.options import load_settings
from semdb.database.store import Store, open_store
from semdb.ingestion.keyframes import select_keyframes
from semdb.ingestion.run import IngestOptions, ingest_recording, make_describers, plan_ingest
from semdb.ingestion.work import Item, _claims, _describe, _read, _store
from semdb.perception.describe import Describer
from semdb.perception.model_choice import specs_for_ingest
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording

BUFFERS = ("--innodb-buffer-pool-size=256M", "--innodb-log-file-size=96M")  # the latter is MariaDB's default


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--keyframes", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--server", action="store_true")
    parser.add_argument("--writer", action="store_true")
    parser.add_argument("--memory", type=int, metavar="FRAMES")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results: list[dict[str, Any]] = []
    for recording in [found for path in arguments.recordings for found in open_recordings(path)]:
        results.append(measure_pipeline(recording, arguments.keyframes, arguments.rounds, server=arguments.server))
    if arguments.writer:
        results.append(measure_writer())
    if arguments.memory:
        results.append(measure_memory(arguments.memory))
    for result in results:
        shown = {name: f"{value:.4g}" if isinstance(value, float) else value for name, value in result.items()}
        print(", ".join(f"{name} {value}" for name, value in shown.items()))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def measure_pipeline(recording: Recording, count: int, rounds: int, *, server: bool = False) -> dict[str, Any]:
    """Rates in keyframes per second, the median of `rounds`, each round one of both in turn on an empty database."""
    settings = load_settings()
    specs = specs_for_ingest(settings, (), has_masks=recording.categories is not None)
    many = make_describers(specs, settings)
    one = make_describers(specs, settings.model_copy(update={"threads": 1}))
    entries = select_keyframes(recording, count=min(count, len(recording.entries)))
    frame = recording.read(entries[0])
    for describer in (*many, *one):
        describer.describe(frame.image, frame.depth, frame.camera, frame.instances)
    seconds: dict[str, list[float]] = {"one_thread": [], "pipeline": [], "networks": []}
    with databases(server=server) as new_url:
        for _ in range(rounds):
            for name, run, makers in (("one_thread", _in_turn, one), ("pipeline", _overlapped, many)):
                seconds[name].append(_timed_ingest(recording, entries, new_url, makers, run))
            seconds["networks"].append(_networks_alone(recording, entries, many))
    middle = {name: statistics.median(values) for name, values in seconds.items()}
    return {
        "recording": recording.name,
        "database": "MariaDB" if server else "SQLite",
        "models": [model.name for model in many[0].models],
        "threads": len(many),
        "keyframes": len(entries),
        **{f"{name}_per_s": len(entries) / value for name, value in middle.items()},
        "speedup": statistics.median(a / b for a, b in zip(seconds["one_thread"], seconds["pipeline"], strict=True)),
        "over_networks": statistics.median(
            a / b for a, b in zip(seconds["pipeline"], seconds["networks"], strict=True)
        ),
    }


@contextlib.contextmanager
def databases(*, server: bool) -> Iterator[Callable[[], contextlib.AbstractContextManager[str]]]:
    """What gives the URL of a new, empty database at each call: a file, or a schema of a private MariaDB."""
    if not server:

        @contextlib.contextmanager
        def file() -> Iterator[str]:
            with tempfile.TemporaryDirectory() as folder:
                url = f"sqlite:///{folder}/a.sqlite3"
                open_store(url, create=True).close()
                yield url

        yield file
        return
    from semdb.database import schema
    from semdb.database.engine import make_engine
    from tests import servers
    from tests.mariadb import MARIADB

    with servers.server(MARIADB, *BUFFERS) as running:

        @contextlib.contextmanager
        def made() -> Iterator[str]:
            with running.schema() as url:
                engine = make_engine(url)
                schema.upgrade(engine)
                engine.dispose()
                yield url

        yield made


def _timed_ingest(
    recording: Recording,
    entries: list[FrameEntry],
    new_url: Callable[[], contextlib.AbstractContextManager[str]],
    describers: list[Describer],
    run: Callable[[Recording, Store, list[Describer], list[FrameEntry]], None],
) -> float:
    with new_url() as url, open_store(url) as store:
        started = time.perf_counter()
        run(recording, store, describers, entries)
        return time.perf_counter() - started


def _overlapped(recording: Recording, store: Store, describers: list[Describer], entries: list[FrameEntry]) -> None:
    summary = ingest_recording(recording, store, describers, IngestOptions(map_name="m"), entries=entries)
    assert summary.stored == len(entries), summary


def _in_turn(recording: Recording, store: Store, describers: list[Describer], entries: list[FrameEntry]) -> None:
    """The same steps of the same keyframes, one after the other in this thread."""
    options = IngestOptions(map_name="m")
    cv2.setNumThreads(1)
    summary, _ = plan_ingest(recording, store, describers[0].models, options, entries=entries)
    idle: SimpleQueue[Describer] = SimpleQueue()
    idle.put(describers[0])
    key = summary.recording_id
    for [item] in _claims(recording, key, store, "bench", (5, 1), None, lambda: False, 60):
        [described] = _describe(idle, [_read(recording, item)])
        done: Item = _store(store, key, described)
        assert done.created
    store.finish_recording(key)


def _networks_alone(recording: Recording, entries: list[FrameEntry], describers: list[Describer]) -> float:
    """Seconds that detector and encoder take for all images, decoded before, by one thread for each describer."""
    idle: SimpleQueue[Describer] = SimpleQueue()
    for describer in describers:
        idle.put(describer)
    frames = [recording.read(entry) for entry in entries]

    def run(frame: Any) -> None:
        describer = idle.get()
        describer.detector.detect(frame.image, frame.instances)
        describer.encoder.encode(frame.image)
        idle.put(describer)

    with ThreadPoolExecutor(len(describers)) as pool:
        started = time.perf_counter()
        list(pool.map(run, frames))
        return time.perf_counter() - started


def measure_writer(keyframes: int = 200) -> dict[str, Any]:
    """Keyframes per second that one writer stores, and the processor time that it and the server take for each."""
    from semdb.database import schema
    from semdb.database.engine import make_engine
    from semdb.types import Camera
    from tests import database_samples as samples
    from tests import servers
    from tests.mariadb import MARIADB

    camera = Camera(640, 480, 525, 525, 319.5, 239.5)
    categories = ["chair", "cup", "tv", "laptop", "person", "cup"]
    made = [samples.description(k, categories, keypoints=1500, vector_size=2048, camera=camera) for k in range(8)]
    records = [samples.record(k, described, image_size=150_000) for k, described in enumerate(made)]
    with servers.server(MARIADB, *BUFFERS) as server, server.schema() as url:
        engine = make_engine(url)
        schema.upgrade(engine)
        engine.dispose()
        with open_store(url) as store:
            plan = samples.plan("written", range(keyframes + 1))
            recording = store.plan_recording(store.ensure_map("m"), plan, samples.MODELS).recording_id
            store.write_keyframe(recording, dataclasses.replace(records[0], frame_index=keyframes))
            started, used = time.perf_counter(), time.process_time()
            for index in range(keyframes):
                store.write_keyframe(recording, dataclasses.replace(records[index % 8], frame_index=index))
            seconds, used = time.perf_counter() - started, time.process_time() - used
    return {
        "writer": "MariaDB",
        "keyframes": keyframes,
        "per_s": keyframes / seconds,
        "own_ms": 1000 * used / keyframes,
    }


def measure_memory(frames: int) -> dict[str, Any]:
    """Resident memory in MiB after a selection, and in tenths of an ingest, of `frames` frames (all keyframes)."""
    settings = load_settings(detector="recorded", encoder="gist", features="orb")
    seen: list[float] = []

    def note(what: str, done: int, total: int) -> None:
        if done % max(1, total // 10) == 0:
            seen.append(_resident_mib())
            print(f"{what}: {done} of {total}, {seen[-1]:.0f} MiB", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as folder, open_store(f"sqlite:///{folder}/a.sqlite3", create=True) as store:
        _write_long_recording(Path(folder) / "room", frames)
        [recording] = open_recordings(Path(folder) / "room")
        describers = make_describers(specs_for_ingest(settings, (), has_masks=True), settings)
        before = _resident_mib()
        select_keyframes(recording, count=50)
        selected = _resident_mib()
        started = time.perf_counter()
        summary = ingest_recording(recording, store, describers, IngestOptions(map_name="m", stride=1), progress=note)
        seconds = time.perf_counter() - started
    return {
        "frames": frames,
        "stored": summary.stored,
        "per_s": frames / seconds,
        "opened_mib": round(before),
        "selected_mib": round(selected),
        "ingest_mib": [round(value) for value in seen],
    }


def _write_long_recording(room: Path, frames: int, rendered: int = 500) -> None:
    """A walk of `rendered` frames, repeated under later times: links to the same files."""
    from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording

    write_synthetic_recording(room, SyntheticOptions(frames=min(frames, rendered), width=160, height=120))
    stems = [path.stem for path in sorted((room / "rgb").iterdir(), key=lambda path: float(path.stem))]
    poses = [line.split(maxsplit=1)[1] for line in (room / "groundtruth.txt").read_text().splitlines()[2:]]
    lines: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for number in range(len(stems), frames):
        old, place = stems[number % len(stems)], number % len(stems)
        new = f"{float(old) + 1000 * (number // len(stems)):.6f}"
        for name in ("rgb", "depth", "masks"):
            (room / name / f"{new}.png").hardlink_to(room / name / f"{old}.png")
        for name in ("rgb", "depth"):
            lines[name].append(f"{new} {name}/{new}.png\n")
        lines["groundtruth"].append(f"{new} {poses[place]}\n")
    for name, added in lines.items():
        with (room / f"{name}.txt").open("a") as file:
            file.writelines(added)


def _resident_mib() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS in /proc/self/status")


if __name__ == "__main__":
    main()
