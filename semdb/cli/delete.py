"""`semdb delete`: recordings, maps or single keyframes, with all that belongs to them."""

from __future__ import annotations

from typing import Annotated

import typer

from semdb.cli.options import Overrides, open_database, settings_options
from semdb.cli.output import print_lines
from semdb.shown import for_terminal

command = typer.Typer(
    help="Delete recordings, maps or keyframes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")]


def confirm(question: str, yes: bool, kept: str = "nothing was deleted") -> None:
    """Ask on the terminal unless `yes`. Raises `UsageError` where nobody can answer, `typer.Exit` for a no."""
    import sys

    from semdb.errors import UsageError

    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"{question} Nobody can answer here: give --yes")
    if not typer.confirm(for_terminal(question), err=True):
        print_lines(kept)
        raise typer.Exit(1)


@command.command("recording")
@settings_options(models=False)
def delete_recording(
    overrides: Overrides,
    name: Annotated[str, typer.Argument(help="Name of the recording, as `semdb status` shows it.")],
    map_name: Annotated[
        str | None, typer.Option("--map", metavar="MAP", help="Its map, where several have it.")
    ] = None,
    yes: Yes = False,
) -> None:
    """Delete a recording: keyframes, images, objects, keypoints, vectors and its plan."""
    from semdb.cli.progress import Progress

    with open_database(overrides.settings()) as database:
        found = database.recording(name, map_name)
        confirm(f"Delete the recording {found.map}/{found.name} with {found.keyframes} keyframes?", yes)
        with Progress(f"deleting {found.name}", "keyframes") as progress:
            deleted = database.delete(recording=found.name, map=found.map, progress=progress.update)
        print_lines(f"deleted the recording {found.map}/{found.name}: {deleted.keyframes} keyframes")


@command.command("map")
@settings_options(models=False)
def delete_map(
    overrides: Overrides, name: Annotated[str, typer.Argument(help="Name of the map.")], yes: Yes = False
) -> None:
    """Delete a map with all its recordings and its log of queries."""
    from semdb.cli.progress import Progress

    with open_database(overrides.settings()) as database:
        found = database.map(name)
        confirm(f"Delete the map {name} with {found.recordings} recordings, {found.keyframes} keyframes?", yes)
        with Progress(f"deleting {name}", "keyframes") as progress:
            deleted = database.delete(map=found.name, progress=progress.update)
        print_lines(f"deleted the map {name}: {deleted.recordings} recordings, {deleted.keyframes} keyframes")


@command.command("keyframes")
@settings_options(models=False)
def delete_keyframes(
    overrides: Overrides,
    keyframes: Annotated[list[int], typer.Argument(metavar="ID...", help="Ids, as `semdb sql` shows them.")],
    yes: Yes = False,
) -> None:
    """Delete single keyframes; ingesting their recording again does not bring them back."""
    from semdb.cli.progress import Progress

    with open_database(overrides.settings()) as database:
        wanted = sorted(set(keyframes))
        database.check_keyframes(wanted)
        confirm(f"Delete {len(wanted)} keyframes?", yes)
        with Progress("deleting", "keyframes") as progress:
            deleted = database.delete(keyframes=wanted, progress=progress.update)
        print_lines(f"deleted {deleted.keyframes} keyframes")
