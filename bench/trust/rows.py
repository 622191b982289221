"""Answers of `bench.trust` as rows: kept in a file, judged again, counted, drawn."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from bench.trust.suites import HARD, NEGATIVE, POSITIVE, TEST, Asked, Query
from semdb.evaluation.calibration import auroc, expected_calibration_error
from semdb.evaluation.metrics import FALSE_ROTATION_DEG, FALSE_TRANSLATION_M
from semdb.evaluation.uncertainty import POSITION, ROTATION, normalised_error
from semdb.geometry import pose_error, pose_offset
from semdb.localization.confidence import Evidence
from semdb.localization.verdict import VerdictOptions, judge
from semdb.types import FloatArray, Localization, Verdict

OFF_M, OFF_DEG = 0.05, 5.0
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.82, 0.9, 0.95, 0.98, 1.0)  # of confidences, in the table of how often they hold
COUNTS = ("inliers", "first_inliers", "first_of_best", "rival", "supporters", "second", "class_points")


@dataclass(frozen=True, slots=True)
class Row:
    """One answer. Errors are None without a pose or a true pose; `nees` of all six, position and rotation.

    `laid` is a verdict with its confidence and reason that the query's edges on those of the map gave: it is kept, for
    it is not made of the evidence of keypoints alone.
    """

    world: str
    name: str
    map_name: str
    half: str
    suite: str
    kind: str
    verdict: str
    confidence: float
    translation_m: float | None
    rotation_deg: float | None
    nees: tuple[float, float, float] | None
    milliseconds: float
    reason: str
    evidence: dict[str, float]
    laid: tuple[str, float, str] | None = None

    @property
    def is_right(self) -> bool:
        """Whether its pose, whatever the verdict, is within the limits of a false localization."""
        if self.kind == NEGATIVE or self.translation_m is None or self.rotation_deg is None:
            return False
        return self.translation_m <= FALSE_TRANSLATION_M and self.rotation_deg <= FALSE_ROTATION_DEG

    @property
    def is_off(self) -> bool:
        """Whether it is localized more than 5 cm or 5 degrees from the truth."""
        if not self.is_localized or self.kind == NEGATIVE:
            return self.is_localized
        return self.translation_m is None or self.translation_m > OFF_M or (self.rotation_deg or 0.0) > OFF_DEG

    @property
    def is_localized(self) -> bool:
        return self.verdict == Verdict.LOCALIZED

    @property
    def is_false(self) -> bool:
        return self.is_localized and not self.is_right


def make_row(world: str, query: Query, asked: Asked, half: str, found: Localization, asked_with: VerdictOptions) -> Row:
    """The row of an answer of a localizer with the bounds `asked_with`, judged with those that are usual."""
    translation = rotation = nees = None
    truth = query.world_from_camera if asked.kind != NEGATIVE else None
    if truth is not None and found.world_from_camera is not None:
        translation, rotation = pose_error(found.world_from_camera, truth)
        if found.covariance is not None:
            nees = normalised_errors(found.world_from_camera, truth, found.covariance)
    row = Row(
        world=world,
        name=query.name,
        map_name=asked.map_name,
        half=half,
        suite=asked.suite,
        kind=asked.kind,
        verdict="",
        confidence=0.0,
        translation_m=translation,
        rotation_deg=rotation,
        nees=nees,
        milliseconds=found.timing_ms["match"] + found.timing_ms["pose"],
        reason="",
        evidence=dict(found.evidence),
    )
    if judge(evidence_of(row), asked_with).reason != found.reason:
        row = replace(row, laid=(str(found.verdict), found.confidence, found.reason))
    return judged(row)


def evidence_of(row: Row) -> Evidence | None:
    """The evidence as the verdict takes it; None where no pose was found."""
    names = {field.name for field in fields(Evidence)}
    if not names <= row.evidence.keys():
        return None
    values = {n: int(v) if n in COUNTS else float(v) for n, v in row.evidence.items() if n in names}
    return Evidence(**values)  # type: ignore[arg-type]


def judged(row: Row) -> Row:
    """The row with the verdict and the confidence that its evidence has now, or that edges gave."""
    if row.laid is not None:
        verdict, confidence, reason = row.laid
        return replace(row, verdict=verdict, confidence=confidence, reason=reason)
    found = judge(evidence_of(row), VerdictOptions())
    return replace(row, verdict=str(found.verdict), confidence=found.confidence, reason=found.reason)


def normalised_errors(estimate: FloatArray, truth: FloatArray, covariance: FloatArray) -> tuple[float, float, float]:
    """Normalised estimation error squared: of position and rotation together (6), of position (3), of rotation (3)."""
    error = pose_offset(estimate, truth)
    whole, position, rotation = (normalised_error(error, covariance, p) for p in (slice(0, 6), POSITION, ROTATION))
    return whole, position, rotation


def save_rows(path: Path, rows: Iterable[Row]) -> None:
    path.write_text(json.dumps([asdict(row) for row in rows], separators=(",", ":")) + "\n")


def load_rows(path: Path) -> list[Row]:
    """The rows of a file of `save_rows`, judged anew."""
    return [
        judged(Row(**{**row, **{name: tuple(row[name]) if row.get(name) else None for name in ("nees", "laid")}}))
        for row in json.loads(path.read_text())
    ]


def report(rows: Sequence[Row]) -> str:
    """Counts per suite, the bars, calibration per half, and how honest the covariance is."""
    lines = [f"{'suite':34} {'asked':>6} {'localized':>10} {'right':>7} {'false':>6} {'off':>5} {'ambiguous':>10}"]
    for kind in (POSITIVE, HARD, NEGATIVE):
        for world in dict.fromkeys(row.world for row in rows):
            for suite in dict.fromkeys(r.suite for r in rows if r.kind == kind and r.world == world):
                chosen = [r for r in rows if (r.kind, r.suite, r.world) == (kind, suite, world)]
                lines.append(_line(f"{kind}: {suite} ({world[:5]})", chosen))
    for name, kinds in (("positive", (POSITIVE,)), ("negative and hard", (NEGATIVE, HARD)), ("negative", (NEGATIVE,))):
        lines.append(_line(f"ALL {name}", [r for r in rows if r.kind in kinds]))
    for half in dict.fromkeys(row.half for row in rows):
        for world in ("", *dict.fromkeys(row.world for row in rows)):
            lines.append(_calibration(half, world, [r for r in rows if r.half == half and world in ("", r.world)]))
    lines += _reliability(rows)
    for world in dict.fromkeys(row.world for row in rows):
        lines.append(_honesty(world, [r for r in rows if r.world == world]))
    return "\n".join(lines)


def _line(name: str, rows: Sequence[Row]) -> str:
    localized = sum(r.is_localized for r in rows)
    false = sum(r.is_false for r in rows)
    off = sum(r.is_off for r in rows)
    ambiguous = sum(r.verdict == Verdict.AMBIGUOUS for r in rows)
    share = f"{false / len(rows):.2%}" if rows else ""
    return f"{name:34.34} {len(rows):6} {localized:10} {localized - false:7} {false:6} {off:5} {ambiguous:10}  {share}"


def _calibration(half: str, world: str, rows: Sequence[Row]) -> str:
    confidence, right = np.array([r.confidence for r in rows]), np.array([r.is_right for r in rows])
    negative = np.mean([r.kind == NEGATIVE for r in rows]) if rows else 0.0
    with_pose = confidence > 0
    values = (expected_calibration_error(confidence, right), auroc(confidence, right))
    posed = expected_calibration_error(confidence[with_pose], right[with_pose])
    shown = [math.nan if v is None else v for v in (*values, posed)]
    held_out = " (held out)" if half == TEST else ""
    return (
        f"{half}{held_out} {world or 'all'}: {len(rows)} queries, {negative:.0%} negative: calibration error "
        f"{shown[0]:.3f} (of those with a confidence {shown[2]:.3f}), AUROC {shown[1]:.4f}"
    )


def _reliability(rows: Sequence[Row]) -> list[str]:
    """How often answers of a confidence are right, in every world, and those of more than 5 cm or 5 degrees."""
    worlds = list(dict.fromkeys(row.world for row in rows))
    lines = ["confidence, and how many of those with it are right: " + ", ".join(worlds)]
    for low, high in itertools.pairwise(BINS):
        inside = [r for r in rows if r.confidence > 0 and low <= r.confidence and (r.confidence < high or high == 1.0)]
        parts = []
        for world in worlds:
            own = [r for r in inside if r.world == world]
            parts.append(f"{sum(r.is_right for r in own):5} of {len(own):4}")
        lines.append(f"{low:.2f} to {high:.2f}  " + "  ".join(parts))
    for world in worlds:
        sure = [r for r in rows if r.world == world and r.is_localized]
        own = [r for r in sure if r.kind != NEGATIVE]
        off = sum(r.is_off for r in sure)
        lines.append(
            f"{world}: {off} of {len(sure)} localized are more than 5 cm or 5 degrees off or of another place "
            f"({off / max(len(sure), 1):.2%}); {len(own)} of their own place"
        )
    return lines


def _honesty(world: str, rows: Sequence[Row]) -> str:
    """Mean normalised error over degrees of freedom of the positives that are right, with its 95 % bounds."""
    parts = []
    chosen = [r.nees for r in rows if r.kind == POSITIVE and r.is_localized and r.is_right and r.nees is not None]
    for name, index, freedom in (("pose", 0, 6), ("position", 1, 3), ("rotation", 2, 3)):
        values = np.array([n[index] for n in chosen])
        if len(values) == 0:
            continue
        low, high = (chi2.ppf(q, freedom * len(values)) / len(values) for q in (0.025, 0.975))
        inside = np.mean(values < chi2.ppf(0.95, freedom))
        parts.append(
            f"{name} {values.mean():.2f} (bounds {low:.2f} to {high:.2f}; median {np.median(values):.2f} of "
            f"{chi2.ppf(0.5, freedom):.2f}; {inside:.1%} below the 95 % limit)"
        )
    return f"normalised errors squared, {world}, {len(chosen)} positives: " + "; ".join(parts)


def save_plots(folder: Path, rows: Sequence[Row]) -> None:
    """Precision and recall over confidence, and reliability, of the held-out half, as a PNG file."""
    from semdb.evaluation.confidence_plots import confidence_plot
    from semdb.evaluation.plots import figure_png

    folder.mkdir(parents=True, exist_ok=True)
    series = []
    for world in dict.fromkeys(row.world for row in rows):
        chosen = [row for row in rows if row.half == TEST and row.world == world]
        confidence, right = np.array([r.confidence for r in chosen]), np.array([r.is_right for r in chosen])
        if right.any() and not right.all():
            series.append((world, confidence, right))
    (folder / "confidence.png").write_bytes(figure_png(confidence_plot(series)))
