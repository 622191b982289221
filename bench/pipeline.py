"""How much the networks cost and how much everything else: ingest and localization, stage by stage, in one run.

``python -m bench.pipeline RECORDING... [--keyframes N] [--queries N] [--json FILE]``, with SEMDB_DETECTOR and
SEMDB_ENCODER as for `semdb ingest`. Prints the time of an ingest over that of its networks, and the time of a query
without them. Times are wall times of this machine; the ratios are what to compare.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from semdb.cli.options import load_settings
from semdb.database.store import Store
from semdb.evaluation.protocols import split_paper
from semdb.evaluation.workspace import evaluation_store
from semdb.ingestion.keyframes import select_keyframes
from semdb.ingestion.run import IngestOptions, ingest_recording
from semdb.localization.images import make_localizer
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.model_choice import specs_for_ingest
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording

NETWORKS = ("detect", "encode")
STAGES = ("decode", *NETWORKS, "features", "filter", "rank", "match", "pose")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--keyframes", type=int, default=25)
    parser.add_argument("--queries", type=int, default=50)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    settings = load_settings()
    results = []
    for recording in [found for path in arguments.recordings for found in open_recordings(path)]:
        specs = specs_for_ingest(settings, (), has_masks=recording.categories is not None)
        describer = describer_from_specs(specs.detector, specs.encoder, specs.features, settings)
        keyframes = select_keyframes(recording, count=arguments.keyframes)
        warm_up(recording, describer)
        with evaluation_store(settings.database_url) as store:
            ingest = measure_ingest(recording, keyframes, describer, store)
            queries = split_paper(recording.entries, keyframes, arguments.queries)
            localize = measure_queries(recording, queries, describer, store)
        result = {"recording": recording.name, "models": [m.name for m in describer.models], **ingest, **localize}
        results.append(result)
        show(result)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def warm_up(recording: Recording, describer: Describer) -> None:
    """Kernels are compiled, or loaded, and the networks have run once."""
    frame = recording.read(recording.entries[0])
    for _ in range(2):
        describer.describe(frame.image, frame.depth, frame.camera, frame.instances)


def measure_ingest(
    recording: Recording, keyframes: list[FrameEntry], describer: Describer, store: Store
) -> dict[str, Any]:
    summary = ingest_recording(recording, store, describer, IngestOptions(map_name="m"), entries=keyframes)
    networks = sum(summary.seconds[stage] for stage in NETWORKS)
    return {
        "keyframes": summary.stored,
        "ingest_seconds": summary.seconds,
        "ingest_over_networks": summary.seconds["total"] / networks if networks else None,
    }


def measure_queries(
    recording: Recording, queries: list[FrameEntry], describer: Describer, store: Store
) -> dict[str, Any]:
    localizer = make_localizer(store, store.find_map("m"), "sql")
    rows = []
    for entry in queries:
        started = time.perf_counter()
        frame = recording.read(entry)
        decode = (time.perf_counter() - started) * 1000
        description = describer.describe(frame.image, None, frame.camera, frame.instances)
        found = localizer.localize(description)
        total = (time.perf_counter() - started) * 1000
        rows.append({"decode": decode, **description.timing_ms, **found.timing_ms, "total": total})
    without = [row["total"] - sum(row[stage] for stage in NETWORKS) for row in rows]
    return {
        "queries": len(rows),
        "without_networks_ms": percentiles(without),
        "stages_ms": {stage: percentiles([row[stage] for row in rows]) for stage in STAGES},
    }


def percentiles(values: list[float]) -> dict[str, float]:
    return {f"p{percent}": float(np.percentile(values, percent)) for percent in (50, 95)}


def show(result: dict[str, Any]) -> None:
    seconds = result["ingest_seconds"]
    print(f"{result['recording']}: {', '.join(result['models'])}")
    ratio = result["ingest_over_networks"]
    print(
        f"  ingest of {result['keyframes']} keyframes {seconds['total']:.2f} s, "
        + (f"{ratio:.2f} times its networks" if ratio else "no network")
        + "".join(f", {stage} {seconds[stage]:.2f}" for stage in ("read", *NETWORKS, "features", "store"))
    )
    without = result["without_networks_ms"]
    print(
        f"  {result['queries']} queries without networks p50 {without['p50']:.0f} ms, p95 {without['p95']:.0f} ms: "
        + ", ".join(f"{stage} {values['p50']:.0f}" for stage, values in result["stages_ms"].items())
    )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
