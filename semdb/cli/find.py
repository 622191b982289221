"""`semdb find`: where a thing is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options


@settings_options(models=False)
def command(
    overrides: Overrides,
    what: Annotated[str, typer.Argument(metavar="WHAT", help="A class or a word for one: cup, sofa, electronics.")],
    near: Annotated[str | None, typer.Option("--near", metavar="WHAT", help="That stands near such a thing.")] = None,
    on: Annotated[str | None, typer.Option("--on", metavar="WHAT", help="That stands or lies on such a thing.")] = None,
    not_near: Annotated[
        str | None, typer.Option("--not-near", metavar="WHAT", help="That stands near no such thing.")
    ] = None,
    map_name: Annotated[str | None, typer.Option("--map", metavar="M", help="Only in this map.")] = None,
    seen_after: Annotated[
        str | None,
        typer.Option("--seen-after", metavar="T", help="Last seen since a time, or seen in a recording."),
    ] = None,
    origin: Annotated[
        str | None, typer.Option("--from", metavar="X,Y,Z", help="The nearer to this place the better.")
    ] = None,
    limit: Annotated[int, typer.Option("--limit", metavar="N", help="So many at most.")] = 10,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="DIR", help="A picture of the map from above for each map.")
    ] = None,
    sql: Annotated[bool, typer.Option("--sql", help="Print the statement, and ask nothing.")] = False,
    json: JsonFlag = False,
) -> None:
    """Find things: where they are, what they stand on or near, when they were last seen.

    Needs the landmarks that `semdb refine` computes. Where nothing is found it says whether such a thing was never
    seen, was seen and is gone, or whether the place was not looked at; the exit code is 1 then.
    """
    from semdb.api.finding import lines_of
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import say
    from semdb.errors import UsageError

    try:
        place = None if origin is None else [float(part) for part in origin.split(",")]
    except ValueError:
        raise UsageError(f"--from {origin}: three numbers are expected, X,Y,Z in metres") from None
    with open_database(overrides.settings()) as database:
        found = database.find(
            what,
            near=near,
            on=on,
            not_near=not_near,
            map=map_name,
            seen_after=seen_after,
            origin=place,
            limit=limit,
        )
        if sql:
            print_lines(*found.sql.splitlines())
            return
        if plot is not None:
            for path in database.plot_found(found, plot):
                say(f"wrote {path}")
    if json:
        print_json(found.as_dict())
    else:
        for line in lines_of(found):
            print_lines(line)
    if not found.hits:
        raise typer.Exit(1)
