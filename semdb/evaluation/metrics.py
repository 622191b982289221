"""What an evaluation measures: one value per query, one summary per run.

The definitions are documented in docs/evaluation.md. Values only: nothing here runs anything.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.evaluation.refined_truth import Disagreement
from semdb.evaluation.retrieval import Reach, Retrieval, retrieval_figures
from semdb.evaluation.uncertainty import POSITION, ROTATION, Nees, nees_figures, normalised_error
from semdb.geometry import pose_error, pose_offset
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

COARSE_TRANSLATION_M, COARSE_ROTATION_DEG = 0.5, 10.0
TIMING_STAGES = ("decode", "detect", "encode", "features", "filter", "rank", "match", "pose", "total")


@dataclass(frozen=True, slots=True)
class QueryResult:
    """What became of one query.

    The errors are None where there is no pose (verdict `failed`) or no true pose; `other_*` are those against the
    other of two truths. `candidate` is the frame index of the best keyframe, in `candidate_recording`.
    `keyframe_in_reach`, `retrieval_rank` and `nearest_keyframe_*` are those of `semdb.evaluation.retrieval.Reach`;
    `retrieves` is False for methods that are told their keyframes. `nees` is the normalised error squared of position
    and of rotation, None where there is no pose, no covariance or no truth. The two poses ``[4, 4]`` and the covariance
    ``[6, 6]`` are for plots and trajectories and not written elsewhere.
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
    recording: str = ""
    timestamp_ns: int | None = None
    candidate_recording: str | None = None
    keyframe_in_reach: bool | None = None
    retrieval_rank: int | None = None
    nearest_keyframe_m: float | None = None
    nearest_keyframe_deg: float | None = None
    sharpness: float | None = None
    other_translation_m: float | None = None
    other_rotation_deg: float | None = None
    retrieves: bool = False
    nees: tuple[float, float] | None = None
    other_nees: tuple[float, float] | None = None
    covariance: FloatArray | None = field(default=None, compare=False, repr=False)
    world_from_camera: FloatArray | None = field(default=None, compare=False, repr=False)
    true_world_from_camera: FloatArray | None = field(default=None, compare=False, repr=False)

    @property
    def is_localized(self) -> bool:
        return self.verdict == Verdict.LOCALIZED

    @property
    def is_false(self) -> bool:
        """Reported as localized, but off by more than 0.25 m or 5 degrees."""
        return self.is_localized and not self.is_within(FALSE_TRANSLATION_M, FALSE_ROTATION_DEG)

    @property
    def has_right_pose(self) -> bool:
        """A pose within 0.25 m and 5 degrees, whatever the verdict, but for `coarse`: that has no confidence."""
        if self.verdict is Verdict.COARSE:
            return False
        if self.translation_m is None or self.rotation_deg is None:
            return False
        return self.translation_m <= FALSE_TRANSLATION_M and self.rotation_deg <= FALSE_ROTATION_DEG

    def is_within(self, translation_m: float, rotation_deg: float) -> bool:
        """Localized, and off by no more than the two limits."""
        if not self.is_localized or self.translation_m is None or self.rotation_deg is None:
            return False
        return self.translation_m <= translation_m and self.rotation_deg <= rotation_deg


@dataclass(frozen=True, slots=True)
class Errors:
    """Figures of errors against one truth: medians and means over localized queries, recalls over all."""

    false_localizations: int
    median_translation_m: float | None
    median_rotation_deg: float | None
    mean_translation_m: float | None
    mean_rotation_deg: float | None
    recall: Mapping[str, float | None]
    nees: Nees | None


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """One method on one recording. The fields are the JSON keys; all shares are 0..1; None where undefined.

    `truth` is ``given`` or ``refined``: whose poses the map and the errors are of. `other_errors` are the errors of
    the same answers against the other truth, where it is known. `pictures` are JPEG files by recording and frame
    index and are for reports only. `training_frames` are those that a network learnt poses from.
    """

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
    sequence: str | None = None
    keyframes_asked: int | None = None
    query_depth: bool = False
    map_recordings: tuple[str, ...] = ()
    query_recordings: tuple[str, ...] = ()
    retrieval: Retrieval | None = None
    coarse: Mapping[str, float | None] = field(default_factory=dict)
    truth: str = "given"
    other_errors: Errors | None = None
    disagreement: Disagreement | None = None
    nees: Nees | None = None
    training_frames: int | None = None
    pictures: Mapping[tuple[str, int], bytes] = field(default_factory=dict, compare=False, repr=False)


def query_result(
    frame: str,
    frame_index: int,
    localization: Localization,
    true_world_from_camera: FloatArray | None,
    *,
    timing_ms: Mapping[str, float] | None = None,
    recording: str = "",
    timestamp_ns: int | None = None,
) -> QueryResult:
    """The result of one query from what a localizer answered and the true pose ``[4, 4]``.

    `timing_ms` (of stages that the localizer does not see, such as decode) is added to the localizer's own.
    The candidate is the one with most inliers, or none where nothing was matched.
    """
    translation = rotation = nees = None
    estimate, covariance = localization.world_from_camera, localization.covariance
    if estimate is not None and true_world_from_camera is not None:
        translation, rotation = pose_error(estimate, true_world_from_camera)
        nees = _nees(estimate, covariance, true_world_from_camera)
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
        confidence=finite(localization.confidence),
        stage=localization.stage,
        ranked_share=finite(localization.ranked_share),
        keyframes_matched=localization.keyframes_matched,
        timing_ms={**localization.timing_ms, **(timing_ms or {})},
        reason=localization.reason,
        recording=recording,
        timestamp_ns=timestamp_ns,
        candidate_recording=None if best is None else best.recording,
        nees=nees,
        covariance=covariance,
        world_from_camera=estimate,
        true_world_from_camera=true_world_from_camera,
    )


def _nees(estimate: FloatArray, covariance: FloatArray | None, truth: FloatArray) -> tuple[float, float] | None:
    if covariance is None:
        return None
    offset = pose_offset(estimate, truth)
    return normalised_error(offset, covariance, POSITION), normalised_error(offset, covariance, ROTATION)


def with_reach(query: QueryResult, found: Reach, *, retrieves: bool) -> QueryResult:
    """The query with what the map had of its place, and where the method ranked it."""
    return replace(
        query,
        keyframe_in_reach=found.reachable,
        retrieval_rank=found.rank,
        nearest_keyframe_m=found.nearest_translation_m,
        nearest_keyframe_deg=found.nearest_rotation_deg,
        retrieves=retrieves,
    )


def with_other_truth(query: QueryResult, true_world_from_camera: FloatArray | None) -> QueryResult:
    """The query with its errors against a second truth ``[4, 4]`` too."""
    if true_world_from_camera is None or query.world_from_camera is None:
        return query
    metres, degrees = pose_error(query.world_from_camera, true_world_from_camera)
    nees = _nees(query.world_from_camera, query.covariance, true_world_from_camera)
    return replace(query, other_translation_m=metres, other_rotation_deg=degrees, other_nees=nees)


def error_figures(queries: Sequence[QueryResult]) -> Errors:
    """Medians and means of errors over localized queries, recalls over all queries; None where undefined."""
    localized = [query for query in queries if query.is_localized]
    translations = [query.translation_m for query in localized]
    rotations = [query.rotation_deg for query in localized]
    return Errors(
        false_localizations=sum(query.is_false for query in queries),
        median_translation_m=_median(translations),
        median_rotation_deg=_median(rotations),
        mean_translation_m=_mean(translations),
        mean_rotation_deg=_mean(rotations),
        recall={name: _recall(queries, limits) for name, limits in RECALL_LIMITS.items()},
        nees=nees_figures([query.nees for query in localized if query.nees is not None]),
    )


def coarse_figures(queries: Sequence[QueryResult]) -> dict[str, float | None]:
    """How many queries have a pose by landmarks alone, their share of all, and how many of them are near the truth.

    They count in no other figure.
    """
    found = [query for query in queries if query.verdict == Verdict.COARSE]
    known = [(q.translation_m, q.rotation_deg or 0.0) for q in found if q.translation_m is not None]
    right = sum(m <= COARSE_TRANSLATION_M and degrees <= COARSE_ROTATION_DEG for m, degrees in known)
    return {
        "queries": len(found),
        "share": len(found) / len(queries) if queries else None,
        "within_0.5m_10deg": right / len(known) if known else None,
    }


def other_error_figures(queries: Sequence[QueryResult]) -> Errors | None:
    """`error_figures` against the other truth, over the queries that it knows; None where it knows none."""
    swapped = [
        replace(
            query,
            translation_m=query.other_translation_m,
            rotation_deg=query.other_rotation_deg,
            nees=query.other_nees,
        )
        for query in queries
        if not query.is_localized or query.other_translation_m is not None
    ]
    known = any(query.other_translation_m is not None for query in queries)
    return error_figures(swapped) if known else None


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
    localized = sum(query.is_localized for query in results)
    errors = error_figures(results)
    known = [query for query in results if query.retrieves and query.keyframe_in_reach is not None]
    return EvaluationResult(
        recording=recording,
        protocol=protocol,
        method=method,
        models=tuple(models),
        frames=frames,
        keyframes=keyframes,
        queries=len(results),
        localized=localized,
        false_localizations=errors.false_localizations,
        success_rate=localized / len(results) if results else None,
        median_translation_m=errors.median_translation_m,
        median_rotation_deg=errors.median_rotation_deg,
        mean_translation_m=errors.mean_translation_m,
        mean_rotation_deg=errors.mean_rotation_deg,
        recall=errors.recall,
        ranked_share=_median(query.ranked_share for query in results),
        keyframes_matched=_median(float(query.keyframes_matched) for query in results),
        stages=dict(Counter(query.stage for query in results if query.stage)),
        timing_ms=_timing(results),
        per_query=results,
        retrieval=retrieval_figures(
            [bool(query.keyframe_in_reach) for query in known], [query.retrieval_rank for query in known]
        )
        if known
        else None,
        coarse=coarse_figures(results),
        other_errors=other_error_figures(results),
        nees=errors.nees,
    )


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


def finite(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _finite_values(values: Iterable[float | None]) -> list[float]:
    return [value for value in map(finite, values) if value is not None]


def _median(values: Iterable[float | None]) -> float | None:
    finite = _finite_values(values)
    return float(np.median(finite)) if finite else None


def _mean(values: Iterable[float | None]) -> float | None:
    finite = _finite_values(values)
    return float(np.mean(finite)) if finite else None
