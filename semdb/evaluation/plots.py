"""Plots of an evaluation, as matplotlib figures of the object API (no pyplot, no display, nothing global)."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, PercentFormatter

from semdb.evaluation.metrics import FALSE_TRANSLATION_M, TIMING_STAGES, EvaluationResult, QueryResult
from semdb.evaluation.published import PAPER_ROTATION, PAPER_TRANSLATION
from semdb.pictures.drawing import FAINT, INK, VERDICT_COLOURS
from semdb.pictures.top_view import horizontal_axes
from semdb.shown import for_legend, for_plot
from semdb.types import FloatArray, Verdict

TRANSLATION_RANGE_M = 0.5
ROTATION_RANGE_DEG = 10.0
# Okabe and Ito's palette: told apart by readers with any colour vision
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINES = ("-", "--", ":", "-.")  # for the colours' second to fourth time
LEGEND_CHARACTERS = 150  # side by side below a figure
LABEL_CHARACTERS = 70
TITLE_CHARACTERS = 110
STAGE_COLOURS = ("#c9d0d8", "#0072B2", "#56B4E9", "#009E73", "#F0E442", "#E69F00", "#D55E00", "#CC79A7")
GRID = "#e3e7ec"
DPI = 110


def figure_png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=DPI, facecolor="white")
    return buffer.getvalue()


def cumulative_shares(errors: Sequence[float | None], queries: int, limits: FloatArray) -> FloatArray:
    """Share ``[n]`` of all `queries` whose error is at most each of `limits` ``[n]``; None counts as never."""
    known = np.sort([error for error in errors if error is not None])
    counts = np.searchsorted(known, limits, side="right")
    shares: FloatArray = counts / queries if queries else np.zeros(len(limits))
    return shares


def series_names(results: Sequence[EvaluationResult]) -> list[str]:
    """What tells the results apart: the method, and recording and number of keyframes where they differ or help."""
    recordings = {result.recording for result in results}
    names = []
    for result in results:
        parts = [result.recording] if len(recordings) > 1 else []
        parts += [result.method, f"{result.keyframes} keyframes"]
        names.append(", ".join([*parts, *(["refined poses"] if result.truth == "refined" else [])]))
    return names


def cumulative_plot(results: Sequence[EvaluationResult]) -> Figure:
    """Share of queries within x metres up to 0.5, and within x degrees up to 10, as the paper's Figures 6 and 7.

    Shares are of all queries: one that is not localized is within nothing. The paper's own levels are marked. Below,
    the same up to 0.05 m and 2.5 degrees, where methods differ.
    """
    longest = max((len(for_legend(name, LABEL_CHARACTERS)) for name in series_names(results)), default=0)
    columns = LEGEND_CHARACTERS // (longest + 8)
    columns = min(max(columns, 1), 4)
    figure = Figure(figsize=(12.5, 9.4 + 0.24 * math.ceil(len(results) / columns)), layout="constrained")
    panels = figure.subplots(2, 2)
    for row, whole in enumerate((True, False)):
        for axes, field, reach, near, label in (
            (panels[row][0], "translation_m", TRANSLATION_RANGE_M, 0.05, "position error (m)"),
            (panels[row][1], "rotation_deg", ROTATION_RANGE_DEG, 2.5, "rotation error (degrees)"),
        ):
            _curves(axes, results, field, reach if whole else near)
            axes.set_xlabel(label)
    for axes, paper, limit in ((panels[0][0], PAPER_TRANSLATION, "0.3 m"), (panels[0][1], PAPER_ROTATION, "2.5°")):
        _mark_paper(axes, paper, limit)
    legend_below(figure, panels[0][0], columns)
    return figure


def legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """What the lines of `axes` are, below all axes, where it hides none of them however many they are."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="outside lower center", ncols=min(columns, len(handles)), frameon=False, labelcolor=INK
        )


def _curves(axes: Axes, results: Sequence[EvaluationResult], field: str, reach: float) -> None:
    style_axes(axes)
    x = np.linspace(0, reach, 1001)
    for i, (result, name) in enumerate(zip(results, series_names(results), strict=True)):
        errors = [getattr(query, field) for query in result.per_query if query.is_localized]
        shares = cumulative_shares(errors, result.queries, x)
        style = LINES[i // len(SERIES) % len(LINES)]
        label = for_legend(name, LABEL_CHARACTERS)
        axes.plot(x, shares, style, color=SERIES[i % len(SERIES)], lw=2.0, label=label, drawstyle="steps-post")
    axes.set_xlim(0, reach)
    axes.set_ylim(0, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylabel("share of all queries")


def _mark_paper(axes: Axes, paper: tuple[float, float], limit: str) -> None:
    axes.plot([paper[0]] * 2, [0, paper[1]], color=FAINT, lw=1.0, ls=(0, (4, 3)), zorder=1)
    axes.plot([0, paper[0]], [paper[1]] * 2, color=FAINT, lw=1.0, ls=(0, (4, 3)), zorder=1)
    axes.plot(*paper, "D", color="white", mec=FAINT, mew=1.5, ms=7, zorder=5)
    axes.annotate(
        f"the paper: {paper[1]:.0%} within {limit}", paper, (9, -15), textcoords="offset points",
        color=FAINT, fontsize=10,
    )  # fmt: skip


def timing_plot(results: Sequence[EvaluationResult]) -> Figure | None:
    """Where the time of a query goes: the median of every stage side by side, one bar per result; None without times.

    What the stages leave of the median of the whole is "other"; medians do not add up exactly.
    """
    stages = [stage for stage in TIMING_STAGES if stage != "total"]
    known = [result for result in results if result.timing_ms.get("total", {}).get("p50") is not None]
    if not known:
        return None
    figure = Figure(figsize=(12.5, 1.1 + 0.42 * len(known)), layout="constrained")
    axes = figure.subplots()
    style_axes(axes)
    axes.grid(visible=False, axis="y")
    rows = np.arange(len(known))  # not the names themselves, of which equal ones would share a bar
    axes.set_yticks(rows, labels=[for_plot(name, LABEL_CHARACTERS) for name in series_names(known)])
    left = np.zeros(len(known))
    for colour, stage in zip(STAGE_COLOURS, stages, strict=True):
        widths = np.array([result.timing_ms.get(stage, {}).get("p50") or 0.0 for result in known])
        if widths.any():
            axes.barh(rows, widths, left=left, color=colour, height=0.66, label=stage, zorder=3)
            left += widths
    total = np.array([result.timing_ms["total"]["p50"] or 0.0 for result in known])
    rest = np.maximum(total - left, 0.0)
    axes.barh(rows, rest, left=left, color=GRID, height=0.66, label="other", zorder=3)
    for y, (drawn, value) in enumerate(zip(left + rest, total, strict=True)):
        axes.text(drawn, y, f"  {value:.0f} ms", va="center", color=INK, fontsize=10)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.12 * float((left + rest).max()))
    axes.set_xlabel("milliseconds per query, median")
    figure.legend(loc="outside upper center", ncols=9, frameon=False, labelcolor=INK, fontsize=9)
    return figure


def trajectory_plot(result: EvaluationResult) -> Figure | None:
    """Where the queries were taken, seen from above, coloured by position error; None without true poses."""
    posed = [query for query in result.per_query if query.true_world_from_camera is not None]
    if not posed:
        return None
    poses = np.stack([query.true_world_from_camera for query in posed if query.true_world_from_camera is not None])
    ground = poses[:, :3, 3] @ horizontal_axes(poses).T
    ground -= ground.mean(axis=0)
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    axes = figure.subplots()
    style_axes(axes)
    axes.plot(ground[:, 0], ground[:, 1], color="#c9d0d8", lw=1.0, zorder=1)
    localized = np.array([query.is_localized and query.translation_m is not None for query in posed])
    if localized.any():
        errors = np.array(
            [query.translation_m for query in posed if query.is_localized and query.translation_m is not None]
        )
        spots = axes.scatter(
            ground[localized, 0],
            ground[localized, 1], c=np.clip(errors, 1e-3, 0.5), norm=LogNorm(1e-3, 0.5), cmap="viridis_r", s=34,
            edgecolors=INK, linewidths=0.4, zorder=3,
        )  # fmt: skip
        bar = figure.colorbar(spots, ax=axes, pad=0.01, shrink=0.85)
        bar.set_label("position error (m)")
        bar.set_ticks([0.001, 0.01, 0.05, 0.25, 0.5], labels=["0.001", "0.01", "0.05", "0.25", "0.5"])
    false = [query.is_false for query in posed]
    _mark(axes, ground, false, "o", "#c0322b", "false localization", hollow=True)
    for verdict, shape in ((Verdict.AMBIGUOUS, "^"), (Verdict.COARSE, "s"), (Verdict.FAILED, "X")):
        which = [query.verdict == verdict for query in posed]
        _mark(axes, ground, which, shape, VERDICT_COLOURS[verdict], str(verdict))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("metres along the longest way")
    axes.set_ylabel("metres across")
    axes.set_title(for_plot(_heading(result), TITLE_CHARACTERS), loc="left", fontsize=12, color=INK)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, labelcolor=INK)
    return figure


def inlier_plot(result: EvaluationResult) -> Figure:
    """Inliers against position error, one mark per query, coloured by verdict; queries without a pose on top."""
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.subplots()
    style_axes(axes)
    shapes = {Verdict.LOCALIZED: "o", Verdict.AMBIGUOUS: "^", Verdict.COARSE: "s", Verdict.FAILED: "X"}
    known = [error for error in (query.translation_m for query in result.per_query) if error]
    ceiling = 2.5 * max([*known, 2 * FALSE_TRANSLATION_M])
    for verdict, shape in shapes.items():
        queries = [query for query in result.per_query if query.verdict == verdict]
        if not queries:
            continue
        x = [max(query.inliers, 0.7) for query in queries]
        y = [_height(query, ceiling) for query in queries]
        axes.scatter(
            x, y, marker=shape, s=36, color=VERDICT_COLOURS[verdict], alpha=0.75, linewidths=0,
            label=f"{verdict} ({len(queries)})", zorder=3,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    counts = [max(query.inliers, 0.7) for query in result.per_query]
    axes.set_xlim(min([10, *counts]) * 0.8, max([1000, *counts]) * 1.25)
    axes.set_ylim(min([*known, 0.002]) * 0.7, ceiling * 1.5)
    axes.axhline(FALSE_TRANSLATION_M, color=FAINT, lw=1.0, ls=(0, (4, 3)), zorder=1)
    place = axes.get_yaxis_transform()
    axes.text(0.99, FALSE_TRANSLATION_M * 1.07, "false above 0.25 m", color=FAINT, ha="right", transform=place)
    if any(query.translation_m is None for query in result.per_query):
        axes.text(0.99, ceiling * 0.8, "no pose", color=FAINT, ha="right", transform=place)
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("inliers")
    axes.set_ylabel("position error (m)")
    axes.set_title(for_plot(_heading(result), TITLE_CHARACTERS), loc="left", fontsize=12, color=INK)
    if result.per_query:
        axes.legend(frameon=False, labelcolor=INK, loc="lower left")
    return figure


def _height(query: QueryResult, ceiling: float) -> float:
    return ceiling if query.translation_m is None else max(query.translation_m, 1e-4)


def _heading(result: EvaluationResult) -> str:
    return (
        f"{result.recording}: {result.method}, {result.keyframes} keyframes, "
        f"{result.localized} of {result.queries} queries localized"
        + (", refined poses" if result.truth == "refined" else "")
    )


def _mark(
    axes: Axes,
    ground: FloatArray,
    which: Sequence[bool],
    shape: str,
    colour: str,
    label: str,
    *,
    hollow: bool = False,
) -> None:
    chosen: npt.NDArray[np.float64] = ground[np.array(which, dtype=np.bool_)]
    if len(chosen) == 0:
        return
    face = "none" if hollow else colour
    axes.scatter(
        chosen[:, 0], chosen[:, 1], marker=shape, s=130 if hollow else 64, facecolors=face, edgecolors=colour,
        linewidths=1.8 if hollow else 0.5, label=f"{label} ({len(chosen)})", zorder=4,
    )  # fmt: skip


def style_axes(axes: Axes) -> None:
    """Grid and colours that all plots share."""
    axes.grid(visible=True, color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(colors=FAINT, labelcolor=INK)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
