"""`semdb delete`: recordings, maps or single keyframes, with all that belongs to them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from semdb.cli.options import Overrides, settings_options
from semdb.cli.output import print_lines
from semdb.shown import for_terminal

if TYPE_CHECKING:
    from semdb.database.records import RecordingStatus
    from semdb.database.store import Store

command = typer.Typer(
    help="Delete recordings, maps or keyframes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")]


def confirm(question: str, yes: bool) -> None:
    """Ask on the terminal unless `yes`. Raises `UsageError` where nobody can answer, `typer.Exit` for a no."""
    import sys

    from semdb.errors import UsageError

    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"{question} Nobody can answer here: give --yes")
    if not typer.confirm(for_terminal(question), err=True):
        print_lines("nothing was deleted")
        raise typer.Exit(1)


def find_recording(store: Store, name: str, map_name: str | None) -> RecordingStatus:
    """The recording of that name. Raises `NotFoundError`, or `UsageError` when several maps have one."""
    from semdb.errors import NotFoundError, UsageError

    everything = store.status(None if map_name is None else store.find_map(map_name).id)
    found = [recording for recording in everything if recording.name == name]
    if not found:
        names = ", ".join(sorted({recording.name for recording in everything})) or "none"
        raise NotFoundError(f"there is no recording {name!r} in {store.url}; recordings: {names}")
    if len(found) > 1:
        maps = ", ".join(recording.map for recording in found)
        raise UsageError(f"the maps {maps} each have a recording {name!r}: say which with --map")
    return found[0]


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
    from semdb.database.store import open_store

    with open_store(overrides.settings().database_url) as store:
        found = find_recording(store, name, map_name)
        confirm(f"Delete the recording {found.map}/{found.name} with {found.keyframes} keyframes?", yes)
        with Progress(f"deleting {found.name}", "keyframes") as progress:
            deleted = store.delete_recording(found.recording_id, progress.update)
        print_lines(f"deleted the recording {found.map}/{found.name}: {deleted.keyframes} keyframes")


@command.command("map")
@settings_options(models=False)
def delete_map(
    overrides: Overrides, name: Annotated[str, typer.Argument(help="Name of the map.")], yes: Yes = False
) -> None:
    """Delete a map with all its recordings and its log of queries."""
    from semdb.cli.progress import Progress
    from semdb.database.store import open_store

    with open_store(overrides.settings().database_url) as store:
        found = store.find_map(name)
        confirm(f"Delete the map {name} with {found.recordings} recordings, {found.keyframes} keyframes?", yes)
        with Progress(f"deleting {name}", "keyframes") as progress:
            deleted = store.delete_map(found.id, progress.update)
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
    from semdb.database.store import open_store

    with open_store(overrides.settings().database_url) as store:
        wanted = sorted(set(keyframes))
        store.load_keyframes(wanted, descriptors=False)  # says which one does not exist
        confirm(f"Delete {len(wanted)} keyframes?", yes)
        with Progress("deleting", "keyframes") as progress:
            number = store.delete_keyframes(wanted, progress.update)
        print_lines(f"deleted {number} keyframes")
