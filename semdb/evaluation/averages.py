"""Averages over several recordings, made as those of the paper's Table 3.

The paper's rows "all" are plain means of the figures of the sequences, each sequence counting once however many
queries it has, also of medians: its figures repeat that way within one unit of the last digit, and not as means over
queries.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from semdb.evaluation.methods import place_of
from semdb.evaluation.metrics import EvaluationResult
from semdb.evaluation.published import PAPER_SEQUENCES

ALL_RECORDINGS = "all recordings"


@dataclass(frozen=True, slots=True)
class Average:
    """Means over `sequences` results of one method; None where a figure is undefined for one of them."""

    name: str
    method: str
    truth: str
    keyframes_asked: int | None
    sequences: int
    keyframes: int
    queries: int
    localized: int
    false_localizations: int
    success_rate: float | None
    median_translation_m: float | None
    median_rotation_deg: float | None
    mean_translation_m: float | None
    mean_rotation_deg: float | None
    recall_5cm_5deg: float | None


def averages(results: Sequence[EvaluationResult]) -> list[Average]:
    """One row per collection of the paper ("ICL-NUIM, all", "TUM RGB-D, all"), and one over all recordings.

    Only where there are at least two recordings; each method, number of keyframes and truth by itself. Counts are
    sums.
    """
    groups: dict[tuple[str, str, str, int | None], list[EvaluationResult]] = {}
    for result in results:
        key = result.method, result.truth, result.keyframes_asked
        groups.setdefault((_collection(result), *key), []).append(result)
        groups.setdefault((ALL_RECORDINGS, *key), []).append(result)
    found = []
    for (name, method, truth, asked), group in sorted(groups.items(), key=lambda item: _order(item[0])):
        whole = groups[ALL_RECORDINGS, method, truth, asked]
        if len(group) < 2 or not name or (name == ALL_RECORDINGS and _is_repeated(whole, groups)):
            continue
        found.append(_average(name, method, truth, asked, group))
    return found


def _collection(result: EvaluationResult) -> str:
    row = PAPER_SEQUENCES.get(result.sequence or "")
    return "" if row is None else f"{row.collection}, all"


def _order(key: tuple[str, str, str, int | None]) -> tuple[bool, str, str, int, str, int]:
    name, method, truth, asked = key
    return name == ALL_RECORDINGS, name, truth, place_of(method), method, asked or 0


def _is_repeated(
    whole: Sequence[EvaluationResult], groups: dict[tuple[str, str, str, int | None], list[EvaluationResult]]
) -> bool:
    """Whether the row over all recordings would say again what the row of one collection says."""
    return any(name and name != ALL_RECORDINGS and group == whole for (name, *_), group in groups.items())


def _average(name: str, method: str, truth: str, asked: int | None, group: Sequence[EvaluationResult]) -> Average:
    return Average(
        name=name,
        method=method,
        truth=truth,
        keyframes_asked=asked,
        sequences=len(group),
        keyframes=sum(result.keyframes for result in group),
        queries=sum(result.queries for result in group),
        localized=sum(result.localized for result in group),
        false_localizations=sum(result.false_localizations for result in group),
        success_rate=plain_mean(result.success_rate for result in group),
        median_translation_m=plain_mean(result.median_translation_m for result in group),
        median_rotation_deg=plain_mean(result.median_rotation_deg for result in group),
        mean_translation_m=plain_mean(result.mean_translation_m for result in group),
        mean_rotation_deg=plain_mean(result.mean_rotation_deg for result in group),
        recall_5cm_5deg=plain_mean(result.recall["5cm_5deg"] for result in group),
    )


def plain_mean(values: Iterable[float | None]) -> float | None:
    """None where there is nothing, or something undefined."""
    listed = list(values)
    known = [value for value in listed if value is not None]
    return sum(known) / len(known) if known and len(known) == len(listed) else None
