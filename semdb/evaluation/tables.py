"""Results as tables: plain cells first, then on the terminal (rich) and as Markdown; `report` makes HTML of them."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from semdb.evaluation.averages import Average, averages
from semdb.evaluation.comparisons import Grid, paper_rows_evaluated
from semdb.evaluation.formats import NOTHING, errors, percent, whole
from semdb.evaluation.methods import ABLATION, place_of
from semdb.evaluation.metrics import EvaluationResult
from semdb.shown import for_markdown, for_terminal, number, width

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
    "coarse",
    "ranked",
    "matched",
    "ms p50 / p95",
)
SHORT_HEADERS = ("method", "keyframes", "localized", "false", "median m / °", "5 cm 5°", "ranked")
MAX_COLUMNS = 3  # results that stand side by side on a terminal
TEXT_COLUMNS = 2  # the first two are words and stand left, the others are numbers and stand right


def result_row(result: EvaluationResult) -> tuple[str, ...]:
    """The cells of one result under `HEADERS`."""
    total = result.timing_ms.get("total", {})
    return (
        result.recording,
        name_of(result),
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
        percent(result.coarse.get("share")),
        percent(result.ranked_share),
        NOTHING if result.keyframes_matched is None else number(result.keyframes_matched),
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
    table = Table(title=_text(title) if title else None, title_justify="left", box=SIMPLE_HEAD, header_style="bold")
    table.add_column("")
    for result in results:
        title_of = Text(f"{for_terminal(result.recording)}\n{for_terminal(name_of(result))}")
        table.add_column(title_of, justify="right", overflow="fold")
    rows = [(*result_row(result)[TEXT_COLUMNS:], _stages(result)) for result in results]
    for name, *cells in zip((*HEADERS[TEXT_COLUMNS:], "answered by stage"), *rows, strict=True):
        table.add_row(name, *map(_text, cells))
    return table


def _short_row(result: EvaluationResult) -> tuple[str, ...]:
    return (
        name_of(result),
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
    """By recording, method (in the order of `METHODS`) and number of keyframes, given poses before refined ones."""

    def key(result: EvaluationResult) -> tuple[str, str, int, str, int]:
        return result.recording, result.truth, place_of(result.method), result.method, result.keyframes

    return sorted(results, key=key)


def name_of(result: EvaluationResult) -> str:
    """The method, and what tells it from the same method on the same recording."""
    return result.method + (" (refined poses)" if result.truth == "refined" else "")


def terminal_tables(results: Sequence[EvaluationResult], *, ablation: bool = False) -> list[RenderableType]:
    """All that `semdb evaluate` prints: the results, and what there is to compare them with."""
    grids = [
        *(ablation_grids(results) if ablation else ()),
        average_grid(averages(results)),
        paper_rows_evaluated(results),
        retrieval_grid(results),
        *truth_grids(results),
    ]
    return [results_table(results), *(rich_table(grid) for grid in grids if grid.rows)]


def average_grid(found: Sequence[Average]) -> Grid:
    """Means over recordings, as in the paper's Table 3."""
    rows = [
        (
            average.name,
            average.method + (" (refined poses)" if average.truth == "refined" else ""),
            str(average.sequences),
            str(average.keyframes),
            str(average.queries),
            percent(average.success_rate),
            str(average.false_localizations),
            errors(average.median_translation_m, average.median_rotation_deg),
            errors(average.mean_translation_m, average.mean_rotation_deg),
            percent(average.recall_5cm_5deg),
        )
        for average in found
    ]
    headers = ("average", "method", "recordings", "keyframes", "queries", "localized", "false")
    return Grid(
        "Averages",
        (*headers, "median m / °", "mean m / °", "5 cm 5°"),
        rows,
        "Plain means of the figures of the recordings, each counting once, also of medians: as in the paper's Table 3. "
        "Keyframes, queries and false localizations are sums.",
    )


def retrieval_grid(results: Sequence[EvaluationResult]) -> Grid:
    """How often a keyframe that sees the place came among the first 1, 3, 10."""
    rows = []
    for result in results:
        found = result.retrieval
        if found is not None:
            shares = (percent(found.first_1), percent(found.first_3), percent(found.first_10))
            counts = (str(result.keyframes), f"{found.queries} / {result.queries}")
            rows.append((result.recording, name_of(result), *counts, *shares))
    return Grid(
        "Retrieval by itself",
        ("recording", "method", "keyframes", "queries", "first 1", "first 3", "first 10"),
        rows,
        "Share of queries with a keyframe within 0.3 m and 20° among the first 1, 3 and 10 that a method would match. "
        "Counted are the queries for which the map has such a keyframe: so many / all.",
    )


def truth_grids(results: Sequence[EvaluationResult]) -> list[Grid]:
    """How far the given poses are from the refined ones, and the errors against both."""
    compared = [result for result in results if result.disagreement is not None]
    first = {result.recording: result.disagreement for result in compared}
    rows = [
        (
            recording,
            f"{found.refined} / {found.frames}",
            errors(found.median_translation_m, found.median_rotation_deg),
            errors(found.p90_translation_m, found.p90_rotation_deg),
            errors(found.max_translation_m, found.max_rotation_deg),
            errors(found.median_step_translation_m, found.median_step_rotation_deg),
            f"{found.given_px:.2f} / {found.refined_px:.2f}",
            f"{found.scale:.4f}",
            f"{1000 * found.readout_s:.0f} ms",
        )
        for recording, found in first.items()
        if found is not None
    ]
    errors_of = ("median m / °", "90 % m / °", "largest m / °", "frame to frame m / °")
    headers = ("recording", "refined frames", *errors_of, "pixels given / refined", "scale", "readout")
    note = (
        "How far the given poses of the frames are from those that bundle adjustment finds; pixels: mean reprojection "
        "error of points triangulated with the poses of each; scale: metres of the given poses per metre of depth; "
        "readout: from the first row of an image to the last, found from the images (rolling shutter)."
    )
    errors_rows = []
    for result in compared:
        other = result.other_errors
        own = (errors(result.median_translation_m, result.median_rotation_deg), percent(result.recall["5cm_5deg"]))
        against = (
            (NOTHING, NOTHING)
            if other is None
            else (errors(other.median_translation_m, other.median_rotation_deg), percent(other.recall["5cm_5deg"]))
        )
        given, refined = (own, against) if result.truth == "given" else (against, own)
        errors_rows.append((result.recording, result.method, str(result.keyframes), result.truth, *given, *refined))
    return [
        Grid("Given and refined poses", headers, rows, note, text_columns=1),
        Grid(
            "Errors against both truths",
            ("recording", "method", "keyframes", "map", "given: median", "5 cm 5°", "refined: median", "5 cm 5°"),
            errors_rows,
            "Map: whose poses the keyframes have. Each row is one set of answers, measured against both truths.",
        ),
    ]


def ablation_grids(results: Sequence[EvaluationResult]) -> list[Grid]:
    """What each layer brings, one table per recording, number of keyframes and truth."""
    groups: dict[tuple[str, int | None, str], dict[str, EvaluationResult]] = {}
    for result in results:
        key = result.recording, result.keyframes_asked, result.truth
        groups.setdefault(key, {})[result.method] = result
    headers = ("filter", "keypoints", "method", "localized", "false", "median m / °", "mean m / °", "5 cm 5°")
    grids = []
    for (recording, _, _), found in groups.items():
        rows = [
            (filter_name, keypoints, method, *_ablation_cells(found[method]))
            for filter_name, keypoints, method in ABLATION
            if method in found
        ]
        first = next(iter(found.values()))
        title = f"Ablation on {recording}, {first.keyframes} keyframes, {first.queries} queries"
        grids.append(Grid(title, (*headers, "ranked", "matched", "first 1 / 3 / 10"), rows, text_columns=3))
    return grids


def _ablation_cells(result: EvaluationResult) -> tuple[str, ...]:
    found = result.retrieval
    firsts = (NOTHING,) if found is None else (percent(found.first_1), percent(found.first_3), percent(found.first_10))
    return (
        percent(result.success_rate),
        str(result.false_localizations),
        errors(result.median_translation_m, result.median_rotation_deg),
        errors(result.mean_translation_m, result.mean_rotation_deg),
        percent(result.recall["5cm_5deg"]),
        percent(result.ranked_share),
        NOTHING if result.keyframes_matched is None else number(result.keyframes_matched),
        " / ".join(firsts),
    )


def rich_table(grid: Grid) -> Table:
    """A grid for the terminal."""
    table = _rich(grid.headers, grid.rows, grid.title)
    table.caption = _text(grid.note) if grid.note else None
    table.caption_justify = "left"
    return table


def grid_markdown(grid: Grid) -> str:
    """A grid as a Markdown table."""
    return _markdown(grid.headers, grid.rows)


def _rich(headers: Sequence[str], rows: Sequence[Sequence[str]], title: str | None) -> Table:
    table = Table(
        title=_text(title) if title else None,
        title_justify="left",
        box=SIMPLE_HEAD,
        header_style="bold",
        padding=(0, 1, 0, 0),
    )
    for i, header in enumerate(headers):
        table.add_column(_text(header), justify="left" if i == 0 else "right", overflow="fold", no_wrap=i > 0)
    for row in rows:
        table.add_row(*map(_text, row))
    return table


def _text(text: str) -> Text:
    """For rich, which reads [brackets] and :names: of a plain string as its own markup."""
    return Text(for_terminal(text))


def _markdown(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [[for_markdown(cell) for cell in cells] for cells in (headers, *rows)]
    widths = [max(map(width, column)) for column in zip(*lines, strict=True)]

    def line(cells: Sequence[str]) -> str:
        spaces = (" " * (wide - width(cell)) for cell, wide in zip(cells, widths, strict=True))
        padded = (
            cell + space if i < TEXT_COLUMNS else space + cell
            for i, (cell, space) in enumerate(zip(cells, spaces, strict=True))
        )
        return "| " + " | ".join(padded) + " |"

    rule = [("-" * wide) if i < TEXT_COLUMNS else "-" * (wide - 1) + ":" for i, wide in enumerate(widths)]
    return "\n".join([line(lines[0]), line(rule), *map(line, lines[1:])]) + "\n"
