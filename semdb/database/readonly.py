"""One SELECT of a user, which cannot change anything: the database itself refuses whatever else it is.

SQLite (`readonly_sqlite`): the file is opened with ``mode=ro`` in a process of its own, and an authorizer allows
SELECT, reading columns and functions only, so no ATTACH (which creates files), no PRAGMA and no writing. Server
(`readonly_server`): the account of ``SEMDB_READER_URL``, refused when its grants are more than SELECT: a read-only
transaction alone still lets CREATE TABLE commit, and the right FILE writes files with INTO OUTFILE. Both: one
statement, a time limit that nothing in it can lift, rows fetched as they are asked for.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

from semdb.database import readonly_sqlite, sqlite_file
from semdb.database.engine import make_engine, parse_url, safe_url, sqlite_path
from semdb.database.statement import check_hidden, check_limits, check_reads
from semdb.errors import SchemaError, UsageError
from semdb.settings import Settings
from semdb.shown import number

Row = tuple[Any, ...]
_READ_GRACE_S = 10


def run_readonly(
    settings: Settings, sql: str, *, private: bool = False
) -> tuple[tuple[str, ...], Generator[Row, None, None]]:
    """The column names and the rows of one read-only statement; close the iterator to end it early.

    With `private` nothing is told of where files lie: such columns are null, and of a server their tables are refused.
    Decimals of a server (its sums) come as int where they are whole, as float where one holds them, as on SQLite.
    Raises UsageError when it is no SELECT, locks what it reads, lifts its limits, or the account is not set,
    DatabaseError when the database refuses it, its account may do more than read, or the time limit of
    `sql_time_limit_s` is over (also while rows are fetched).
    """
    file, limit_s, too_slow = file_of(settings), settings.sql_time_limit_s, _too_slow(settings)
    _check_statement(sql, server=file is None, private=private)
    if file is None:
        rows = _server(settings, sql)
    else:
        rows = readonly_sqlite.rows_of(file, sql, limit_s, too_slow, private=private)
    columns = next(rows)  # connects and runs the statement
    return tuple(str(name) for name in columns), rows


def _check_statement(sql: str, *, server: bool, private: bool) -> None:
    check_reads(sql)
    if server:
        check_hidden(sql, private=private)
        check_limits(sql)


def file_of(settings: Settings) -> Path | None:
    """The SQLite file to ask, links followed; None for a server. Raises SchemaError where there is no such file."""
    url = parse_url(settings.database_url)
    path = sqlite_path(url)
    if path is not None and not path.exists():
        raise SchemaError(f"there is no database {safe_url(url)}: run `semdb init` or `semdb ingest` first")
    return None if path is None else sqlite_file.real_path(path)


def _server(settings: Settings, sql: str) -> Generator[Row, None, None]:
    from semdb.database import readonly_server

    if not settings.reader_url:
        raise UsageError(_no_reader(settings))
    # A little more than the other limits, which give the better message.
    engine = make_engine(settings.reader_url, read_timeout_s=int(settings.sql_time_limit_s) + _READ_GRACE_S)
    try:
        if engine.dialect.name == "sqlite":
            raise UsageError("SEMDB_READER_URL names a SQLite file, but SEMDB_DATABASE_URL a server")
        yield from readonly_server.rows_of(engine, sql, settings.sql_time_limit_s, _too_slow(settings))
    finally:
        engine.dispose()


def _no_reader(settings: Settings) -> str:
    url = parse_url(settings.database_url).set(username="ADMIN", password="PASSWORD", query={})
    return (
        "on a server statements run as an account that may only read, which SEMDB_READER_URL names; it is not set. "
        "This makes such an account and prints the URL to set, ADMIN being one that may create accounts: "
        f"semdb init --reader --execute --database-url {url.render_as_string(hide_password=False)}"
    )


def _too_slow(settings: Settings) -> str:
    return (
        f"the statement took longer than {number(settings.sql_time_limit_s)} s and was ended: "
        "narrow it, or raise SEMDB_SQL_TIME_LIMIT_S"
    )
