"""`semdb evaluate`: how well images are localized in a recording's own keyframes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semdb.cli.options import CameraOption, Overrides, settings_options

if TYPE_CHECKING:
    from semdb.evaluation.metrics import EvaluationResult
    from semdb.settings import Settings


@settings_options(models=True)
def command(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="Folders of recordings.")],
    overrides: Overrides,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            metavar="NAME",
            help="semdb (default), cnn, paper, chen, sift-reference or oracle; several on the same queries.",
        ),
    ] = None,
    keyframes: Annotated[
        str | None,
        typer.Option("--keyframes", metavar="N[,N...]", help="Exactly N keyframes; several numbers run one by one."),
    ] = None,
    max_queries: Annotated[
        int | None, typer.Option("--max-queries", metavar="N", help="N queries, evenly spaced; default: all.")
    ] = None,
    coarse: Annotated[
        str, typer.Option("--coarse", metavar="sql|index", help="Coarse step in SQL, or from a mirror in memory.")
    ] = "sql",
    query_depth: Annotated[
        bool, typer.Option("--query-depth", help="Give the queries their depth images too, not the colour alone.")
    ] = False,
    camera: CameraOption = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the results as JSON.")] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="DIR", help="Write a page with tables and plots, a CSV of queries, JSON."),
    ] = None,
) -> None:
    """Protocol `paper`: keyframes into a database of its own, the other frames as queries, errors against the truth."""
    from semdb.cli.progress import StagedProgress, say
    from semdb.evaluation.runner import EvaluateOptions, evaluate
    from semdb.recordings import parse_camera

    settings = overrides.settings()
    check_outputs(json_file, report)
    results: list[EvaluationResult] = []
    for count in parse_counts(keyframes):
        options = EvaluateOptions(
            methods=tuple(method or ["semdb"]),
            keyframes=count,
            max_queries=max_queries,
            coarse=coarse,
            camera=None if camera is None else parse_camera(camera),
            query_depth=query_depth,
        )
        with StagedProgress() as progress:
            results += evaluate(paths, settings, options, progress=progress.update, say=say)
    show(results)
    if json_file is not None:
        from semdb.evaluation.metrics import write_json

        write_json(json_file, results)
    if report is not None:
        from semdb.evaluation.report import write_report

        say(f"wrote {write_report(report, results, settings=used_settings(settings, coarse, query_depth))}")


def check_outputs(json_file: Path | None, report: Path | None) -> None:
    """Raises UsageError where the results could not be written in the end, before anything is computed."""
    import os

    from semdb.errors import UsageError

    if json_file is not None:
        target = json_file if json_file.exists() else json_file.parent
        if json_file.is_dir() or not target.exists() or not os.access(target, os.W_OK):
            raise UsageError(f"--json {json_file}: cannot be written there; name a file in a folder that exists")
    if report is not None:
        try:
            report.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--report {report}: the folder cannot be made: {error.strerror}") from error


def parse_counts(text: str | None) -> list[int | None]:
    """``"12,25"`` becomes ``[12, 25]``, None becomes ``[None]``. Raises UsageError."""
    from semdb.errors import UsageError

    if text is None:
        return [None]
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--keyframes {text}: a number is needed, or several with commas between") from None


def show(results: list[EvaluationResult]) -> None:
    """The table on the terminal. Lines are as long as they need to be where stdout is no terminal."""
    import sys

    from rich.console import Console

    from semdb.evaluation.tables import by_keyframes, results_table

    console = Console() if sys.stdout.isatty() else Console(width=220)
    console.print(results_table(by_keyframes(results)))


def used_settings(settings: Settings, coarse: str, query_depth: bool) -> dict[str, str]:
    """What a report says of the run; no path, no password."""
    return {
        "coarse": coarse,
        "query depth": "yes" if query_depth else "no",
        "database": settings.database_url.partition(":")[0],
        "score threshold": f"{settings.score_threshold:g}",
        "keypoints per image": f"{settings.max_keypoints} at most",
        "threads": str(settings.threads),
    }
