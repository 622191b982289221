"""`semdb sql`: one read-only statement."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from semdb.cli.options import Overrides, settings_options


class Format(StrEnum):
    TABLE = "table"
    CSV = "csv"
    JSON = "json"


@settings_options(models=False)
def command(
    overrides: Overrides,
    statement: Annotated[str, typer.Argument(metavar='"SELECT ..."', help="One statement that reads.")],
    fmt: Annotated[Format, typer.Option("--format", help="How rows are printed.")] = Format.TABLE,
) -> None:
    """Run one read-only SQL statement.

    docs/sql.md has examples. On a server it runs as the account of SEMDB_READER_URL.
    SEMDB_SQL_TIME_LIMIT_S ends what takes too long.
    """
    from contextlib import closing

    from semdb.cli.output import distinct, print_rows
    from semdb.cli.progress import say
    from semdb.database.readonly import run_readonly

    columns, rows = run_readonly(overrides.settings(), statement)
    if fmt is Format.JSON and distinct(columns) != list(columns):
        say(f"columns of equal names are numbered: {', '.join(distinct(columns))}")
    with closing(rows):
        print_rows(columns, rows, fmt)
