"""What the benchmark of the coarse step needs a fresh process for; prints JSON.

``python -m bench.coarse.probe open URL CACHE KEYFRAMES SEED THREADS`` opens the index, asks it some queries, and says
how long it took and how much memory it holds. ``python -m bench.coarse.probe write URL SEED`` stores a keyframe per
line that it reads, says when it was committed, and deletes them all in the end.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np

from bench.coarse.fill import MAP_ID, MODELS
from bench.coarse.methods import Source
from bench.coarse.world import World
from semdb.database.records import RecordingPlan
from semdb.database.store import open_store
from semdb.localization.index import IndexOptions, IndexSource, MapIndex

QUERIES = 50
NEWS = "written meanwhile"


def memory_mib() -> dict[str, float]:
    """Resident memory of this process: all, and what of it is not the pages of files."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {name: int(lines[name].split()[0]) / 1024 for name in ("VmRSS", "RssAnon", "RssFile", "VmHWM")}


def probe_open(url: str, cache: Path, keyframes: int, seed: int, threads: int) -> None:
    queries = World(seed).queries(keyframes // 1000, QUERIES)
    before = memory_mib()
    with open_store(url) as store:
        started = time.perf_counter()
        index = MapIndex.open(store, MAP_ID, cache, options=IndexOptions(threads=threads), say=_say)
        opened = time.perf_counter() - started
        peak = memory_mib()["VmHWM"]
        source = Source(IndexSource(index))
        source.whole(queries[0])
        first = time.perf_counter() - started
        for query in queries:
            source.filtered(query)
            source.whole(query)
        after = memory_mib()
        index.close()
    found = {"open_s": opened, "first_answer_s": first, "before_mib": before, "mib": after, "peak_open_mib": peak}
    print(json.dumps(found))


def probe_write(url: str, seed: int) -> None:
    from tests.database_samples import description, record

    rng = np.random.default_rng(seed)
    with open_store(url) as store:
        plan = RecordingPlan(NEWS, "synthetic", "", 1000, "1" * 64, tuple(range(1000)))
        planned = store.plan_recording(MAP_ID, plan, MODELS)
        for number, _ in enumerate(sys.stdin):
            vector = rng.normal(0, 1, 2048).astype(np.float32)  # like no other
            vector /= np.linalg.norm(vector)
            described = description(number, ["chair"], keypoints=10, models=MODELS)
            described = dataclasses.replace(described, cnn_vector=vector)
            written = store.write_keyframe(planned.recording_id, record(number, described))
            news = {"id": written.keyframe_id, "at": time.monotonic(), "vector": vector.tolist()}
            print(json.dumps(news), flush=True)
        store.delete_recording(planned.recording_id)


def _say(line: str) -> None:
    print(line, file=sys.stderr)


if __name__ == "__main__":
    if sys.argv[1] == "open":
        probe_open(sys.argv[2], Path(sys.argv[3]), *map(int, sys.argv[4:7]))
    else:
        probe_write(sys.argv[2], int(sys.argv[3]))
