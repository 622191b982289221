"""A report for people: one folder with JSON, CSV, plots, and a page that needs nothing beside it."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path

from semdb.errors import UsageError
from semdb.evaluation.metrics import EvaluationResult, QueryResult, write_json, write_queries_csv
from semdb.evaluation.plots import cumulative_plot, figure_png, inlier_plot, trajectory_plot
from semdb.evaluation.tables import HEADERS, PAPER_HEADERS, TEXT_COLUMNS, by_keyframes, paper_rows, result_row

WORST = 10
NOTHING = "-"
WORST_HEADERS = (
    "frame",
    "verdict",
    "position m",
    "rotation °",
    "candidate",
    "inliers",
    "confidence",
    "stage",
    "why",
)
STYLE = """
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1b2430; margin: 2rem auto;
  max-width: 1240px; padding: 0 1.5rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.4rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
p.note { color: #6b7683; max-width: 62rem; }
div.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; text-align: right; white-space: nowrap; border-bottom: 1px solid #e3e7ec; }
th { color: #6b7683; font-weight: 600; } th.text, td.text { text-align: left; }
td.prose { white-space: normal; text-align: left; min-width: 16rem; }
tr:hover td { background: #f6f8fa; }
.localized { color: #1e8e4e; } .ambiguous { color: #c77700; } .failed, .false { color: #c0322b; font-weight: 600; }
img { max-width: 100%; height: auto; display: block; margin: .6rem 0; }
dl { display: grid; grid-template-columns: max-content auto; gap: .2rem 1.2rem; } dt { color: #6b7683; } dd { margin: 0;
  overflow-wrap: anywhere; }
"""

PictureOf = Callable[[EvaluationResult, QueryResult], bytes | None]


def worst_queries(result: EvaluationResult, count: int = WORST) -> list[QueryResult]:
    """The `count` queries to look at first: false localizations by error, then failures, then the largest errors."""

    def order(query: QueryResult) -> tuple[int, float]:
        rank = 0 if query.is_false else 1 if not query.is_localized else 2
        error = (query.translation_m or 0.0) / 0.25 + (query.rotation_deg or 0.0) / 5.0
        return rank, -error if math.isfinite(error) else 0.0

    return sorted(result.per_query, key=order)[:count]


def write_report(
    directory: Path,
    results: Sequence[EvaluationResult],
    *,
    settings: Mapping[str, str] | None = None,
    picture_of: PictureOf | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write ``results.json``, ``queries.csv``, ``*.png`` and ``index.html`` to `directory`; returns the page.

    The page is self-contained: style and images are inside it, and it links to nothing. `settings` are shown as
    they are (leave passwords out). `picture_of` may give a PNG of a query for the list of worst queries.
    Raises UsageError without results, or when `directory` cannot be written.
    """
    if not results:
        raise UsageError("a report needs at least one result")
    ordered = by_keyframes(results)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_json(directory / "results.json", ordered)
        write_queries_csv(directory / "queries.csv", ordered)
        sections = [_summary(ordered, settings or {}), _curves(directory, ordered)]
        for number, result in enumerate(ordered, start=1):
            sections.append(_details(directory, result, number, picture_of))
            if progress is not None:
                progress(number, len(ordered))
        sections.append(_beside_the_paper(ordered))
        page = directory / "index.html"
        page.write_text(_page("semdb evaluation", sections), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"the report cannot be written to {directory}: {error}") from error
    return page


def _page(title: str, sections: Sequence[str]) -> str:
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{STYLE}</style>\n'
        f"</head>\n<body>\n<h1>{escape(title)}</h1>\n" + "\n".join(sections) + "\n</body>\n</html>\n"
    )


def _summary(results: Sequence[EvaluationResult], settings: Mapping[str, str]) -> str:
    protocols = ", ".join(sorted({result.protocol for result in results}))
    parts = [
        f'<p class="note">Protocol {escape(protocols)}. Medians and means are over localized queries; every other '
        "share is of all queries. False: reported as localized, but off by more than 0.25 m or 5°. Ranked: median "
        "share of the map's keyframes compared by place vector; matched: median number of keyframes matched.</p>",
        _table(HEADERS, [result_row(result) for result in results]),
    ]
    entries: dict[str, str] = {}
    for model in dict.fromkeys(model for result in results for model in result.models):
        name = f"{model.name} {model.sha256[:12]}".strip()
        entries[model.role] = f"{entries[model.role]}, {name}" if model.role in entries else name
    entries |= settings
    if entries:
        terms = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in entries.items())
        parts.append(f"<h2>Models and settings</h2>\n<dl>{terms}</dl>")
    return "\n".join(parts)


def _curves(directory: Path, results: Sequence[EvaluationResult]) -> str:
    """The cumulative plots, one picture per recording, so that each stays legible."""
    parts = ["<h2>Share of queries within an error</h2>"]
    for number, recording in enumerate(dict.fromkeys(result.recording for result in results), start=1):
        chosen = [result for result in results if result.recording == recording]
        data = figure_png(cumulative_plot(chosen))
        (directory / f"errors-{number}.png").write_bytes(data)
        parts.append(f"<h3>{escape(recording)}</h3>\n" + _image(data, f"cumulative errors on {recording}"))
    return "\n".join(parts)


def _details(directory: Path, result: EvaluationResult, number: int, picture_of: PictureOf | None) -> str:
    heading = f"{result.recording}: {result.method}, {result.keyframes} keyframes"
    parts = [f"<h2>{escape(heading)}</h2>"]
    for name, figure in (("trajectory", trajectory_plot(result)), ("inliers", inlier_plot(result))):
        if figure is None:
            continue
        data = figure_png(figure)
        (directory / f"{name}-{number}.png").write_bytes(data)
        parts.append(_image(data, f"{name}, {heading}"))
    if result.stages:
        stages = ", ".join(f"{escape(stage)} {count}" for stage, count in sorted(result.stages.items()))
        parts.append(f"<p>Queries answered by stage: {stages}.</p>")
    timing = [
        (stage, *(NOTHING if value is None else f"{value:.1f}" for value in (values["p50"], values["p95"])))
        for stage, values in result.timing_ms.items()
        if values["p50"] is not None
    ]
    parts.append("<h3>Time per query</h3>\n" + _table(("stage", "p50 ms", "p95 ms"), timing, text_columns=1))
    worst = worst_queries(result)
    parts.append(f"<h3>The {len(worst)} queries to look at first</h3>\n" + _worst_table(worst))
    if picture_of is not None:
        for query in worst:
            picture = picture_of(result, query)
            if picture is not None:
                parts.append(_image(picture, query.frame))
    return "\n".join(parts)


def _beside_the_paper(results: Sequence[EvaluationResult]) -> str:
    note = (
        "Keyframes and queries of one sequence, as in the paper's Table 3. Other sequences are another task: the "
        "table shows the region, not a ranking."
    )
    table = _table(PAPER_HEADERS, paper_rows(results))
    return f'<h2>Beside Table 3 of the paper</h2>\n<p class="note">{note}</p>\n{table}'


def _worst_table(queries: Sequence[QueryResult]) -> str:
    rows = []
    for query in queries:
        word = "false" if query.is_false else str(query.verdict)
        cells = [
            f'<td class="text">{escape(query.frame)}</td>',
            f'<td class="text {word}">{query.verdict}{" (false)" if query.is_false else ""}</td>',
            *(f"<td>{escape(cell)}</td>" for cell in _numbers(query)),
            f'<td class="text">{escape(query.stage)}</td>',
            f'<td class="prose">{escape(query.reason)}</td>',
        ]
        rows.append("<tr>" + "".join(cells) + "</tr>")
    heads = "".join(
        f'<th class="text">{escape(name)}</th>' if name in ("frame", "verdict", "stage", "why") else f"<th>{name}</th>"
        for name in WORST_HEADERS
    )
    return f'<div class="wide"><table><tr>{heads}</tr>{"".join(rows)}</table></div>'


def _numbers(query: QueryResult) -> tuple[str, ...]:
    return (
        NOTHING if query.translation_m is None else f"{query.translation_m:.4f}",
        NOTHING if query.rotation_deg is None else f"{query.rotation_deg:.2f}",
        NOTHING if query.candidate is None else str(query.candidate),
        str(query.inliers),
        NOTHING if query.confidence is None else f"{query.confidence:.2f}",
    )


def _table(headers: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = TEXT_COLUMNS) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        marked = (
            f'<{tag} class="text">{escape(cell)}</{tag}>' if i < text_columns else f"<{tag}>{escape(cell)}</{tag}>"
            for i, cell in enumerate(cells)
        )
        return "<tr>" + "".join(marked) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f'<div class="wide"><table>{line(headers, "th")}{body}</table></div>'


def _image(png: bytes, alt: str) -> str:
    return f'<img alt="{escape(alt, quote=True)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
