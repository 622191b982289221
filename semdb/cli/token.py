"""`semdb token`: who may use the service."""

from __future__ import annotations

import re
from typing import Annotated

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options

command = typer.Typer(
    help="Make, list and revoke tokens of the service.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86_400, "w": 7 * 86_400}


def seconds_of(text: str) -> int:
    """Seconds of ``90d``, ``12h``, ``30m``. Raises UsageError."""
    from semdb.errors import UsageError

    found = re.fullmatch(r"(\d{1,9})([smhdw])", text)
    if found is None:
        raise UsageError(f"--expires {text}: a number and s, m, h, d or w, as 90d or 12h")
    return int(found[1]) * _UNITS[found[2]]


@command.command("create")
@settings_options(models=False)
def create(
    overrides: Overrides,
    role: Annotated[str, typer.Option("--role", metavar="ROLE", help="read, localize, ingest or admin.")],
    map_name: Annotated[str | None, typer.Option("--map", metavar="M", help="Only for this map.")] = None,
    expires: Annotated[
        str | None, typer.Option("--expires", metavar="TIME", help="Ends after this time: 90d, 12h, 30m.")
    ] = None,
    name: Annotated[str | None, typer.Option("--name", metavar="NAME", help="What people call it.")] = None,
) -> None:
    """Make a token and print it, alone on stdout. It is shown once: only its hash is kept."""
    from semdb.cli.output import print_lines
    from semdb.cli.progress import say

    life = None if expires is None else seconds_of(expires)
    with open_database(overrides.settings()) as database:
        made = database.create_token(role, map=map_name, expires_s=life, name=name)
    where = "all maps" if made.token.map is None else f"the map {made.token.map}"
    say(f"token {made.token.id}, role {role}, for {where}; it is shown this once")
    print_lines(made.secret)


@command.command("list")
@settings_options(models=False)
def list_tokens(overrides: Overrides, json: JsonFlag = False) -> None:
    """List tokens, without their secrets."""
    from dataclasses import asdict

    from semdb.cli.output import print_json, print_table

    with open_database(overrides.settings()) as database:
        found = database.tokens()
    if json:
        print_json([asdict(token) for token in found])
        return
    columns = ("id", "name", "role", "map", "created", "expires", "revoked")
    print_table(
        columns,
        [(t.id, t.name, t.role, t.map or "all", t.created_at, t.expires_at, t.revoked_at) for t in found],
    )


@command.command("revoke")
@settings_options(models=False)
def revoke(
    overrides: Overrides, token: Annotated[int, typer.Argument(metavar="ID", help="As `semdb token list` shows it.")]
) -> None:
    """Revoke a token, at once and for good."""
    from semdb.cli.output import print_lines

    with open_database(overrides.settings()) as database:
        database.revoke_token(token)
    print_lines(f"revoked token {token}")
