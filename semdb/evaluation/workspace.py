"""A database of an evaluation's own: a temporary SQLite file, or a schema that is made and dropped on the server."""

from __future__ import annotations

import contextlib
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import text
from sqlalchemy.exc import DBAPIError

from semdb.database import retry, schema
from semdb.database.engine import make_engine, parse_url, safe_url, sqlite_path
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError

_NOT_ALLOWED = {1044, 1142, 1227}  # the account is known and has not the right


@contextlib.contextmanager
def evaluation_store(database_url: str) -> Iterator[Store]:
    """An empty store on the same kind of database as `database_url`, gone at the end. Never the user's own data.

    Raises DatabaseError where the account may not create a schema.
    """
    if sqlite_path(parse_url(database_url)) is not None or database_url.startswith("sqlite"):
        with (
            tempfile.TemporaryDirectory(prefix="semdb-evaluate-") as folder,
            open_store(f"sqlite:///{Path(folder) / 'evaluation.sqlite3'}", create=True) as store,
        ):
            yield store
        return
    url = parse_url(database_url)
    name = f"semdb_evaluate_{secrets.token_hex(6)}"
    _run(database_url, f"CREATE DATABASE {name}")
    try:
        own = url.set(database=name).render_as_string(hide_password=False)
        engine = make_engine(own)
        schema.upgrade(engine)
        engine.dispose()
        with open_store(own) as store:
            yield store
    finally:
        _run(database_url, f"DROP DATABASE {name}")


def _run(database_url: str, statement: str) -> None:
    engine = make_engine(database_url)
    try:
        with engine.begin() as connection:
            connection.execute(text(statement))
    except DBAPIError as error:
        if retry.error_code(error) not in _NOT_ALLOWED:
            raise retry.explain(engine, error) from error
        raise DatabaseError(
            f"{safe_url(engine.url)}: {statement} was refused ({error.orig}). An evaluation works in a schema of its "
            "own: use an account that may create schemas, or SEMDB_DATABASE_URL=sqlite:///FILE"
        ) from error
    finally:
        engine.dispose()
