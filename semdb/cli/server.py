"""Commands that ask a service instead of a database."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from semdb.cli.options import Overrides
    from semdb.client import RemoteDatabase

ServerOption = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        envvar="SEMDB_SERVER",
        show_envvar=False,
        help="Ask the service there (semdb serve) instead of a database; over SEMDB_SERVER.",
    ),
]


def check_server(server: str, overrides: Overrides, others: Mapping[str, bool]) -> None:
    """Raises UsageError for options that are of a database, and not of a service, `others` among them."""
    from dataclasses import fields

    from semdb.errors import UsageError
    from semdb.shown import for_terminal

    where = f"with a service (--server or SEMDB_SERVER, {for_terminal(server)})"
    for field in fields(overrides):
        if getattr(overrides, field.name) is not None:
            raise UsageError(f"--{field.name.replace('_', '-')} means nothing {where}: leave out one of them")
    for option, given in others.items():
        if given:
            raise UsageError(f"{option} means nothing {where}: it is for a database (--database-url)")


def open_server(url: str) -> RemoteDatabase:
    """The service that a command asks. Raises UsageError."""
    from semdb.cli.progress import say
    from semdb.client import connect

    return connect(url, say=say)
