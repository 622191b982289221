"""Results as tables: on the terminal (rich), as Markdown, and beside the paper's Table 3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table

from semdb.evaluation.metrics import EvaluationResult

NOTHING = "-"
HEADERS = (
    "recording",
    "method",
    "frames",
    "keyframes",
    "queries",
    "localized",
    "false",
    "median m / °",
    "mean m / °",
    "5 cm 5°",
    "0.3 m",
    "2.5°",
    "ranked",
    "matched",
    "ms p50 / p95",
)
PAPER_METHOD = "the paper"
CHEN_METHOD = "Chen et al."
SHORT_HEADERS = ("method", "keyframes", "localized", "false", "median m / °", "5 cm 5°", "ranked")
MAX_COLUMNS = 3  # results that stand side by side on a terminal
TEXT_COLUMNS = 2  # the first two are words and stand left, the others are numbers and stand right


@dataclass(frozen=True, slots=True)
class PaperRow:
    """A row of the paper's Table 3: errors in metres and degrees, success 0..1; None where the paper gives none."""

    sequence: str
    raw_frames: int | None
    keyframes: int | None
    test_frames: int | None
    median_translation_m: float
    median_rotation_deg: float
    mean_translation_m: float
    mean_rotation_deg: float
    success_rate: float | None
    method: str = PAPER_METHOD


PAPER_TABLE_3 = (
    PaperRow("ICL-NUIM living room kt0", 1510, 70, 1000, 0.0096, 0.3265, 0.0607, 2.2212, 0.9170),
    PaperRow("ICL-NUIM living room kt1", 967, 36, 600, 0.0103, 0.2780, 0.0396, 0.9997, 0.9600),
    PaperRow("ICL-NUIM living room kt2", 882, 54, 500, 0.0097, 0.2612, 0.0395, 0.9361, 0.9987),
    PaperRow("ICL-NUIM living room kt3", 1242, 101, 800, 0.0088, 0.3142, 0.0317, 1.3179, 0.9575),
    PaperRow("ICL-NUIM office room kt0", 1510, 77, 1000, 0.0199, 0.4123, 0.1549, 3.1138, 0.8977),
    PaperRow("ICL-NUIM office room kt1", 967, 47, 600, 0.0091, 0.3193, 0.0462, 2.0639, 0.7794),
    PaperRow("ICL-NUIM office room kt2", 882, 54, 500, 0.0113, 0.2948, 0.0768, 1.5928, 0.9400),
    PaperRow("ICL-NUIM office room kt3", 1242, 45, 800, 0.0152, 0.4550, 0.0525, 1.5997, 0.8696),
    PaperRow("ICL-NUIM, all", None, None, None, 0.0118, 0.3327, 0.0628, 1.7307, 0.9150),
    PaperRow("TUM freiburg1_plant", 1120, 171, 800, 0.0179, 0.6079, 0.0678, 2.3161, 0.9329),
    PaperRow("TUM freiburg1_room", 1352, 243, 1000, 0.0141, 0.6978, 0.0768, 3.4290, 0.9243),
    PaperRow("TUM freiburg2_360_hemisphere", 2647, 800, 2000, 0.0797, 0.8259, 0.4790, 5.4154, 0.8965),
    PaperRow("TUM freiburg2_flowerbouquet", 2859, 323, 2000, 0.0138, 0.6443, 0.0295, 1.6028, 0.9612),
    PaperRow("TUM freiburg2_pioneer_slam3", 2224, 253, 1800, 0.0344, 0.6426, 0.2653, 3.7028, 0.8576),
    PaperRow("TUM freiburg3_long_office_household", 2486, 246, 2000, 0.0148, 0.5660, 0.0302, 1.0600, 0.9967),
    PaperRow("TUM RGB-D, all", None, None, None, 0.0291, 0.6641, 0.1581, 2.9210, 0.9282),
    PaperRow("ICL-NUIM, all", None, None, None, 0.06, 0.01, 0.34, 3.43, None, CHEN_METHOD),
    PaperRow("TUM RGB-D, all", None, None, None, 0.10, 0.16, 0.32, 5.58, None, CHEN_METHOD),
)
PAPER_HEADERS = ("sequence", "method", "frames", "keyframes", "queries", "median m / °", "mean m / °", "success")


def result_row(result: EvaluationResult) -> tuple[str, ...]:
    """The cells of one result under `HEADERS`."""
    total = result.timing_ms.get("total", {})
    return (
        result.recording,
        result.method,
        str(result.frames),
        str(result.keyframes),
        str(result.queries),
        percent(result.success_rate),
        str(result.false_localizations),
        errors(result.median_translation_m, result.median_rotation_deg),
        errors(result.mean_translation_m, result.mean_rotation_deg),
        percent(result.recall["5cm_5deg"]),
        percent(result.recall["0.3m"]),
        percent(result.recall["2.5deg"]),
        percent(result.ranked_share),
        NOTHING if result.keyframes_matched is None else f"{result.keyframes_matched:g}",
        f"{whole(total.get('p50'))} / {whole(total.get('p95'))}",
    )


def results_table(results: Sequence[EvaluationResult], title: str | None = None) -> RenderableType:
    """For the terminal, fit for 80 characters: up to three results stand as columns, more as short rows."""
    if len(results) > MAX_COLUMNS:
        recordings = dict.fromkeys(result.recording for result in results)
        head = f"{title}: " if title else ""
        return Group(
            *(
                _rich(SHORT_HEADERS, [_short_row(r) for r in results if r.recording == recording], head + recording)
                for recording in recordings
            )
        )
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, header_style="bold")
    table.add_column("")
    for result in results:
        table.add_column(f"{result.recording}\n{result.method}", justify="right", overflow="fold")
    rows = [(*result_row(result)[TEXT_COLUMNS:], _stages(result)) for result in results]
    for name, *cells in zip((*HEADERS[TEXT_COLUMNS:], "answered by stage"), *rows, strict=True):
        table.add_row(name, *cells)
    return table


def _short_row(result: EvaluationResult) -> tuple[str, ...]:
    return (
        result.method,
        str(result.keyframes),
        f"{result.localized} / {result.queries}",
        str(result.false_localizations),
        errors(result.median_translation_m, result.median_rotation_deg),
        percent(result.recall["5cm_5deg"]),
        percent(result.ranked_share),
    )


def _stages(result: EvaluationResult) -> str:
    return ", ".join(f"{stage} {count}" for stage, count in result.stages.items()) or NOTHING


def results_markdown(results: Sequence[EvaluationResult]) -> str:
    """One row per result, as a Markdown table that also reads well as plain text."""
    return _markdown(HEADERS, [result_row(result) for result in results])


def by_keyframes(results: Sequence[EvaluationResult]) -> list[EvaluationResult]:
    """The results by recording, method and number of keyframes: the order of a table over that number."""
    return sorted(results, key=lambda result: (result.recording, result.method, result.keyframes))


def paper_rows(results: Sequence[EvaluationResult] = ()) -> list[tuple[str, ...]]:
    """The paper's Table 3 under `PAPER_HEADERS`, and below it the same columns of `results`."""
    rows = [
        (
            row.sequence,
            row.method,
            *(NOTHING if count is None else str(count) for count in (row.raw_frames, row.keyframes, row.test_frames)),
            errors(row.median_translation_m, row.median_rotation_deg),
            errors(row.mean_translation_m, row.mean_rotation_deg),
            percent(row.success_rate),
        )
        for row in PAPER_TABLE_3
    ]
    for result in results:
        rows.append(
            (
                result.recording,
                result.method,
                str(result.frames),
                str(result.keyframes),
                str(result.queries),
                errors(result.median_translation_m, result.median_rotation_deg),
                errors(result.mean_translation_m, result.mean_rotation_deg),
                percent(result.success_rate),
            )
        )
    return rows


def paper_table(results: Sequence[EvaluationResult] = ()) -> Table:
    """The paper's Table 3 with `results` below it, for the terminal. Other sequences: a region, not a ranking."""
    headers = ("", "frames / key / test", *PAPER_HEADERS[5:])
    rows = [
        (sequence if method == PAPER_METHOD else f"{method}, {sequence}", " / ".join(counts), *figures)
        for sequence, method, counts, figures in ((row[0], row[1], row[2:5], row[5:]) for row in paper_rows(results))
    ]
    return _rich(headers, rows, "Beside Table 3 of the paper (keyframes and queries of one sequence)")


def paper_markdown(results: Sequence[EvaluationResult] = ()) -> str:
    """The paper's Table 3 with `results` below it, as Markdown."""
    return _markdown(PAPER_HEADERS, paper_rows(results))


def percent(share: float | None) -> str:
    return NOTHING if share is None else f"{100 * share:.1f} %"


def errors(metres: float | None, degrees: float | None) -> str:
    return NOTHING if metres is None or degrees is None else f"{metres:.4f} / {degrees:.2f}"


def whole(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.0f}"


def _rich(headers: Sequence[str], rows: Sequence[Sequence[str]], title: str | None) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, header_style="bold", padding=(0, 1, 0, 0))
    for i, header in enumerate(headers):
        table.add_column(header, justify="left" if i == 0 else "right", overflow="fold", no_wrap=i > 0)
    for row in rows:
        table.add_row(*row)
    return table


def _markdown(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(cell) for cell in column) for column in zip(headers, *rows, strict=True)]

    def line(cells: Sequence[str]) -> str:
        padded = (
            cell.replace("|", "\\|").ljust(width) if i < TEXT_COLUMNS else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return "| " + " | ".join(padded) + " |"

    rule = [("-" * width) if i < TEXT_COLUMNS else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    return "\n".join([line(headers), line(rule), *(line(row) for row in rows)]) + "\n"
