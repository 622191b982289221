"""One SELECT of a user, which cannot change anything: the database itself refuses whatever else it is.

SQLite: the file is opened with ``mode=ro``, and an authorizer allows SELECT, reading columns and functions only, so
no ATTACH (which creates files), no PRAGMA and no writing. Server: the account of ``SEMDB_READER_URL``, refused when
its grants are more than SELECT: a read-only transaction alone still lets CREATE TABLE commit, and the right FILE
writes files with INTO OUTFILE. Both: one statement, a time limit, rows fetched as they are asked for.
"""

from __future__ import annotations

import re
import sqlite3
import time
from collections.abc import Generator
from decimal import Decimal
from typing import Any

from sqlalchemy import Engine
from sqlalchemy.exc import SQLAlchemyError

from semdb.database import retry
from semdb.database.engine import make_engine, parse_url, safe_url, sqlite_path
from semdb.errors import DatabaseError, SchemaError, UsageError
from semdb.settings import Settings
from semdb.shown import number

Row = tuple[Any, ...]
FETCH = 500
_LONGEST_VALUE = 256 * 2**20  # bytes, against randomblob() and the like
_FIRST_WORDS = ("SELECT", "WITH", "EXPLAIN", "VALUES", "SHOW", "DESCRIBE", "DESC", "TABLE")
_COMMENT = re.compile(r"\s+|--[^\n]*(?:\n|$)|#[^\n]*(?:\n|$)|/\*(?!M?!).*?\*/", re.DOTALL)
_ALLOWED_GRANTS = {"USAGE", "SELECT", "SHOW VIEW"}
_ALLOWED_ACTIONS = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
_DENIED_FUNCTIONS = {"load_extension", "fts3_tokenizer"}


def run_readonly(settings: Settings, sql: str) -> tuple[tuple[str, ...], Generator[Row, None, None]]:
    """The column names and the rows of one read-only statement; close the iterator to end it early.

    Decimals of a server (its sums) come as int where they are whole, as float where one holds them, as on SQLite.
    Raises UsageError when it is no SELECT or the account is not set, DatabaseError when the database refuses it, its
    account may do more than read, or the time limit of `sql_time_limit_s` is over (also while rows are fetched).
    """
    _check_statement(sql)
    url = parse_url(settings.database_url)
    path = sqlite_path(url)
    rows = _sqlite(settings, sql) if path is not None else _server(settings, sql)
    columns = next(rows)  # connects and runs the statement
    return tuple(str(name) for name in columns), rows


def _check_statement(sql: str) -> None:
    """A clear message for what is obviously no query; what holds is what the database enforces."""
    rest = sql
    while (match := _COMMENT.match(rest)) is not None:
        rest = rest[match.end() :]
    word = re.match(r"[A-Za-z]+", rest.lstrip("( \n\t"))
    if word is None or word.group().upper() not in _FIRST_WORDS:
        raise UsageError(f"only queries can be run here ({', '.join(_FIRST_WORDS[:2])} ...), not {rest[:40]!r}")


def _sqlite(settings: Settings, sql: str) -> Generator[Row, None, None]:
    path = sqlite_path(parse_url(settings.database_url))
    if path is None or not path.exists():
        raise SchemaError(f"there is no database {settings.database_url}: run `semdb init` or `semdb ingest` first")
    deadline = time.monotonic() + settings.sql_time_limit_s
    connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=10, check_same_thread=False)
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE)
        connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        connection.execute("PRAGMA query_only = ON")
        connection.set_authorizer(_authorize)
        connection.set_progress_handler(lambda: int(time.monotonic() > deadline), 10_000)
        cursor = connection.execute(sql)
        if cursor.description is None:
            raise UsageError("the statement gives no rows")
        yield tuple(column[0] for column in cursor.description)
        while rows := cursor.fetchmany(FETCH):
            yield from rows
    except sqlite3.Error as error:
        if "interrupted" in str(error):
            if time.monotonic() < deadline:  # Ctrl-C, which sqlite3 does not pass on
                raise KeyboardInterrupt from error
            raise _too_slow(settings) from error
        raise DatabaseError(f"the database refused the statement: {error}") from error
    finally:
        connection.close()


def _authorize(action: int, first: str | None, second: str | None, *_: str | None) -> int:
    if action not in _ALLOWED_ACTIONS:
        return sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_FUNCTION and (second or "").lower() in _DENIED_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return sqlite3.SQLITE_OK


def _too_slow(settings: Settings) -> DatabaseError:
    return DatabaseError(
        f"the statement took longer than {number(settings.sql_time_limit_s)} s and was ended: "
        "narrow it, or raise SEMDB_SQL_TIME_LIMIT_S"
    )


def _no_reader(settings: Settings) -> str:
    url = parse_url(settings.database_url).set(username="ADMIN", password="PASSWORD", query={})
    return (
        "on a server statements run as an account that may only read, which SEMDB_READER_URL names; it is not set. "
        "This makes such an account and prints the URL to set, ADMIN being one that may create accounts: "
        f"semdb init --reader --execute --database-url {url.render_as_string(hide_password=False)}"
    )


def _server(settings: Settings, sql: str) -> Generator[Row, None, None]:
    if not settings.reader_url:
        raise UsageError(_no_reader(settings))
    # A little more than the server's own limit, which gives the better message.
    engine = make_engine(settings.reader_url, read_timeout_s=int(settings.sql_time_limit_s) + 10)
    try:
        if engine.dialect.name == "sqlite":
            raise UsageError("SEMDB_READER_URL names a SQLite file, but SEMDB_DATABASE_URL a server")
        yield from _server_rows(engine, settings, sql)
    finally:
        engine.dispose()


def _server_rows(engine: Engine, settings: Settings, sql: str) -> Generator[Row, None, None]:
    import pymysql
    from pymysql.cursors import SSCursor

    try:
        pooled = engine.raw_connection()
    except (SQLAlchemyError, pymysql.err.MySQLError) as error:  # the pool passes the driver's own errors on
        raise retry.explain(engine, error, setting="SEMDB_READER_URL") from error
    connection = pooled.driver_connection
    try:
        _prepare(connection, settings.sql_time_limit_s, safe_url(engine.url))
        cursor = connection.cursor(SSCursor)  # type: ignore[union-attr]
        cursor.execute(sql)
        if cursor.description is None:
            raise UsageError("the statement gives no rows")
        yield tuple(column[0] for column in cursor.description)
        while rows := cursor.fetchmany(FETCH):
            yield from (tuple(map(_plain, row)) for row in rows)
    except pymysql.err.MySQLError as error:
        code = error.args[0] if error.args else None
        if code in (1969, 3024, 2013):  # MariaDB's and MySQL's own limits; the driver's
            raise _too_slow(settings) from error
        raise DatabaseError(f"the database refused the statement: {error}") from error
    finally:
        # The driver reads the rest of a result before it closes, which may be hours of rows: close at once instead.
        result = getattr(connection, "_result", None)
        if result is not None:
            result.unbuffered_active = False
        pooled.invalidate()
        pooled.close()


def _prepare(connection: Any, limit_s: float, where: str) -> None:
    """Check the account, set the time limit, begin a read-only transaction."""
    with connection.cursor() as cursor:
        cursor.execute("SHOW GRANTS")
        extra = sorted({right for (grant,) in cursor.fetchall() for right in excess_rights(str(grant))})
        if extra:
            raise DatabaseError(
                f"the account of SEMDB_READER_URL ({where}) may do more than read ({', '.join(extra)}): "
                "use one with SELECT alone; `semdb init --accounts` prints the statements that make one"
            )
        cursor.execute("SHOW VARIABLES WHERE Variable_name IN ('max_statement_time', 'max_execution_time')")
        names = {name for name, _ in cursor.fetchall()}
        if "max_statement_time" in names:  # MariaDB, seconds
            cursor.execute(f"SET SESSION max_statement_time = {limit_s:.3f}")
        elif "max_execution_time" in names:  # MySQL, milliseconds
            cursor.execute(f"SET SESSION max_execution_time = {max(1, round(limit_s * 1000))}")
        else:
            raise DatabaseError(f"the server of {where} has no time limit for statements")
        cursor.execute("START TRANSACTION READ ONLY")


def excess_rights(grant: str) -> list[str]:
    """What a line of SHOW GRANTS gives beside reading."""
    match = re.match(r"GRANT (.+?) ON (?:TABLE )?(\S+) TO ", grant)
    if match is None:
        return [re.sub(r" TO .*", "", grant.removeprefix("GRANT ")) + " (a role or proxy)"]
    rights = [right.strip().upper() for right in re.sub(r"\([^)]*\)", "", match.group(1)).split(",")]
    extra = [right for right in rights if right not in _ALLOWED_GRANTS]
    if re.search(r" WITH .*GRANT OPTION", grant):
        extra.append("GRANT OPTION")
    return extra


def _plain(value: Any) -> Any:
    """A decimal as int or float where that is the same number; else as it is, with all its digits."""
    if not isinstance(value, Decimal):
        return value
    if value == value.to_integral_value():
        return int(value)
    return float(value) if Decimal(repr(float(value))) == value else value
