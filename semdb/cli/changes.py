"""`semdb changes`: what is new, gone or elsewhere since another recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options


@settings_options(models=False)
def command(
    overrides: Overrides,
    between: Annotated[
        tuple[str, str], typer.Option("--between", metavar="A B", help="Two recordings: one before, one after.")
    ],
    map_name: Annotated[
        str | None, typer.Option("--map", metavar="M", help="The map of both; not needed where one map has them.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="DIR", help="A picture from above, and one of the crops.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Tell what appeared, disappeared and moved from one recording of a map to another one.

    Needs the landmarks that `semdb refine` computes. A thing is gone only where its place was looked at and seen
    through; what was not looked at is counted as that.
    """
    from semdb.api.changing import lines_of
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import say

    with open_database(overrides.settings()) as database:
        found = database.changes(*between, map=map_name)
        if plot is not None:
            for path in database.plot_changes(found, plot):
                say(f"wrote {path}")
    if json:
        print_json(found.as_dict())
    else:
        print_lines(*lines_of(found))
