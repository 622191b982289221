"""`semdb refine`: what needs more than one keyframe, computed anew where a map has changed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import CameraOption, JsonFlag, Overrides, open_database, settings_options

if TYPE_CHECKING:
    from semdb.api.database import Database


@settings_options(models=False)
def command(
    overrides: Overrides,
    map_name: Annotated[str | None, typer.Option("--map", metavar="M", help="Only this map; default: all.")] = None,
    step: Annotated[
        list[str] | None, typer.Option("--step", metavar="STEP", help="Only this step; repeatable.")
    ] = None,
    up: Annotated[
        str | None,
        typer.Option("--up", metavar="X,Y,Z", help="Which way is up in the map, or `estimate`; kept from then on."),
    ] = None,
    frames: Annotated[
        list[str] | None,
        typer.Option(
            "--frames",
            metavar="RECORDING",
            help="A recording that was ingested: its other frames are seen from nearer. Nothing else; repeatable.",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", metavar="N", help="With --frames: the recording's name in the map.")
    ] = None,
    camera: CameraOption = None,
    force: Annotated[bool, typer.Option("--force", help="Also what is up to date, and from nothing.")] = False,
    json: JsonFlag = False,
) -> None:
    """Compute what needs more than one keyframe: confused classes, better 3D points, landmarks and what is up.

    Nothing else depends on it: ingest, deletion and localization work without. Does only what is out of date. A map
    that cannot be refined is named, and makes the exit code 1; the others are refined all the same.
    """
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import StagedProgress, say
    from semdb.errors import DatabaseUnavailableError, SemdbError, UsageError
    from semdb.refinement.run import steps_of

    steps_of(step or ())
    if frames:
        if step or up or force:
            raise UsageError(
                "--frames does nothing else: leave out --step, --up and --force (frames are always read anew)"
            )
        options = {"map": map_name, "name": name, "camera": camera}
        _add_frames(overrides, frames, options, json)
        return
    given = [option for option, value in (("--name", name), ("--camera", camera)) if value is not None]
    if given:
        raise UsageError(f"{' and '.join(given)}: only with --frames, whose recording is read that way")
    done: list[dict[str, Any]] = []
    failed: list[SemdbError] = []
    with open_database(overrides.settings()) as database:
        if up is not None:
            _tell_up(database, map_name, up)
        names = [map_name] if map_name is not None else [info.name for info in database.maps() if info.keyframes]
        for each in names:
            try:
                with StagedProgress(usual="steps") as progress:
                    results = database.refine(each, steps=step or (), force=force, progress=progress.update)
            except SemdbError as error:
                if len(names) == 1 or isinstance(error, DatabaseUnavailableError):
                    raise
                failed.append(error)
                say(f"{each}: not refined: {error}")
                continue
            for result in results:
                state = "computed" if result.computed else "up to date"
                if not json:
                    print_lines(f"{each}: {result.summary}: {result.rows} rows, {state}")
                if not result.current:
                    say(f"{each}: the map changed meanwhile, so {result.summary} is out of date: run it again")
                done.append(
                    {
                        "map": each,
                        "step": result.kind,
                        "rows": result.rows,
                        "computed": result.computed,
                        "current": result.current,
                    }
                )
    if json:
        print_json(done)
    elif not names:
        say("there is no keyframe to refine: ingest a recording first")
    if failed:
        raise typer.Exit(failed[0].exit_code)


def _add_frames(overrides: Overrides, paths: list[str], options: dict[str, Any], json: bool) -> None:
    """What frames beside the keyframes show."""
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import StagedProgress, say

    with open_database(overrides.settings()) as database, StagedProgress(usual="frames") as progress:
        found = database.add_frames(paths, **options, progress=progress.update)
    for one in found:
        for line in one.failed:
            say(f"left out: {line}")
        if not json:
            print_lines(f"{one.recording}: {one.frames} frames beside {one.keyframes} keyframes")
    if json:
        print_json([{"recording": one.recording, "frames": one.frames, "keyframes": one.keyframes} for one in found])


def _tell_up(database: Database, map_name: str | None, up: str) -> None:
    """Notes which way is up in a map. Raises UsageError."""
    from semdb.errors import UsageError

    names = [map_name] if map_name is not None else [info.name for info in database.maps()]
    if len(names) != 1:
        raise UsageError("--up is said of one map: name it with --map")
    try:
        told = None if up == "estimate" else tuple(float(part) for part in up.split(","))
    except ValueError:
        told = ()
    if told is not None and len(told) != 3:
        raise UsageError(f"--up {up}: three numbers are expected, as 0,0,1, or `estimate`")
    database.tell_up(names[0], told)
