"""`semdb sql`: statements that read, from the command line, a file, a pipe or a prompt."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semdb.cli.options import Overrides, open_database, settings_options

if TYPE_CHECKING:
    from semdb.settings import Settings


class Format(StrEnum):
    TABLE = "table"
    CSV = "csv"
    JSON = "json"


@settings_options(models=False)
def command(
    overrides: Overrides,
    statement: Annotated[
        str | None,
        typer.Argument(
            metavar='["SELECT ..."]', help="One statement that reads; without it a prompt, or what is piped in."
        ),
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--file", "-f", metavar="FILE", help="Run the statements of this file; - is a pipe.")
    ] = None,
    fmt: Annotated[Format, typer.Option("--format", help="How rows are printed.")] = Format.TABLE,
) -> None:
    """Run read-only SQL statements; on a terminal, without any, a prompt.

    docs/sql.md has examples. On a server it runs as the account of SEMDB_READER_URL.
    SEMDB_SQL_TIME_LIMIT_S ends what takes too long.
    """
    import sys

    from semdb.errors import UsageError

    settings = overrides.settings()
    if statement is not None and file is not None:
        raise UsageError("give a statement or --file, not both")
    if statement is not None:
        run(settings, statement, fmt)
    elif file is not None and str(file) != "-":
        run_text(settings, decode(file.read_bytes(), str(file)), str(file), fmt)
    elif file is None and sys.stdin.isatty() and sys.stdout.isatty():
        prompt(settings, fmt)
    else:
        run_text(settings, decode(sys.stdin.buffer.read(), "standard input"), "standard input", fmt)


def run(settings: Settings, statement: str, fmt: Format) -> None:
    """Runs one statement and prints its rows."""
    from semdb.cli.output import print_rows
    from semdb.cli.sql_text import say_renamed

    with open_database(settings) as database, database.sql(statement) as rows:
        say_renamed(rows.columns, fmt)
        print_rows(rows.columns, rows, fmt)


def run_text(settings: Settings, text: str, where: str, fmt: Format) -> None:
    """Runs the statements of a text one after the other, tables with a blank line between them.

    Raises UsageError for a text without any, and for several whose rows are to be CSV or JSON; an error of a statement
    names its line.
    """
    from semdb.cli.output import print_lines
    from semdb.cli.sql_text import statements
    from semdb.errors import SemdbError, UsageError

    found = statements(text, backslashes=not settings.database_url.startswith("sqlite"))
    if not found:
        raise UsageError(f"{where}: there is no statement in it")
    if len(found) > 1 and fmt is not Format.TABLE:
        raise UsageError(f"{where}: {len(found)} statements; --format {fmt} takes one, since its rows are one list")
    for number, statement in enumerate(found):
        if number:
            print_lines("")
        try:
            run(settings, statement.text, fmt)
        except SemdbError as error:
            if len(found) > 1:
                error.args = (f"{where}, line {statement.line}: {error}",)
            raise


def decode(data: bytes, where: str) -> str:
    """UTF-8 as text, with or without its mark. Raises UsageError for what is none."""
    from semdb.errors import UsageError

    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(f"{where}: byte {error.start} is no UTF-8: statements are text in UTF-8") from error


def prompt(settings: Settings, fmt: Format) -> None:
    """Reads statements from the terminal until there are no more."""
    from semdb.cli.output import print_lines
    from semdb.cli.sql_prompt import Prompt

    with open_database(settings) as database:
        known = database.tables()  # says at once when there is no database
        print_lines(f"{database.url}: {len(known)} tables and views; ? for help, Ctrl-D leaves")
        Prompt(database, fmt, known).run()
