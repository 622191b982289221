"""`semdb init`: the schema, and the accounts of a server."""

from __future__ import annotations

from typing import Annotated

import typer

from semdb.cli.options import Overrides, settings_options


@settings_options(models=False)
def command(
    overrides: Overrides,
    accounts: Annotated[
        bool, typer.Option("--accounts", help="Instead: print the SQL of the accounts owner, writer and reader.")
    ] = False,
    execute: Annotated[
        bool, typer.Option("--execute", help="With --accounts: create them, as the account of the database URL.")
    ] = False,
) -> None:
    """Create the schema, or upgrade it; nothing happens when it is there already."""
    settings = overrides.settings()
    if accounts or execute:
        raise NotImplementedError
    _init(settings.database_url)


def _init(url: str) -> None:
    from semdb.database import schema
    from semdb.database.engine import make_engine, safe_url

    engine = make_engine(url)
    try:
        before = schema.current_revision(engine)
        schema.upgrade(engine)
        where = safe_url(engine.url)
    finally:
        engine.dispose()
    if before is None:
        print(f"created the schema, revision {schema.HEAD}, in {where}")
    elif before != schema.HEAD:
        print(f"upgraded the schema of {where} from revision {before} to {schema.HEAD}")
    else:
        print(f"the schema of {where} is up to date (revision {schema.HEAD})")
