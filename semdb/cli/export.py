"""`semdb export` and `semdb import`: maps as other programs read them, and whole ones between databases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options


@settings_options(models=False)
def command(
    overrides: Overrides,
    form: Annotated[
        str, typer.Argument(metavar="FORMAT", help="tum, colmap, kapture, ply, mcap, rrd, g2o, landmarks or semdb.")
    ],
    map_name: Annotated[str, typer.Argument(metavar="MAP", help="Name of the map.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File or folder to write, which must not be there.")],
    voxel: Annotated[float, typer.Option("--voxel", metavar="M", help="ply: one point in so large a cube.")] = 0.02,
    max_depth: Annotated[float, typer.Option("--max-depth", metavar="M", help="ply: none farther than this.")] = 8.0,
    landmarks: Annotated[bool, typer.Option("--landmarks", help="ply: with the boxes of landmarks.")] = False,
    json: JsonFlag = False,
) -> None:
    """Write a map in a format that other programs read, or whole, for another semdb."""
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import StagedProgress

    with open_database(overrides.settings()) as database, StagedProgress() as progress:
        about = database.export(
            *(form, map_name, out),
            voxel_m=voxel,
            max_depth_m=max_depth,
            landmarks=landmarks,
            progress=progress.update,
        )
    if json:
        print_json({"map": map_name, "format": form, "path": str(out), "written": about})
    else:
        print_lines(f"wrote {out}: {about}")


@settings_options(models=False)
def import_command(
    overrides: Overrides,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `semdb export semdb` wrote.")],
    map_name: Annotated[
        str | None, typer.Option("--map", metavar="M", help="Name of the map here; default: the one it had.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Add a map that another semdb exported whole. Run again after it was cut off, it goes on."""
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import StagedProgress

    with open_database(overrides.settings()) as database, StagedProgress() as progress:
        done = database.import_map(folder, map=map_name, progress=progress.update)
    if json:
        print_json(
            {"map": done.map, "recordings": done.recordings, "keyframes": done.keyframes, "skipped": done.skipped}
        )
    else:
        there = f", {done.skipped} were there" if done.skipped else ""
        print_lines(f"map {done.map}: {done.keyframes} keyframes imported{there}")
