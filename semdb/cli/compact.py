"""`semdb compact`: the rows of a map, smaller."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options


@settings_options(models=False)
def command(
    overrides: Overrides,
    map_name: Annotated[str, typer.Option("--map", metavar="M", help="The map.")],
    dtype: Annotated[
        str, typer.Option("--descriptors", metavar="KIND", help="uint8, float16, or keep: as they are.")
    ] = "uint8",
    keep_images: Annotated[
        str, typer.Option("--images", metavar="KIND", help="original: as they are; jpeg; none (SEMDB_KEEP_IMAGES).")
    ] = "original",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be saved.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    json: JsonFlag = False,
) -> None:
    """Rewrite the rows of a map smaller: descriptors and keypoints, and images where that is asked for.

    What is rounded or left out does not come back. Every keyframe is rewritten in a transaction of its own: stopped
    anywhere, each is the old one or the new one, and the next run does the rest.
    """
    from semdb.cli.delete import confirm
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import Progress
    from semdb.database.blob_text import size_text

    with open_database(overrides.settings()) as database:
        info = database.map(map_name)
        if not dry_run and keep_images != "original":
            confirm(
                f"Rewrite images of {info.keyframes} keyframes of the map {info.name} for good?",
                yes,
                "nothing was rewritten",
            )
        with Progress(f"compacting {info.name}", "keyframes") as progress:
            done = database.compact(
                info.name,
                dtype=None if dtype == "keep" else dtype,
                keep_images=keep_images,
                dry_run=dry_run,
                progress=progress.update,
            )
    if json:
        print_json({"map": info.name, "dry_run": dry_run, **asdict(done), "saved": done.saved})
        return
    verb = "would be rewritten" if dry_run else "rewritten"
    print_lines(
        f"{info.name}: {done.rewritten} of {done.keyframes} keyframes {verb}; keypoints and descriptors "
        f"{size_text(done.rows_before)} -> {size_text(done.rows_after)}, images {size_text(done.images_before)} -> "
        f"{size_text(done.images_after)}"
    )
