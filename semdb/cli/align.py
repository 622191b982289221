"""`semdb align`: where a recording lies in a map, and bringing it there."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options
from semdb.shown import for_shell, measure

if TYPE_CHECKING:
    from semdb.api import Database
    from semdb.refinement.align_report import AlignedKeyframe, AlignReport

COLUMNS = (
    *("keyframe", "frame", "verdict", "agrees", "inliers"),
    *("off m", "off deg", "shift m", "shift deg", "bend m", "bend deg"),
)


@settings_options(models=False)
def command(
    overrides: Overrides,
    recording: Annotated[
        str | None, typer.Argument(help="Name of the recording; without it all of the map named by --from.")
    ] = None,
    map_name: Annotated[str | None, typer.Option("--map", metavar="M", help="The map to find it in.")] = None,
    source_map: Annotated[
        str | None, typer.Option("--from", metavar="MAP", help="The map that it is in, where several have it.")
    ] = None,
    name: Annotated[str | None, typer.Option("--name", metavar="N", help="Its name in the map.")] = None,
    joint: Annotated[bool, typer.Option("--joint", help="The map's own keyframes may move too.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done, keyframe by keyframe.")] = False,
    undo: Annotated[bool, typer.Option("--undo", help="Take back what moved it last.")] = False,
    json: JsonFlag = False,
) -> None:
    """Find where a recording lies in a map by localizing its keyframes there, and move it into the map.

    All poses change at once or not at all. Where it does not convince, nothing is changed, the evidence is printed, and
    the exit code is 1.
    """
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import StagedProgress
    from semdb.errors import UsageError

    if undo:
        given = {"--from": source_map, "--name": name, "--joint": joint or None, "--dry-run": dry_run or None}
        wrong = [option for option, value in given.items() if value is not None]
        if wrong:
            raise UsageError(f"--undo takes no {', '.join(wrong)}: leave that out")
        with open_database(overrides.settings()) as database:
            _undo(database, recording, map_name, json=json)
        return
    if map_name is None:
        raise UsageError("say which map to find it in: --map M")
    with open_database(overrides.settings()) as database, StagedProgress() as progress:
        report = database.align(
            recording,
            map=map_name,
            source_map=source_map,
            name=name,
            joint=joint,
            dry_run=dry_run,
            progress=progress.update,
        )
    if json:
        print_json(as_json(report))
    else:
        if dry_run or not report.convinced:
            print_keyframes(report)
        print_lines(*as_lines(report, name, dry_run=dry_run))
    if not report.convinced:
        raise typer.Exit(1)


def _undo(database: Database, recording: str | None, map_name: str | None, *, json: bool) -> None:
    from semdb.cli.output import print_json, print_lines

    done = database.undo_align(recording, map=map_name)
    if json:
        print_json({"undone": done.id, "kind": done.kind.value, "map": done.from_map, "recording": done.from_name})
    elif done.recording_id is None:
        print_lines(f"took back what semdb refine did to the poses of {map_name}")
    else:
        print_lines(f"took back: {done.from_name} is in the map {done.from_map} again, its poses are what they were")


def print_keyframes(report: AlignReport) -> None:
    """What became of each keyframe, as a table."""
    from semdb.cli.output import print_lines, print_rows

    print_rows(COLUMNS, [row(one) for one in report.keyframes], "table")
    print_lines("")


def row(one: AlignedKeyframe) -> tuple[Any, ...]:
    """One line of the table."""
    numbers = (one.off_m, one.off_deg, one.shift_m, one.shift_deg, one.bend_m, one.bend_deg)
    shown = (None if math.isnan(value) else round(value, 4) for value in numbers)
    frame = f"{one.recording}/{one.frame_index}"
    return (one.keyframe, frame, one.verdict, "yes" if one.agrees else "", one.inliers, *shown)


def as_lines(report: AlignReport, name: str | None = None, *, dry_run: bool = False) -> list[str]:
    """The evidence, and what was done, for people. `name` is the one that the recording has in the map, if another."""
    names = ", ".join(report.recordings)
    lines = [
        f"localized  {report.localized} of {len(report.keyframes)} keyframes of {names} in the map {report.map}",
        f"agreeing   {report.agreeing} on one place; {report.rival} on the next best",
        f"near       {report.near_same} of {report.near} keyframes that should look the same as the map there do",
    ]
    if not report.convinced:
        return [*lines, f"not moved: {report.reason}; nothing is changed"]
    bends = sorted(one.bend_m for one in report.keyframes)
    lines.append(f"bend       {measure(bends[len(bends) // 2], 4)} m median, {measure(bends[-1], 4)} m at most")
    if report.map_shift_m:
        moved = "would move" if dry_run else "moved"
        lines.append(f"map        its keyframes {moved} by {measure(report.map_shift_m, 4)} m at most")
    if dry_run:
        return [*lines, f"would move from {report.from_map} to {report.map}; nothing is changed"]
    lines.append(f"moved from {report.from_map} to {report.map}")
    back = [for_shell(["semdb", "align", one, "--map", report.map, "--undo"]) for one in report.recordings]
    if name is not None:
        back = [for_shell(["semdb", "align", name, "--map", report.map, "--undo"])]
    return [*lines, *(f"{'' if n else 'back again':<11}{text}" for n, text in enumerate(reversed(back)))]


def as_json(report: AlignReport) -> dict[str, Any]:
    """What `--json` prints."""
    motion = report.map_from_recording
    return {
        "recordings": list(report.recordings),
        "from_map": report.from_map,
        "map": report.map,
        "convinced": report.convinced,
        "reason": report.reason,
        "moved": bool(report.operation),
        "operation": report.operation or None,
        "localized": report.localized,
        "agreeing": report.agreeing,
        "rival": report.rival,
        "near": report.near,
        "near_same": report.near_same,
        "map_from_recording": None if motion is None else motion.tolist(),
        "map_shift_m": report.map_shift_m,
        "keyframes": [asdict(one) for one in report.keyframes],
    }
