"""A report for people: one folder with JSON, CSV, plots, and a page that needs nothing beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from semdb.errors import UsageError
from semdb.evaluation import html
from semdb.evaluation.averages import averages
from semdb.evaluation.comparisons import regression_grid, table_1, table_3, table_4
from semdb.evaluation.confidence_plots import answers, confidence_plot, has_confidence, uncertainty_plot
from semdb.evaluation.failures import explain, median_sharpness
from semdb.evaluation.files import write_averages, write_json, write_queries_csv
from semdb.evaluation.formats import NOTHING, errors, percent
from semdb.evaluation.methods import ABLATION, SEMDB
from semdb.evaluation.metrics import EvaluationResult, QueryResult
from semdb.evaluation.plots import cumulative_plot, figure_png, inlier_plot, series_names, timing_plot, trajectory_plot
from semdb.evaluation.published import PAPER_TIMING_MS
from semdb.evaluation.regression_plots import regression_plot
from semdb.evaluation.tables import (
    HEADERS,
    ablation_grids,
    average_grid,
    by_keyframes,
    name_of,
    result_row,
    retrieval_grid,
    truth_grids,
)
from semdb.evaluation.worst import worst_queries
from semdb.shown import for_html, measure

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
Section = tuple[str, str, str]  # identifier, heading, HTML


def write_report(
    directory: Path,
    results: Sequence[EvaluationResult],
    *,
    settings: Mapping[str, str] | None = None,
    failures: Mapping[str, str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write ``results.json``, ``averages.json``, ``queries.csv``, ``*.png`` and ``index.html``; returns the page.

    The page is self-contained: style and images are inside it, and it loads nothing. `settings` are shown as they
    are (leave passwords out); `failures` are recordings that could not be evaluated, and why.
    Raises UsageError without results, or when `directory` cannot be written.
    """
    if not results:
        raise UsageError("a report needs at least one result")
    ordered = by_keyframes(results)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_json(directory / "results.json", ordered)
        write_averages(directory / "averages.json", averages(ordered))
        write_queries_csv(directory / "queries.csv", ordered)
        sections = [
            ("results", "Results", _summary(ordered)),
            ("paper", "Beside the paper", _beside_the_paper(directory, ordered)),
            ("errors", "Figures 6 and 7: share of queries within an error", _curves(directory, ordered)),
            ("retrieval", "Retrieval", html.grid_html(retrieval_grid(ordered), heading=False)),
            ("time", "Time per query", _timing(directory, ordered)),
            *_optional(directory, ordered),
        ]
        details = []
        for number, result in enumerate(ordered, start=1):
            details.append(_details(directory, result, number))
            if progress is not None:
                progress(number, len(ordered))
        sections.append(("queries", "Queries to look at first", _details_note() + "\n".join(details)))
        sections.append(("settings", "Models and settings", _settings(ordered, settings or {})))
        path = directory / "index.html"
        path.write_text(html.page("semdb evaluation", _lead(ordered, failures or {}), sections), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"the report cannot be written to {directory}: {error}") from error
    return path


def _lead(results: Sequence[EvaluationResult], failures: Mapping[str, str]) -> str:
    """The first screen: what was run, what came out, and what could not be run."""
    recordings = list(dict.fromkeys(result.recording for result in results))
    methods = list(dict.fromkeys(name_of(result) for result in results))
    protocols = ", ".join(dict.fromkeys(result.protocol for result in results))
    lead = html.note(f"Protocol {protocols}: {', '.join(recordings)}. Methods: {', '.join(methods)}.")
    for name, why in failures.items():
        lead += f'<div class="problem"><b>{for_html(name)}</b> was not evaluated: {for_html(why)}</div>'
    shown = [result for result in results if result.method == SEMDB and result.truth == "given"] or list(results)
    entries = []
    for result in shown[:4]:
        where = f"{result.recording}, {result.method}, {result.keyframes} keyframes, {result.queries} queries"
        figures = f"{percent(result.success_rate)} localized, {result.false_localizations} false"
        entries.append((errors(result.median_translation_m, result.median_rotation_deg), f"median m / °, {where}"))
        entries.append((percent(result.recall["5cm_5deg"]), f"within 5 cm and 5°, {where}; {figures}"))
    return lead + html.cards(entries)


def _summary(results: Sequence[EvaluationResult]) -> str:
    parts = [
        html.note(
            "Medians and means are over localized queries; every other share is of all queries. False: reported as "
            "localized, but off by more than 0.25 m or 5°. Ranked: median share of the map's keyframes compared by "
            "place vector; matched: median number of keyframes matched."
        ),
    ]
    for recording in dict.fromkeys(result.recording for result in results):
        chosen = [result for result in results if result.recording == recording]
        parts.append(f"<h3>{for_html(recording)}</h3>")
        parts.append(html.table(HEADERS[1:], [result_row(result)[1:] for result in chosen], text_columns=1))
    means = average_grid(averages(results))
    if means.rows:
        parts.append(html.grid_html(means))
    stages = [(result, _stages(result)) for result in results]
    rows = [(result.recording, name_of(result), str(result.keyframes), text) for result, text in stages if text]
    parts.append(
        html.folded(
            "Queries by the stage that answered", "", html.table(("recording", "method", "keyframes", "stages"), rows)
        )
    )
    return "\n".join(parts)


def _stages(result: EvaluationResult) -> str:
    return ", ".join(f"{stage} {count}" for stage, count in sorted(result.stages.items()))


def _beside_the_paper(directory: Path, results: Sequence[EvaluationResult]) -> str:
    parts = [html.grid_html(grid) for grid in (table_3(results), table_4(results))]
    measured = regression_grid(results)
    if measured.rows:
        parts.append(html.grid_html(measured))
        known = dict.fromkeys(result.recording for result in results if result.training_frames is not None)
        for number, recording in enumerate(known, start=1):
            figure = regression_plot([result for result in results if result.recording == recording])
            path = directory / f"training-{number}.png"
            parts += [f"<h3>{for_html(recording)}</h3>", _figure(path, figure, f"frames to learn from, {recording}")]
    parts.append(html.folded(table_1(results).title, "", html.grid_html(table_1(results), heading=False)))
    return "\n".join(parts)


def _curves(directory: Path, results: Sequence[EvaluationResult]) -> str:
    """The cumulative plots, one picture per recording, so that each stays legible."""
    parts = [
        html.note(
            "Shares are of all queries, so a curve ends at the share that is localized and in range. The diamonds are "
            "what the paper reports of its own queries: above 90 % within 0.3 m, over 80 % within 2.5°."
        )
    ]
    for number, recording in enumerate(dict.fromkeys(result.recording for result in results), start=1):
        chosen = [result for result in results if result.recording == recording]
        parts.append(f"<h3>{for_html(recording)}</h3>")
        parts.append(_figure(directory / f"errors-{number}.png", cumulative_plot(chosen), f"errors on {recording}"))
    return "\n".join(parts)


def _timing(directory: Path, results: Sequence[EvaluationResult]) -> str:
    paper = " and ".join(f"{value:g} ms for the {name}" for name, value in PAPER_TIMING_MS.items())
    parts = [html.note(f"Medians on the machine of this run. The paper reports {paper}, on a TITAN Xp.")]
    figure = timing_plot(results)
    if figure is not None:
        parts.append(_figure(directory / "timing.png", figure, "time per query by stage"))
    stages = list(dict.fromkeys(stage for result in results for stage in result.timing_ms))
    used = [stage for stage in stages if any(result.timing_ms.get(stage, {}).get("p50") for result in results)]
    rows = [
        (result.recording, name_of(result), str(result.keyframes), *(_percentiles(result, stage) for stage in used))
        for result in results
    ]
    parts.append(
        html.folded("All stages", "p50 / p95 in ms", html.table(("recording", "method", "keyframes", *used), rows))
    )
    return "\n".join(parts)


def _percentiles(result: EvaluationResult, stage: str) -> str:
    values = result.timing_ms.get(stage, {})
    known = [values.get(name) for name in ("p50", "p95")]
    return " / ".join(NOTHING if value is None else f"{value:.1f}" for value in known)


def _optional(directory: Path, results: Sequence[EvaluationResult]) -> list[Section]:
    """Sections for what not every run has: ablation, two truths, answers with a confidence."""
    sections: list[Section] = []
    methods = {result.method for result in results}
    if {name for _, _, name in ABLATION} <= methods:
        layers = "\n".join(html.grid_html(grid) for grid in ablation_grids(results))
        sections.append(("ablation", "What each layer brings", layers))
    grids = [grid for grid in truth_grids(results) if grid.rows]
    if grids:
        explained = html.note(
            "Refined poses come from bundle adjustment of all images and are brought back to the given world frame by "
            "one similarity. Where the two truths differ as much as the errors, the given poses are the limit."
        )
        sections.append(
            ("truth", "Can the true poses be trusted?", explained + "\n".join(html.grid_html(grid) for grid in grids))
        )
    chosen = [result for result in results if has_confidence(result)]
    if chosen:
        sections.append(("confidence", "Can the confidence be trusted?", _confidence(directory, chosen)))
    chosen = [result for result in results if result.nees is not None]
    if chosen:
        sections.append(("uncertainty", "Can the covariance be trusted?", _uncertainty(directory, chosen)))
    return sections


def _uncertainty(directory: Path, results: Sequence[EvaluationResult]) -> str:
    """One picture per recording, as of the confidence."""
    parts = [html.note("Localized queries against the true poses: on the diagonal covariances say what errors are.")]
    for number, recording in enumerate(dict.fromkeys(result.recording for result in results), start=1):
        chosen = [result for result in results if result.recording == recording]
        errors = [[query.nees for query in result.per_query if query.is_localized and query.nees] for result in chosen]
        figure = uncertainty_plot(list(zip(series_names(chosen), errors, strict=True)))
        picture = _figure(directory / f"uncertainty-{number}.png", figure, f"covariances on {recording}")
        parts += [f"<h3>{for_html(recording)}</h3>", picture]
    return "\n".join(parts)


def _confidence(directory: Path, results: Sequence[EvaluationResult]) -> str:
    """One picture per recording, as of the errors."""
    parts = [
        html.note(
            "Right: a pose within 0.25 m and 5°, whatever the verdict; wrong poses and failures are the negatives. "
            "Queries of a recording that the map knows are nearly all right, and few negatives make rough curves "
            "(bench.trust asks thousands)."
        )
    ]
    for number, recording in enumerate(dict.fromkeys(result.recording for result in results), start=1):
        chosen = [result for result in results if result.recording == recording]
        series = [(name, *answers(result)) for name, result in zip(series_names(chosen), chosen, strict=True)]
        counts = "; ".join(f"{name}: {int((~right).sum())} wrong of {len(right)}" for name, _, right in series)
        picture = _figure(directory / f"confidence-{number}.png", confidence_plot(series), f"confidence on {recording}")
        parts += [f"<h3>{for_html(recording)}</h3>", html.note(f"{counts}."), picture]
    return "\n".join(parts)


def _details_note() -> str:
    return html.note(
        "Of every result the ten queries to look at first: false localizations, then failures, then the largest "
        "errors, with what was matched in the best keyframe. A click opens a result."
    )


def _details(directory: Path, result: EvaluationResult, number: int) -> str:
    heading = f"{result.recording}: {name_of(result)}, {result.keyframes} keyframes"
    parts = []
    for name, figure in (("trajectory", trajectory_plot(result)), ("inliers", inlier_plot(result))):
        if figure is not None:
            parts.append(_figure(directory / f"{name}-{number}.png", figure, f"{name}, {heading}"))
    worst = worst_queries(result)
    usual = median_sharpness(result.per_query)
    pictures = [
        f"<figure>{html.image(picture, query.frame, 'jpeg')}<figcaption>{_caption(query, usual)}</figcaption></figure>"
        for query in worst
        for picture in (result.pictures.get((query.recording, query.frame_index)),)
        if picture is not None
    ]
    parts = [f"<h3>The {len(worst)} queries to look at first</h3>", _worst_table(worst, usual), *pictures, *parts]
    small = f"{result.localized} of {result.queries} localized, {result.false_localizations} false"
    return html.folded(heading, small, "\n".join(parts), is_open=result.method == SEMDB)


def _caption(query: QueryResult, usual: float | None) -> str:
    return f"<b>{for_html(query.frame)}</b>: {for_html(explain(query, usual))}. {for_html(query.reason)}"


def _worst_table(queries: Sequence[QueryResult], usual: float | None) -> str:
    rows = []
    for query in queries:
        word = "false" if query.is_false else str(query.verdict)
        cells = [
            f'<td class="text">{for_html(query.frame)}</td>',
            f'<td class="text {word}">{query.verdict}{" (false)" if query.is_false else ""}</td>',
            *(f"<td>{for_html(cell)}</td>" for cell in _numbers(query)),
            f'<td class="text">{for_html(query.stage)}</td>',
            f'<td class="prose">{for_html(explain(query, usual))}. {for_html(query.reason)}</td>',
        ]
        rows.append("<tr>" + "".join(cells) + "</tr>")
    heads = "".join(
        f'<th class="text">{for_html(name)}</th>'
        if name in ("frame", "verdict", "stage", "why")
        else f"<th>{name}</th>"
        for name in WORST_HEADERS
    )
    return f'<div class="wide"><table><tr>{heads}</tr>{"".join(rows)}</table></div>'


def _numbers(query: QueryResult) -> tuple[str, ...]:
    return (
        NOTHING if query.translation_m is None else f"{query.translation_m:.4f}",
        NOTHING if query.rotation_deg is None else f"{query.rotation_deg:.2f}",
        NOTHING if query.candidate is None else str(query.candidate),
        str(query.inliers),
        NOTHING if query.confidence is None else measure(query.confidence, 2, unless=(0.0, 1.0)),
    )


def _settings(results: Sequence[EvaluationResult], settings: Mapping[str, str]) -> str:
    entries: dict[str, str] = {}
    for model in dict.fromkeys(model for result in results for model in result.models):
        name = f"{model.name} {model.sha256[:12]}".strip()
        entries[model.role] = f"{entries[model.role]}, {name}" if model.role in entries else name
    return html.definitions(list((entries | dict(settings)).items()))


def _figure(path: Path, figure: Figure, alt: str) -> str:
    """The figure as a file beside the page, and inside it."""
    data = figure_png(figure)
    path.write_bytes(data)
    return html.image(data, alt)
