"""What an evaluation measures: one value per query, one summary per run, and their JSON and CSV forms.

The definitions and every JSON key are documented in docs/evaluation.md. Values only: nothing here runs anything.
"""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import UsageError
from semdb.geometry import pose_error
from semdb.types import FloatArray, Localization, ModelInfo, Verdict

FALSE_TRANSLATION_M = 0.25
FALSE_ROTATION_DEG = 5.0

# name -> (metres, degrees); a query counts when it is localized and within both
RECALL_LIMITS: Mapping[str, tuple[float, float]] = {
    "5cm_5deg": (0.05, 5.0),
    "0.25m_2deg": (0.25, 2.0),
    "0.3m": (0.3, math.inf),
    "2.5deg": (math.inf, 2.5),
}

TIMING_STAGES = ("decode", "detect", "encode", "features", "filter", "rank", "match", "pose", "total")


@dataclass(frozen=True, slots=True)
class QueryResult:
    """What became of one query.

    The errors are None where there is no pose (verdict `failed`) or no true pose. `candidate` is the frame index
    of the best keyframe. The two poses ``[4, 4]`` are for plots and are not written to files.
    """

    frame: str
    frame_index: int
    verdict: Verdict
    translation_m: float | None
    rotation_deg: float | None
    candidate: int | None
    inliers: int
    confidence: float | None
    stage: str
    ranked_share: float | None
    keyframes_matched: int
    timing_ms: Mapping[str, float] = field(default_factory=dict)
    reason: str = ""
    world_from_camera: FloatArray | None = field(default=None, compare=False, repr=False)
    true_world_from_camera: FloatArray | None = field(default=None, compare=False, repr=False)

    @property
    def is_localized(self) -> bool:
        return self.verdict == Verdict.LOCALIZED

    @property
    def is_false(self) -> bool:
        """Reported as localized, but off by more than 0.25 m or 5 degrees."""
        return self.is_localized and not self.is_within(FALSE_TRANSLATION_M, FALSE_ROTATION_DEG)

    def is_within(self, translation_m: float, rotation_deg: float) -> bool:
        """Localized, and off by no more than the two limits."""
        if not self.is_localized or self.translation_m is None or self.rotation_deg is None:
            return False
        return self.translation_m <= translation_m and self.rotation_deg <= rotation_deg


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """One method on one recording. The fields are the JSON keys; all shares are 0..1; None where undefined."""

    recording: str
    protocol: str
    method: str
    models: tuple[ModelInfo, ...]
    frames: int
    keyframes: int
    queries: int
    localized: int
    false_localizations: int
    success_rate: float | None
    median_translation_m: float | None
    median_rotation_deg: float | None
    mean_translation_m: float | None
    mean_rotation_deg: float | None
    recall: Mapping[str, float | None]
    ranked_share: float | None
    keyframes_matched: float | None
    stages: Mapping[str, int]
    timing_ms: Mapping[str, Mapping[str, float | None]]
    per_query: tuple[QueryResult, ...]


def query_result(
    frame: str,
    frame_index: int,
    localization: Localization,
    true_world_from_camera: FloatArray | None,
    *,
    timing_ms: Mapping[str, float] | None = None,
) -> QueryResult:
    """The result of one query from what a localizer answered and the true pose ``[4, 4]``.

    `timing_ms` (of stages that the localizer does not see, such as decode) is added to the localizer's own.
    The candidate is the one with most inliers, or none where nothing was matched.
    """
    translation = rotation = None
    estimate = localization.world_from_camera
    if estimate is not None and true_world_from_camera is not None:
        translation, rotation = pose_error(estimate, true_world_from_camera)
    matched = [candidate for candidate in localization.candidates if candidate.inliers > 0]
    best = max(matched, key=lambda candidate: candidate.inliers, default=None)
    if localization.best_keyframe_id is not None:
        chosen = [c for c in localization.candidates if c.keyframe_id == localization.best_keyframe_id]
        best = chosen[0] if chosen else best
    return QueryResult(
        frame=frame,
        frame_index=frame_index,
        verdict=localization.verdict,
        translation_m=translation,
        rotation_deg=rotation,
        candidate=None if best is None else best.frame_index,
        inliers=localization.inliers,
        confidence=_finite(localization.confidence),
        stage=localization.stage,
        ranked_share=_finite(localization.ranked_share),
        keyframes_matched=localization.keyframes_matched,
        timing_ms={**localization.timing_ms, **(timing_ms or {})},
        reason=localization.reason,
        world_from_camera=estimate,
        true_world_from_camera=true_world_from_camera,
    )


def summarise(
    queries: Iterable[QueryResult],
    *,
    recording: str,
    protocol: str,
    method: str,
    models: Sequence[ModelInfo],
    frames: int,
    keyframes: int,
) -> EvaluationResult:
    """Sum up the queries of one method on one recording.

    Medians and means of errors are over localized queries, recalls over all queries, the medians of work over all
    queries. Whatever is undefined (nothing localized, no query) is None. `stages` counts all queries by the stage
    that gave the answer, a failure included.
    """
    results = tuple(queries)
    localized = [query for query in results if query.is_localized]
    translations = [query.translation_m for query in localized]
    rotations = [query.rotation_deg for query in localized]
    return EvaluationResult(
        recording=recording,
        protocol=protocol,
        method=method,
        models=tuple(models),
        frames=frames,
        keyframes=keyframes,
        queries=len(results),
        localized=len(localized),
        false_localizations=sum(query.is_false for query in results),
        success_rate=len(localized) / len(results) if results else None,
        median_translation_m=_median(translations),
        median_rotation_deg=_median(rotations),
        mean_translation_m=_mean(translations),
        mean_rotation_deg=_mean(rotations),
        recall={name: _recall(results, limits) for name, limits in RECALL_LIMITS.items()},
        ranked_share=_median(query.ranked_share for query in results),
        keyframes_matched=_median(float(query.keyframes_matched) for query in results),
        stages=dict(Counter(query.stage for query in results if query.stage)),
        timing_ms=_timing(results),
        per_query=results,
    )


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
        "per_query": [_query_to_json(query) for query in result.per_query],
    }


def write_json(path: Path, results: Sequence[EvaluationResult]) -> None:
    """One object for one result, a list of them for several. Raises UsageError where `path` cannot be written."""
    objects = [to_json(result) for result in results]
    text = json.dumps(objects[0] if len(objects) == 1 else objects, indent=2, allow_nan=False)
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"the results cannot be written to {path}: {error.strerror}") from error


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
    "reason",
)


def write_queries_csv(path: Path, results: Sequence[EvaluationResult]) -> None:
    """One row per query of every result; an empty cell where a value is undefined.

    Raises UsageError where `path` cannot be written.
    """
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
            writer.writeheader()
            writer.writerows(row for result in results for row in _csv_rows(result))
    except OSError as error:
        raise UsageError(f"the queries cannot be written to {path}: {error.strerror}") from error


def _csv_rows(result: EvaluationResult) -> Iterator[dict[str, Any]]:
    shared = {"recording": result.recording, "method": result.method, "keyframes": result.keyframes}
    for query in result.per_query:
        yield {**_query_to_json(query), **shared, "total_ms": _finite(query.timing_ms.get("total"))}


def _query_to_json(query: QueryResult) -> dict[str, Any]:
    return {
        "frame": query.frame,
        "frame_index": query.frame_index,
        "verdict": str(query.verdict),
        "translation_m": _finite(query.translation_m),
        "rotation_deg": _finite(query.rotation_deg),
        "candidate": query.candidate,
        "inliers": query.inliers,
        "confidence": _finite(query.confidence),
        "stage": query.stage,
        "ranked_share": _finite(query.ranked_share),
        "keyframes_matched": query.keyframes_matched,
        "timing_ms": {stage: _finite(value) for stage, value in query.timing_ms.items()},
        "reason": query.reason,
    }


def _model_to_json(model: ModelInfo) -> dict[str, Any]:
    return {"name": model.name, "sha256": model.sha256, "config": json.loads(model.config)}


def _timing(queries: Sequence[QueryResult]) -> dict[str, dict[str, float | None]]:
    """Percentiles per stage over the queries that ran it; every documented stage is there, None if nobody ran it."""
    extra = sorted({stage for query in queries for stage in query.timing_ms} - set(TIMING_STAGES))
    timing: dict[str, dict[str, float | None]] = {}
    for stage in (*TIMING_STAGES, *extra):
        values = _finite_values(query.timing_ms.get(stage) for query in queries)
        timing[stage] = {
            f"p{percent}": float(np.percentile(values, percent)) if values else None for percent in (50, 95)
        }
    return timing


def _recall(queries: Sequence[QueryResult], limits: tuple[float, float]) -> float | None:
    return sum(query.is_within(*limits) for query in queries) / len(queries) if queries else None


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _finite_values(values: Iterable[float | None]) -> list[float]:
    return [value for value in map(_finite, values) if value is not None]


def _median(values: Iterable[float | None]) -> float | None:
    finite = _finite_values(values)
    return float(np.median(finite)) if finite else None


def _mean(values: Iterable[float | None]) -> float | None:
    finite = _finite_values(values)
    return float(np.mean(finite)) if finite else None
