"""One SELECT of a user on a server: as an account that may only read, for a limited time, without locks.

Servers have time limits of their own, and hints of a statement may lift them; a client that goes away does not end
what it began. So a second connection ends the statement: when its time is over, and when its rows are not wanted any
more.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Generator
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import pymysql
from pymysql.cursors import SSCursor
from sqlalchemy import Engine
from sqlalchemy.exc import SQLAlchemyError

from semdb.database import retry
from semdb.database.engine import safe_url
from semdb.errors import DatabaseError, UsageError

Row = tuple[Any, ...]
GRACE_S = 1.0  # the server's own limit gives the better message
_ALLOWED_GRANTS = {"USAGE", "SELECT", "SHOW VIEW"}
# MariaDB's and MySQL's own limits; an interrupted statement, a killed connection.
_ENDED = {1969, 3024, 1317, 1927}
_LOST = {2006, 2013}
_SETTING = "SEMDB_READER_URL"


def rows_of(engine: Engine, sql: str, limit_s: float, too_slow: str) -> Generator[Row, None, None]:
    """The names of the columns, then the rows; close it to end the statement early.

    Raises UsageError for a statement without rows, DatabaseError when the account may do more than read, or the
    statement is refused or over its time (`too_slow`: what is said then).
    """
    try:
        pooled = engine.raw_connection()
    except (SQLAlchemyError, pymysql.err.MySQLError) as error:  # the pool passes the driver's own errors on
        raise retry.explain(engine, error, setting=_SETTING) from error
    connection: Any = pooled.driver_connection
    statement: _Statement | None = None
    try:
        _prepare(connection, limit_s, safe_url(engine.url))
        statement = _Statement(engine, *_identity(connection))
        statement.end_after(limit_s + GRACE_S)
        cursor = connection.cursor(SSCursor)
        cursor.execute(sql)
        if cursor.description is None:
            raise UsageError("the statement gives no rows")
        yield tuple(column[0] for column in cursor.description)
        while (row := cursor.fetchone()) is not None:  # one by one: some are as large as the server's packets
            yield tuple(map(_plain, row))
        statement.is_over()
    except pymysql.err.MySQLError as error:
        code = error.args[0] if error.args else None
        if statement is not None:
            if code not in _LOST:  # the server's word
                statement.is_over()
            statement.end()
            if code in _ENDED | _LOST:
                raise DatabaseError(too_slow + statement.doubt) from error
        raise DatabaseError(f"the database refused the statement: {error}") from error
    finally:
        if statement is not None:
            statement.end()
        # The driver reads the rest of a result before it closes, which may be hours of rows: close at once instead.
        result = getattr(connection, "_result", None)
        if result is not None:
            result.unbuffered_active = False
        pooled.invalidate()
        pooled.close()


@dataclass(slots=True)
class _Statement:
    """A statement that runs at a server: on which connection, of which server behind the address."""

    engine: Engine
    connection_id: int
    server: tuple[object, ...]
    doubt: str = ""  # for people, where it may still run
    _timer: threading.Timer | None = None
    _over: bool = False

    def end_after(self, seconds: float) -> None:
        self._timer = threading.Timer(seconds, self.end)
        self._timer.daemon = True
        self._timer.start()

    def is_over(self) -> None:
        """All its rows have come."""
        self._over = True

    def end(self) -> None:
        """Ends it, unless it is over, by a second connection."""
        if self._timer is not None:
            self._timer.cancel()
        if self._over:
            return
        self._over = True
        try:
            with (
                contextlib.closing(self.engine.raw_connection()) as other,
                contextlib.closing(other.cursor()) as cursor,
            ):
                cursor.execute("SELECT @@hostname, @@port")
                if tuple(cursor.fetchone() or ()) == self.server:  # a proxy may have led to another one
                    cursor.execute(f"KILL {self.connection_id}")
                    return
        except (SQLAlchemyError, pymysql.err.MySQLError) as error:
            if retry.error_code(error) in (1094, 1095):  # it has ended by itself
                return
        self.doubt = f" (it could not be ended at the server: its connection there is {self.connection_id})"


def _identity(connection: Any) -> tuple[int, tuple[object, ...]]:
    """The number of a connection, and which server it is on."""
    with connection.cursor() as cursor:
        cursor.execute("SELECT CONNECTION_ID(), @@hostname, @@port")
        number, *server = cursor.fetchone()
    return int(number), tuple(server)


def _prepare(connection: Any, limit_s: float, where: str) -> None:
    """Check the account, set the time limit, begin a read-only transaction."""
    with connection.cursor() as cursor:
        cursor.execute("SHOW GRANTS")
        extra = sorted({right for (grant,) in cursor.fetchall() for right in excess_rights(str(grant))})
        if extra:
            raise DatabaseError(
                f"the account of {_SETTING} ({where}) may do more than read ({', '.join(extra)}): "
                "use one with SELECT alone; `semdb init --accounts` prints the statements that make one"
            )
        _limit_time(cursor, limit_s, where)
        cursor.execute("START TRANSACTION READ ONLY")


def _limit_time(cursor: Any, limit_s: float, where: str) -> None:
    cursor.execute("SHOW VARIABLES WHERE Variable_name IN ('max_statement_time', 'max_execution_time')")
    names = {name for name, _ in cursor.fetchall()}
    if "max_statement_time" in names:  # MariaDB, seconds
        cursor.execute(f"SET SESSION max_statement_time = {limit_s:.3f}")
    elif "max_execution_time" in names:  # MySQL, milliseconds
        cursor.execute(f"SET SESSION max_execution_time = {max(1, round(limit_s * 1000))}")
    else:
        raise DatabaseError(f"the server of {where} has no time limit for statements")


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
