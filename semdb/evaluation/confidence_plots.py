"""Plots of how far a confidence can be trusted; the figures are those of `semdb.evaluation.calibration`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from semdb.evaluation.calibration import (
    auroc,
    expected_calibration_error,
    precision_recall,
    reliability_bins,
)
from semdb.evaluation.metrics import EvaluationResult
from semdb.evaluation.plots import LABEL_CHARACTERS, SERIES, style_axes
from semdb.evaluation.uncertainty import held_shares
from semdb.pictures.drawing import FAINT, INK
from semdb.shown import for_legend
from semdb.types import BoolArray, FloatArray

INSIDE = 3  # series whose names have room inside the axes


def answers(result: EvaluationResult) -> tuple[FloatArray, BoolArray]:
    """Confidence ``[n]`` of every query that has one, and whether its pose is right: within 0.25 m and 5 degrees.

    The verdict plays no part: an ambiguous answer with a right pose is right, and a query without a pose is not.
    """
    known = [query for query in result.per_query if query.confidence is not None]
    confidence = np.array([query.confidence for query in known], dtype=np.float64)
    return confidence, np.array([query.has_right_pose for query in known], dtype=np.bool_)


def confidence_figures(confidence: npt.ArrayLike, correct: npt.ArrayLike) -> dict[str, float | None]:
    """`ece`, `auroc` and `average_precision`; None where undefined."""
    curve = precision_recall(confidence, correct)
    return {
        "ece": expected_calibration_error(confidence, correct),
        "auroc": auroc(confidence, correct),
        "average_precision": None if curve is None else curve.average_precision,
    }


def has_confidence(result: EvaluationResult) -> bool:
    """Whether its answers carry a confidence; those of reference methods do not."""
    return any(query.confidence is not None for query in result.per_query)


def confidence_plot(series: Sequence[tuple[str, FloatArray, BoolArray]]) -> Figure:
    """Precision over recall as confidence falls, and reliability: right answers per bin of confidence.

    `series` are (name, confidence ``[n]``, correct ``[n]``). Dots of the reliability plot grow with their bin. More
    series than have room inside the axes are named below them.
    """
    below = len(series) > INSIDE
    figure = Figure(figsize=(12.5, 5.2 + (0.22 * len(series) if below else 0)), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        style_axes(axes)
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    right.plot([0, 1], [0, 1], color=FAINT, lw=1.0, ls=(0, (4, 3)), zorder=1)
    lowest = 1.0
    for i, (name, confidence, correct) in enumerate(series):
        colour, shown = SERIES[i % len(SERIES)], for_legend(name, LABEL_CHARACTERS)
        figures = confidence_figures(confidence, correct)
        curve = precision_recall(confidence, correct)
        if curve is not None:
            label = f"{shown}: AUROC {_number(figures['auroc'])}"
            left.plot(curve.recall, curve.precision, color=colour, lw=2.0, label=label, drawstyle="steps-post")
            lowest = min(lowest, float(curve.precision.min()))
        bins = reliability_bins(confidence, correct)
        filled = bins.count > 0
        right.plot(bins.confidence[filled], bins.accuracy[filled], color=colour, lw=1.2, zorder=2)
        right.scatter(
            bins.confidence[filled], bins.accuracy[filled], s=20 + 260 * bins.count[filled] / bins.count.sum(),
            color=colour, zorder=3, label=f"{shown}: calibration error {_number(figures['ece'])}",
        )  # fmt: skip
    left.set_xlim(0, 1.02)
    left.set_ylim(max(0.0, lowest - 0.05), 1.01)
    left.set_xlabel("recall: right answers at least that confident, of all right ones")
    left.set_ylabel("precision")
    right.set_xlim(0, 1.02)
    right.set_ylim(0, 1.02)
    right.set_xlabel("confidence")
    right.set_ylabel("share of answers that are right")
    for axes, place in ((left, "lower left"), (right, "lower right")):
        if axes.get_legend_handles_labels()[0]:
            where = {"loc": "upper left", "bbox_to_anchor": (0, -0.13)} if below else {"loc": place}
            axes.legend(**where, labelcolor=INK, framealpha=1.0, edgecolor="white", fontsize=9, markerscale=0.6)
    return figure


def uncertainty_plot(series: Sequence[tuple[str, Sequence[tuple[float, float]]]]) -> Figure:
    """How many truths lie inside the ellipsoids that should hold a given share of them: position, and rotation.

    `series` are (name, normalised errors squared of position and rotation of localized queries). Below the diagonal
    covariances are too small, above it too large.
    """
    levels = np.linspace(0.02, 0.995, 60)
    figure = Figure(figsize=(12.5, 5.2), layout="constrained")
    for part, (axes, title) in enumerate(zip(figure.subplots(1, 2), ("position", "rotation"), strict=True)):
        style_axes(axes)
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.plot([0, 1], [0, 1], color=FAINT, lw=1.0, ls=(0, (4, 3)), zorder=1)
        for i, (name, errors) in enumerate(series):
            median = np.median([pair[part] for pair in errors])
            label = f"{for_legend(name, LABEL_CHARACTERS)}: median NEES {median:.2f} (true: 2.37)"
            axes.plot(levels, held_shares(errors, levels)[:, part], color=SERIES[i % len(SERIES)], lw=2.0, label=label)
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1.02)
        axes.set_xlabel(f"{title}: share that the ellipsoid should hold")
        axes.set_ylabel("share of true poses inside it")
        axes.legend(loc="upper left", labelcolor=INK, framealpha=1.0, edgecolor="white", fontsize=9)
    return figure


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
