"""The whole of a query but its networks: SURF on the image, coarse step, fine step, verdict; by stage."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from semdb.cli.options import load_settings
from semdb.evaluation.protocols import split_paper
from semdb.evaluation.workspace import evaluation_store
from semdb.geometry import pose_error
from semdb.ingestion.keyframes import select_keyframes
from semdb.ingestion.run import IngestOptions, ingest_recording
from semdb.localization.images import make_localizer
from semdb.perception.describe import describer_from_specs
from semdb.perception.model_choice import specs_for_ingest
from semdb.recordings.base import Recording
from semdb.types import FloatArray

STAGES = ("features", "filter", "rank", "match", "pose")


def measure_query(recording: Recording, keyframes: int, queries: int, coarse: str) -> dict[str, Any]:
    """Milliseconds of `queries` against a map of `keyframes`, wall and CPU, and by stage.

    The networks are those of the settings; their time is not counted.
    """
    settings = load_settings()
    specs = specs_for_ingest(settings, (), has_masks=recording.categories is not None)
    describer = describer_from_specs(specs.detector, specs.encoder, specs.features, settings)
    chosen = select_keyframes(recording, count=keyframes)
    rows, first_ms = [], float("nan")
    with evaluation_store("sqlite:///bench") as store:
        ingest_recording(recording, store, describer, IngestOptions(map_name="bench"), entries=chosen)
        localizer = make_localizer(store, store.find_map("bench"), coarse)
        for count, entry in enumerate(split_paper(recording.entries, chosen, queries)):
            frame = recording.read(entry)
            assert frame.world_from_camera is not None
            description = describer.describe(frame.image, None, frame.camera, frame.instances)
            if count == 0:
                started = time.perf_counter()
                localizer.localize(description)
                first_ms = 1000 * (time.perf_counter() - started)
            localizer.localize(description)  # keyframes are in memory, as in a program that follows a camera
            started, cpu = time.perf_counter(), time.process_time()
            answer = localizer.localize(description)
            whole, cpu = 1000 * (time.perf_counter() - started), 1000 * (time.process_time() - cpu)
            stages = {"features": description.timing_ms["features"], **answer.timing_ms}
            pose = answer.world_from_camera
            error = (np.inf, np.inf) if pose is None else pose_error(pose, frame.world_from_camera)
            rows.append([*(stages[name] for name in STAGES), whole, cpu, *error])
    return {"coarse": coarse, "queries": len(rows), "first_query_ms": first_ms, **_summary(np.array(rows))}


def _summary(rows: FloatArray) -> dict[str, Any]:
    stages, features = rows[:, : len(STAGES)], rows[:, 0]
    whole, cpu = rows[:, len(STAGES)], rows[:, len(STAGES) + 1]
    rest = whole - stages[:, 1:].sum(axis=1)
    return {
        "stages_ms_p50": {
            **{name: float(np.median(column)) for name, column in zip(STAGES, stages.T, strict=True)},
            "rest": float(np.median(rest)),
        },
        "localize_ms_p50": float(np.median(whole)),
        "localize_ms_p95": float(np.percentile(whole, 95)),
        "localize_cpu_ms_p50": float(np.median(cpu)),
        "without_networks_ms_p50": float(np.median(whole + features)),
        "without_networks_ms_p95": float(np.percentile(whole + features, 95)),
        "within_5cm_5deg": float(((rows[:, -2] <= 0.05) & (rows[:, -1] <= 5)).mean()),
    }


def show_query(found: dict[str, Any]) -> None:
    """A line by stage, and the sums."""
    print(f"  whole query without networks, --coarse {found['coarse']}, {found['queries']} queries, milliseconds p50:")
    print("  " + "".join(f"{name:>10s}" for name in found["stages_ms_p50"]) + "       sum  p95 of it")
    sums = f"{found['without_networks_ms_p50']:10.1f} {found['without_networks_ms_p95']:10.1f}"
    print("  " + "".join(f"{ms:10.1f}" for ms in found["stages_ms_p50"].values()) + sums)
    print(
        f"  localize alone: {found['localize_ms_p50']:.1f} (CPU {found['localize_cpu_ms_p50']:.1f}, "
        f"p95 {found['localize_ms_p95']:.1f}); the first query, with kernels and keyframes to load: "
        f"{found['first_query_ms']:.0f}; within 5 cm and 5 deg {100 * found['within_5cm_5deg']:.1f} %",
        flush=True,
    )
