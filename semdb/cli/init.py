"""`semdb init`: the schema, and the accounts of a server."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from semdb.cli.options import Overrides, open_database, settings_options
from semdb.cli.output import print_lines

if TYPE_CHECKING:
    from semdb.settings import Settings


@settings_options(models=False)
def command(
    overrides: Overrides,
    accounts: Annotated[
        bool, typer.Option("--accounts", help="Instead: print the SQL of the accounts owner, writer and reader.")
    ] = False,
    reader: Annotated[
        bool, typer.Option("--reader", help="Instead: print the SQL of the account of `semdb sql` alone.")
    ] = False,
    execute: Annotated[
        bool,
        typer.Option("--execute", help="With --accounts or --reader: create them, as the account of the database URL."),
    ] = False,
    rotate: Annotated[
        bool,
        typer.Option("--rotate", help="With --accounts or --reader: new passwords for accounts that are there."),
    ] = False,
    grants: Annotated[
        bool,
        typer.Option(
            "--grants", help="With --accounts or --reader: accounts that are there get this version's rights."
        ),
    ] = False,
) -> None:
    """Create or upgrade the schema; nothing happens when it is there."""
    from semdb.errors import UsageError

    settings = overrides.settings()
    for option, given in (("--execute", execute), ("--rotate", rotate), ("--grants", grants)):
        if given and not (accounts or reader):
            raise UsageError(f"{option} goes with --accounts or --reader")
    if rotate and grants:
        raise UsageError("--rotate is of passwords, --grants of rights: one after the other")
    if accounts or reader:
        _accounts(settings.database_url, execute, only_reader=not accounts, rotate=rotate, grants=grants)
    else:
        _init(settings)


def _accounts(url: str, execute: bool, *, only_reader: bool, rotate: bool, grants: bool) -> None:
    """Print statements and URLs as SQL with comments; with `execute` run them and print the URLs only."""
    from semdb.database.accounts import ROLES, plan_accounts
    from semdb.database.accounts import execute as run_statements

    plan = plan_accounts(url, roles=("reader",) if only_reader else ROLES, rotate=rotate, grants=grants)
    if execute and grants:
        run_statements(url, plan.statements)
        print_lines("the rights are those of this version")
    elif execute:
        run_statements(url, plan.statements)
        what = (
            "account; nothing else remembers its password"
            if only_reader
            else "accounts; nothing else remembers their passwords"
        )
        print_lines(f"{'changed the passwords of' if rotate else 'created'} the {what}:")
    else:
        for statement in plan.statements:
            print_lines(f"{statement};")
    variables = {
        "owner": "SEMDB_DATABASE_URL of semdb init",
        "writer": "SEMDB_DATABASE_URL",
        "reader": "SEMDB_READER_URL",
    }
    for role, account_url in plan.urls.items():
        print_lines(f"{'' if execute else '-- '}{role} ({variables[role]}): {account_url}")


def _init(settings: Settings) -> None:
    from semdb.database.inspection import COLLATION

    with open_database(settings) as database:
        made = database.init()
    if made.collation is not None:
        print_lines(
            f"changed the collation of the schema from {made.collation} to {COLLATION}, which keeps all names apart"
        )
    if made.before is None:
        print_lines(f"created the schema, revision {made.now}, in {database.url}")
    elif made.before != made.now:
        print_lines(f"upgraded the schema of {database.url} from revision {made.before} to {made.now}")
        if not database.url.startswith("sqlite"):
            print_lines(
                "its reader, where it has one, gets the rights on it by `semdb init --reader --grants --execute`"
            )
    else:
        print_lines(f"the schema of {database.url} is up to date (revision {made.now})")
