"""The coarse step on large maps: class filter, cosines and rankings, in SQL, from the index, and by faiss and hnswlib.

    python -m bench.coarse [--keyframes 10000,100000] [--million] [--data-dir DIR] [--json FILE]

Starts a MariaDB of its own, fills it with made-up keyframes (see bench/coarse/world.py), and asks every method the same
queries in one run, on two threads. With --data-dir the filled server is kept for the next run: a million keyframes take
20 GB. Times depend on the machine; the ratios, agreement and memory at the end hardly do.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.coarse import methods
from bench.coarse.fill import MAP_ID, fill
from bench.coarse.server import bench_server
from bench.coarse.world import Query, World
from semdb.cli.progress import Progress
from semdb.database.store import Store, open_store
from semdb.localization.index import IndexOptions, IndexSource, MapIndex
from semdb.localization.sources import SqlSource

THREADS = 2
SETTINGS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(THREADS))
MILLION = 1_000_000
PEERS_UP_TO = 100_000  # hnswlib would take hours for more, faiss all memory of a small machine
QUERIES = 200
NEWS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", help="taken by all benchmarks, not used by this one")
    parser.add_argument("--keyframes", default="10000,100000", help="sizes of maps, multiples of 1000")
    parser.add_argument("--million", action="store_true", help="a map of 1000000 too: about 20 GB of disk")
    parser.add_argument("--data-dir", type=Path, help="keep the filled server here, and use it again")
    parser.add_argument("--fill-only", action="store_true", help="fill the server of --data-dir and stop")
    parser.add_argument("--seconds", type=float, default=20.0, help="for the queries of one method")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if any(os.environ.get(name) != value for name, value in SETTINGS.items()):  # libraries read them when loaded
        os.execve(sys.executable, [sys.executable, "-m", "bench.coarse", *sys.argv[1:]], os.environ | SETTINGS)
    sizes = [int(size) for size in arguments.keyframes.split(",") if size] + [MILLION] * arguments.million
    world = World(arguments.seed)
    results = []
    with bench_server(arguments.data_dir) as server:
        urls = {size: fill(server, size, world) for size in sizes}
        for size, url in urls.items():
            if arguments.fill_only:
                break
            results.append(measure(url, size, world, arguments.seconds))
            show(results[-1])
            if arguments.json is not None:
                arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def measure(url: str, size: int, world: World, seconds: float) -> dict[str, Any]:
    """All figures of one map."""
    queries = world.queries(size // 1000, QUERIES)
    with tempfile.TemporaryDirectory(prefix="semdb-coarse-index-") as folder, open_store(url) as store:
        cache = Path(folder)
        cold = {"database": probe(url, cache, size, world.seed), "cache": probe(url, cache, size, world.seed)}
        options = IndexOptions(threads=THREADS)
        with MapIndex.open(
            store, MAP_ID, cache, options=options, say=lambda line: print(line, file=sys.stderr)
        ) as index:
            sql, memory = methods.Source(SqlSource(store, MAP_ID)), methods.Source(IndexSource(index))
            filters = {
                "naive SQL": methods.NaiveSql(store).filtered,
                "SQL": sql.filtered,
                "index": memory.filtered,
                "SQL, by strengths": sql.filtered_by_strength,
                "index, by strengths": memory.filtered_by_strength,
            }
            filtered = {name: run(method, queries, seconds) for name, method in filters.items()}
            with Progress("the exact ranking", "keyframes") as progress:
                exact = methods.exact_ten(store, queries, progress)
            whole = {"index": run(memory.whole, queries, seconds)}
            whole.update(peers(store, queries, size, seconds))
            found = time_to_find(url, index, world.seed)
    return {
        "keyframes": size,
        "threads": THREADS,
        "filter": summarise_filter(filtered),
        "whole": {name: summarise_whole(item, exact) for name, item in whole.items()},
        "start": cold,
        "found_s": found,
    }


def run(function: Any, queries: list[Query], seconds: float) -> tuple[list[float], list[list[int]]]:
    methods.timed(function, queries[-3:], 0)  # compiles, connects, reads pages
    return methods.timed(function, queries, seconds)


def peers(
    store: Store, queries: list[Query], size: int, seconds: float
) -> dict[str, tuple[list[float], list[list[int]]]]:
    """The ranking alone by libraries for it, where they are installed."""
    if size > PEERS_UP_TO:
        print(f"faiss and hnswlib are left out above {PEERS_UP_TO} keyframes", file=sys.stderr)
        return {}
    pieces = list(store.iter_vectors(MAP_ID))
    ids = np.concatenate([piece[0] for piece in pieces])
    vectors = np.concatenate([piece[1] for piece in pieces])
    del pieces
    found = {}
    for module, make in (("faiss", methods.FaissFlat), ("hnswlib", methods.Hnsw)):
        if importlib.util.find_spec(module) is None:
            print(f"{module} is not installed and left out: pip install 'semdb[bench]'", file=sys.stderr)
            continue
        started = time.monotonic()
        peer = make(vectors, ids, THREADS)
        print(f"{peer.name}: built in {time.monotonic() - started:.0f} s", file=sys.stderr)
        found[peer.name] = run(peer.whole, queries, seconds)
    return found


def probe(url: str, cache: Path, size: int, seed: int) -> dict[str, Any]:
    """Start and memory of the index in a process of its own."""
    words = ["open", url, str(cache), str(size), str(seed), str(THREADS)]
    done = subprocess.run([*PROBE, *words], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)  # type: ignore[no-any-return]


def time_to_find(url: str, index: MapIndex, seed: int) -> list[float]:
    """Seconds from the commit of a keyframe in another process until the index gives it as the nearest."""
    source = IndexSource(index)
    source.refresh()
    seconds = []
    with subprocess.Popen([*PROBE, "write", url, str(seed)], stdin=-1, stdout=-1, text=True) as writer:
        assert writer.stdin is not None
        assert writer.stdout is not None
        for _ in range(NEWS):
            writer.stdin.write("next\n")
            writer.stdin.flush()
            line = writer.stdout.readline()
            if not line:
                raise SystemExit("bench.coarse: the process that writes keyframes failed, see above")
            news = json.loads(line)
            vector = np.array(news["vector"], np.float32)
            while True:
                source.refresh()
                nearest = source.nearest(vector, 1, None, 0.0).keyframe_ids
                if len(nearest) and nearest[0] == news["id"]:
                    break
                time.sleep(0.005)
            seconds.append(time.monotonic() - news["at"])
        writer.stdin.close()  # the writer deletes what it wrote
    return seconds


PROBE = [sys.executable, "-m", "bench.coarse.probe"]


def percentiles(milliseconds: list[float]) -> dict[str, float]:
    return {
        "queries": len(milliseconds),
        **{f"p{percent}": float(np.percentile(milliseconds, percent)) for percent in (50, 95)},
    }


def summarise_filter(results: dict[str, tuple[list[float], list[list[int]]]]) -> dict[str, Any]:
    """Times, and the share of queries with the same first ten, in the same order, as semdb's SQL."""
    summary: dict[str, Any] = {}
    for name, (milliseconds, answers) in results.items():
        reference = results["SQL, by strengths" if "strengths" in name else "SQL"][1]
        pairs = list(zip(answers, reference, strict=False))
        summary[name] = {**percentiles(milliseconds), "same_ten": float(np.mean([a == b for a, b in pairs]))}
    for name in results:
        summary[name]["times_faster"] = summary["naive SQL"]["p50"] / summary[name]["p50"]
    return summary


def summarise_whole(result: tuple[list[float], list[list[int]]], exact: np.ndarray) -> dict[str, float]:
    """Times, and the share of the exact first ten that are among those found."""
    milliseconds, answers = result
    recall = [len(set(answer) & set(map(int, best))) / len(best) for answer, best in zip(answers, exact, strict=False)]
    return {**percentiles(milliseconds), "recall": float(np.mean(recall))}


def show(result: dict[str, Any]) -> None:
    print(f"{result['keyframes']} keyframes, {result['threads']} threads")
    print("  class filter, cosines of the best 1000, first ten")
    for name, item in result["filter"].items():
        print(
            f"    {name:24} p50 {item['p50']:9.2f} ms  p95 {item['p95']:9.2f} ms  {item['queries']:4.0f} queries  "
            f"{item['times_faster']:7.1f} times naive SQL  same ten {item['same_ten']:.0%}"
        )
    print("  whole map by cosine, first ten")
    for name, item in result["whole"].items():
        print(
            f"    {name:24} p50 {item['p50']:9.2f} ms  p95 {item['p95']:9.2f} ms  {item['queries']:4.0f} queries  "
            f"recall {item['recall']:.4f}"
        )
    start = result["start"]
    memory = start["cache"]["mib"]
    print(
        f"  start of the index: from its file {start['cache']['open_s']:.2f} s, from the database "
        f"{start['database']['open_s']:.2f} s"
    )
    print(
        f"  memory of a process that holds it: {memory['VmRSS']:.0f} MiB, of which {memory['RssFile']:.0f} are pages "
        f"of files; at the most while it was built {start['database']['mib']['VmHWM']:.0f} MiB"
    )
    found = result["found_s"]
    print(f"  a keyframe of another process is found after {max(found):.3f} s at the most (of {len(found)})")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
