"""`semdb evaluate`: how well images are localized in the keyframes of a recording, or of other recordings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semdb.cli.options import (
    AcceptOption,
    CameraOption,
    Overrides,
    PoseBackboneOption,
    PoseStepsOption,
    PoseWeightsOption,
    Reading,
    open_database,
    pose_options,
    reading_options,
    settings_options,
)
from semdb.shown import number

if TYPE_CHECKING:
    from semdb.evaluation.metrics import EvaluationResult
    from semdb.evaluation.runner import EvaluateOptions, Outcome
    from semdb.settings import Settings


@settings_options(models=True)
@reading_options()
def command(
    overrides: Overrides,
    reading: Reading,
    paths: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[PATH...]", help="Folders of recordings; scenes of 7-Scenes for --protocol split."),
    ] = None,
    protocol: Annotated[
        str,
        typer.Option(
            "--protocol", metavar="paper|split", help="Keyframes and queries of one recording, or of different ones."
        ),
    ] = "paper",
    map_from: Annotated[
        list[Path] | None,
        typer.Option("--map-from", metavar="FOLDER", help="Keyframes come from this recording; may be repeated."),
    ] = None,
    query_from: Annotated[
        list[Path] | None,
        typer.Option("--query-from", metavar="FOLDER", help="Queries come from this recording; may be repeated."),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            metavar="NAME",
            help="semdb (default), cnn, paper, chen, sift-reference, oracle, colmap, posenet, posenet-4d, cnn-lstm, "
            "middle-keyframe, mean-pose; NAME+depth gives queries their depth; several on the same queries.",
        ),
    ] = None,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Print what filter, cascade and background keypoints bring.")
    ] = False,
    keyframes: Annotated[
        str | None,
        typer.Option("--keyframes", metavar="N[,N...]", help="Exactly N keyframes; several numbers run one by one."),
    ] = None,
    max_queries: Annotated[
        int | None, typer.Option("--max-queries", metavar="N", help="N queries, evenly spaced; default: all.")
    ] = None,
    accept: AcceptOption = None,
    coarse: Annotated[
        str, typer.Option("--coarse", metavar="sql|index", help="Coarse step in SQL, or from a mirror in memory.")
    ] = "sql",
    query_depth: Annotated[
        bool, typer.Option("--query-depth", help="Give the queries their depth images too, not the colour alone.")
    ] = False,
    unrefined: Annotated[
        bool, typer.Option("--unrefined", help="Leave the map as ingest makes it, without `semdb refine`.")
    ] = False,
    truth: Annotated[
        str,
        typer.Option(
            "--truth", metavar="given|refined|both", help="Poses of the recording, or refined by structure from motion."
        ),
    ] = "given",
    camera: CameraOption = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the results as JSON.")] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="DIR", help="Write a page with tables, plots and pictures, a CSV, JSON."),
    ] = None,
    trajectories: Annotated[
        Path | None,
        typer.Option("--trajectories", metavar="DIR", help="Write estimated and true poses in TUM's format (evo)."),
    ] = None,
    pose_backbone: PoseBackboneOption = "frozen",
    pose_weights: PoseWeightsOption = None,
    pose_steps: PoseStepsOption = None,
    pose_networks: Annotated[
        Path | None,
        typer.Option("--pose-networks", metavar="DIR", help="Networks of `semdb train pose`; new ones are kept there."),
    ] = None,
) -> None:
    """Keyframes into a database of its own, other frames as queries, errors against the true poses."""
    from semdb.cli.progress import StagedProgress
    from semdb.evaluation.methods import ABLATION
    from semdb.evaluation.regression import PoseTraining
    from semdb.evaluation.runner import EvaluateOptions
    from semdb.evaluation.worst import WORST
    from semdb.localization.acceptance import parse_tolerance
    from semdb.recordings import parse_camera

    settings = overrides.settings()
    names = list(method or []) + [name for _, _, name in ABLATION if ablation]
    options = EvaluateOptions(
        methods=tuple(dict.fromkeys(names or ["semdb"])),
        keyframes=tuple(parse_counts(keyframes)),
        max_queries=max_queries,
        coarse=coarse,
        accept=None if accept is None else parse_tolerance(accept),
        camera=None if camera is None else parse_camera(camera),
        reading=reading,
        query_depth=query_depth,
        refine=not unrefined,
        protocol=protocol,
        map_from=tuple(map_from or ()),
        query_from=tuple(query_from or ()),
        truth=truth,
        pictures=WORST if report is not None else 0,
        training=PoseTraining(pose_options(pose_backbone, pose_weights, pose_steps), pose_networks),
    )
    check_outputs(json_file, report, trajectories)
    output = Outputs(json_file, report, trajectories, used_settings(settings, options), expects_several(paths, options))
    with StagedProgress() as progress:
        for outcome in open_database(settings).evaluate(paths or [], options, progress=progress.update):
            output.add(outcome)
    output.finish(ablation)


@dataclass
class Outputs:
    """Writes what is there after every recording, so that a later failure, or a kill, costs only what was not done."""

    json_file: Path | None
    report: Path | None
    trajectories: Path | None
    settings: dict[str, str]
    several: bool
    results: list[EvaluationResult] = field(default_factory=list)
    failed: list[Outcome] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        if outcome.error is not None:
            self.failed.append(outcome)
            if self.several:  # the others may take hours
                self._say_failed(outcome)
            return
        self.results += outcome.results
        self._write()

    def _write(self) -> None:
        from semdb.evaluation.files import write_json
        from semdb.evaluation.report import write_report
        from semdb.evaluation.trajectories import write_trajectories

        if self.json_file is not None:
            write_json(self.json_file, self.results, several=self.several or len(self.results) > 1)
        if self.trajectories is not None:
            write_trajectories(self.trajectories, self.results)
        if self.report is not None:
            failures = {outcome.name: str(outcome.error) for outcome in self.failed}
            write_report(self.report, self.results, settings=self.settings, failures=failures)

    def finish(self, ablation: bool) -> None:
        """The tables on the terminal. Exits with 1 where something failed, with the error's code where all did."""
        from semdb.cli.progress import say

        if not self.results:
            raise self._all_failed()
        show(self.results, ablation)
        if self.failed:
            self._write()  # the page names what failed after the last success, too
        if self.report is not None:
            say(f"wrote {self.report / 'index.html'}")
        if self.trajectories is not None:
            say(f"wrote trajectories to {self.trajectories}; evo_ape tum NAME-truth.txt NAME.txt reads them")
        for outcome in self.failed:
            self._say_failed(outcome)
        if self.failed:
            raise typer.Exit(1)

    def _say_failed(self, outcome: Outcome) -> None:
        from semdb.cli.progress import say

        say(f"not evaluated: {without_name(outcome)}")

    def _all_failed(self) -> Exception:
        """The error itself where it is the only one; else the exit code of the first, once all have been said."""
        from semdb.errors import UsageError

        errors = [outcome.error for outcome in self.failed if outcome.error is not None]
        if not errors:
            return UsageError("nothing was evaluated")
        if len(errors) == 1 and not self.several:
            return errors[0]
        if not self.several:
            for outcome in self.failed:
                self._say_failed(outcome)
        return typer.Exit(errors[0].exit_code)


def without_name(outcome: Outcome) -> str:
    """What failed and why, where the reason does not begin with its name anyway."""
    reason = str(outcome.error)
    return reason if reason.startswith(outcome.name) else f"{outcome.name}: {reason}"


def expects_several(paths: list[Path] | None, options: EvaluateOptions) -> bool:
    """Whether the JSON file is a list from the first result on."""
    from semdb.evaluation.runner import BOTH

    counts = len(paths or [1]) * len(options.methods) * len(options.keyframes)
    return counts > 1 or options.truth == BOTH


def check_outputs(json_file: Path | None, report: Path | None, trajectories: Path | None = None) -> None:
    """Raises UsageError where the results could not be written in the end, before anything is computed."""
    import os
    import tempfile

    from semdb.errors import UsageError

    if json_file is not None:
        target = json_file if json_file.exists() and not json_file.is_file() else json_file.parent
        if json_file.is_dir() or not target.exists() or not os.access(target, os.W_OK):
            raise UsageError(f"--json {json_file}: cannot be written there; name a file in a folder that exists")
    for option, folder in (("--report", report), ("--trajectories", trajectories)):
        if folder is None:
            continue
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{option} {folder}: the folder cannot be made: {error.strerror}") from error
        try:
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise UsageError(f"{option} {folder}: nothing can be written there: {error.strerror}") from error


def parse_counts(text: str | None) -> list[int | None]:
    """``"12,25"`` becomes ``[12, 25]``, None becomes ``[None]``. Raises UsageError."""
    from semdb.errors import UsageError

    if text is None:
        return [None]
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--keyframes {text}: a number is needed, or several with commas between") from None


def show(results: list[EvaluationResult], ablation: bool) -> None:
    """The tables on the terminal. Lines are as long as they need to be where stdout is no terminal."""
    import sys

    from rich.console import Console

    from semdb.evaluation.tables import by_keyframes, terminal_tables

    console = Console() if sys.stdout.isatty() else Console(width=220)
    for table in terminal_tables(by_keyframes(results), ablation=ablation):
        console.print(table)


def used_settings(settings: Settings, options: EvaluateOptions) -> dict[str, str]:
    """What a report says of the run; no path, no password."""
    return {
        "coarse": options.coarse,
        "query depth": "yes" if options.query_depth else "no",
        "accepted": "-" if options.accept is None else f"{options.accept.metres:g} m, {options.accept.degrees:g} deg",
        "truth": options.truth,
        "refined map": "yes" if options.refine else "no",
        "database": settings.database_url.partition(":")[0],
        "score threshold": number(settings.score_threshold),
        "keypoints per image": f"{settings.max_keypoints} at most",
        "threads": str(settings.threads),
    }
