"""Results as JSON and CSV files. Every key is documented in docs/evaluation.md."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from semdb.errors import UsageError
from semdb.evaluation.averages import Average
from semdb.evaluation.metrics import EvaluationResult, QueryResult, finite
from semdb.types import ModelInfo


def to_json(result: EvaluationResult) -> dict[str, Any]:
    """The result as plain JSON values under the documented keys; never NaN or infinity."""
    return {
        "recording": result.recording,
        "protocol": result.protocol,
        "method": result.method,
        "models": {model.role: _model_to_json(model) for model in result.models},
        "frames": result.frames,
        "keyframes": result.keyframes,
        "queries": result.queries,
        "localized": result.localized,
        "false_localizations": result.false_localizations,
        "success_rate": result.success_rate,
        "median_translation_m": result.median_translation_m,
        "median_rotation_deg": result.median_rotation_deg,
        "mean_translation_m": result.mean_translation_m,
        "mean_rotation_deg": result.mean_rotation_deg,
        "recall": dict(result.recall),
        "ranked_share": result.ranked_share,
        "keyframes_matched": result.keyframes_matched,
        "stages": dict(result.stages),
        "timing_ms": {stage: dict(values) for stage, values in result.timing_ms.items()},
        "sequence": result.sequence,
        "keyframes_asked": result.keyframes_asked,
        "query_depth": result.query_depth,
        "map_recordings": list(result.map_recordings),
        "query_recordings": list(result.query_recordings),
        "retrieval": None if result.retrieval is None else asdict(result.retrieval),
        "coarse": dict(result.coarse),
        "truth": result.truth,
        "other_errors": None if result.other_errors is None else asdict(result.other_errors),
        "disagreement": None if result.disagreement is None else asdict(result.disagreement),
        "nees": None if result.nees is None else asdict(result.nees),
        "training_frames": result.training_frames,
        "per_query": [_query_to_json(query) for query in result.per_query],
    }


def write_json(path: Path, results: Sequence[EvaluationResult], *, several: bool | None = None) -> None:
    """One object for one result, a list of them for several; `several` decides where more may follow.

    The file is replaced as a whole: a reader never sees half of it, and a write that fails leaves the one before.
    Raises UsageError where `path` cannot be written.
    """
    objects = [to_json(result) for result in results]
    as_list = len(objects) != 1 if several is None else several
    text = json.dumps(objects if as_list else objects[0], indent=2, allow_nan=False) + "\n"
    try:
        if path.exists() and not path.is_file():  # a pipe or a device
            path.write_text(text, encoding="utf-8")
            return
        draft = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            draft.write_text(text, encoding="utf-8")
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"the results cannot be written to {path}: {error.strerror}") from error


def write_averages(path: Path, averages: Sequence[Average]) -> None:
    """A list with one object per average. Raises OSError."""
    path.write_text(json.dumps([asdict(average) for average in averages], indent=2) + "\n", encoding="utf-8")


CSV_COLUMNS = (
    "recording",
    "method",
    "keyframes",
    "frame",
    "frame_index",
    "verdict",
    "translation_m",
    "rotation_deg",
    "candidate",
    "inliers",
    "confidence",
    "stage",
    "ranked_share",
    "keyframes_matched",
    "total_ms",
    "query_recording",
    "timestamp_ns",
    "candidate_recording",
    "keyframe_in_reach",
    "retrieval_rank",
    "nearest_keyframe_m",
    "nearest_keyframe_deg",
    "sharpness",
    "other_translation_m",
    "other_rotation_deg",
    "truth",
    "reason",
)


def write_queries_csv(path: Path, results: Sequence[EvaluationResult]) -> None:
    """One row per query of every result; an empty cell where a value is undefined.

    Raises UsageError where `path` cannot be written.
    """
    try:
        with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
            writer = csv.DictWriter(file, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
            writer.writeheader()
            writer.writerows(row for result in results for row in _csv_rows(result))
    except OSError as error:
        raise UsageError(f"the queries cannot be written to {path}: {error.strerror}") from error


def _csv_rows(result: EvaluationResult) -> Iterator[dict[str, Any]]:
    shared = {
        "recording": result.recording,
        "method": result.method,
        "keyframes": result.keyframes,
        "truth": result.truth,
    }
    for query in result.per_query:
        own = {"query_recording": query.recording, "total_ms": finite(query.timing_ms.get("total"))}
        yield {**_query_to_json(query), **shared, **own}


def _query_to_json(query: QueryResult) -> dict[str, Any]:
    return {
        "frame": query.frame,
        "frame_index": query.frame_index,
        "verdict": str(query.verdict),
        "translation_m": finite(query.translation_m),
        "rotation_deg": finite(query.rotation_deg),
        "candidate": query.candidate,
        "inliers": query.inliers,
        "confidence": finite(query.confidence),
        "stage": query.stage,
        "ranked_share": finite(query.ranked_share),
        "keyframes_matched": query.keyframes_matched,
        "timing_ms": {stage: finite(value) for stage, value in query.timing_ms.items()},
        "reason": query.reason,
        "recording": query.recording,
        "timestamp_ns": query.timestamp_ns,
        "candidate_recording": query.candidate_recording,
        "keyframe_in_reach": query.keyframe_in_reach,
        "retrieval_rank": query.retrieval_rank,
        "nearest_keyframe_m": finite(query.nearest_keyframe_m),
        "nearest_keyframe_deg": finite(query.nearest_keyframe_deg),
        "sharpness": finite(query.sharpness),
        "other_translation_m": finite(query.other_translation_m),
        "other_rotation_deg": finite(query.other_rotation_deg),
        "nees_position": None if query.nees is None else finite(query.nees[0]),
        "nees_rotation": None if query.nees is None else finite(query.nees[1]),
    }


def _model_to_json(model: ModelInfo) -> dict[str, Any]:
    return {"name": model.name, "sha256": model.sha256, "config": json.loads(model.config)}
