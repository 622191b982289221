"""Connections: one engine per URL, set up the same way on SQLite and on servers of the MySQL protocol."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any
from weakref import WeakSet

from sqlalchemy import URL, Connection, Engine, create_engine, event
from sqlalchemy.engine import ExceptionContext, make_url
from sqlalchemy.exc import ArgumentError, DisconnectionError

from semdb.database import sqlite_file
from semdb.database.blobs import BlobCursor
from semdb.database.hosts import HOSTS, Failover, is_left, join_hosts, split_hosts
from semdb.database.tls import TLS_KEYS, tls_arguments
from semdb.errors import UnstorableError, UsageError

CONNECT_TIMEOUT_S = 5
READ_TIMEOUT_S = 120  # more than the 50 s that a server lets a statement wait for a lock: that answer comes first
BUSY_TIMEOUT_MS = 30_000
WRITE = "semdb_write"  # execution option of transactions that may be run again (`retry`): whether they write
answered: WeakSet[Engine] = WeakSet()  # engines that have had a connection
_HINT = "use sqlite:///FILE or mysql+pymysql://USER:PASSWORD@HOST/SCHEMA"
# Seconds: a machine that is gone is noticed after a minute, also where a statement may take any time.
_KEEPALIVE = (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 3))
# What a server may have otherwise for all its connections, and what its statements and results depend on.
_SERVER_SETTINGS = {
    "time_zone": "'+00:00'",
    "sql_mode": "'STRICT_TRANS_TABLES,NO_ZERO_DATE,ERROR_FOR_DIVISION_BY_ZERO,NO_ENGINE_SUBSTITUTION'",
    "completion_type": "0",  # a connection goes on after COMMIT
    "default_storage_engine": "InnoDB",
    "foreign_key_checks": "1",  # deleting cascades
    "group_concat_max_len": "1024",  # joined ids are cut off there (`semdb.database.scanning`)
    "sql_auto_is_null": "0",
    "sql_big_selects": "1",
    "sql_quote_show_create": "1",
    "sql_safe_updates": "0",
    "sql_select_limit": "18446744073709551615",  # none
    "unique_checks": "1",
}


def parse_url(url: str) -> URL:
    """The URL, its driver made explicit. Raises UsageError for anything but SQLite files and MySQL servers.

    Several hosts (``HOST1:PORT1,HOST2:PORT2``) become the first one and the query parameter ``hosts``.
    """
    try:
        parsed = make_url(split_hosts(url))
    except (ArgumentError, ValueError):  # they may hold a part of the password
        raise UsageError(f"the database URL cannot be read; {_HINT}") from None
    backend = parsed.get_backend_name()
    if backend == "sqlite":
        return _parse_sqlite(url, parsed)
    if backend in ("mysql", "mariadb"):
        unknown = sorted(set(parsed.query) - TLS_KEYS - {HOSTS})
        if unknown:  # a misspelled ssl_mode must not connect without TLS
            known = ", ".join(sorted(TLS_KEYS))
            where = safe_url(parsed.difference_update_query(unknown))  # they may be passwords
            raise UsageError(f"the database URL {where} has a parameter {unknown[0]!r}; known are {known}")
        if not parsed.database:
            raise UsageError(f"the database URL {safe_url(parsed)} names no schema; {_HINT}")
        tls_arguments(parsed)
        return parsed.set(drivername="mysql+pymysql")
    raise UsageError(f"databases of the kind {backend!r} are not supported; {_HINT}")


def _parse_sqlite(url: str, parsed: URL) -> URL:
    """The URL of a file, ``~`` expanded. Raises UsageError for what names none."""
    hint = "use sqlite:///FILE, with a fourth slash for a path from the root"
    name = parsed.database or ""
    if parsed.host or parsed.username:
        raise UsageError(f"the database URL has a host, and SQLite knows none; {hint}")
    if "?" in url:
        raise UsageError(f"the database URL of {name!r} has parameters, and SQLite's have none; a ? of a name is %3F")
    if name in ("", ":memory:"):
        raise UsageError(f"a database in memory is not supported, it needs a file; {_HINT}")
    if "\0" in name:
        raise UsageError(f"the name of the database has a NUL in it; {hint}")
    return parsed.set(drivername="sqlite", database=os.path.expanduser(name))


def safe_url(url: URL) -> str:
    """The URL for messages, without the password."""
    if url.get_backend_name() == "sqlite":  # names of files may be no text, which URLs are
        return "sqlite:///" + (url.database or "").replace("%", "%25").replace("?", "%3F")
    return join_hosts(url.render_as_string(hide_password=True), url)


def make_engine(url: str, *, read_timeout_s: int | None = None) -> Engine:
    """An engine for `url`; see `make_server_engine`. Connects only when used.

    Raises UsageError for a URL that cannot be used.
    """
    parsed = parse_url(url)
    if parsed.get_backend_name() == "sqlite":
        return _sqlite_engine(parsed)
    return make_server_engine(parsed, read_timeout_s)


def _sqlite_engine(url: URL) -> Engine:
    engine = create_engine(url)
    path = sqlite_file.real_path(Path(url.database or ""))
    opened: sqlite_file.FileState | None = None

    @event.listens_for(engine, "do_connect")
    def _connect(_dialect: Any, _record: Any, _arguments: Any, _parameters: Any) -> sqlite_file.FileConnection:
        if opened is not None:
            sqlite_file.check_same(path, opened)
        return sqlite_file.connect(path, sqlite_file.opening_of(path), timeout_s=BUSY_TIMEOUT_MS / 1000)

    @event.listens_for(engine, "connect")
    def _configure(connection: sqlite_file.FileConnection, _record: Any) -> None:
        nonlocal opened
        connection.text_factory = _as_text
        connection.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}")
        connection.execute("PRAGMA foreign_keys = ON")
        if connection.opening in (sqlite_file.Opening.CREATE, sqlite_file.Opening.WRITE):
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
        if connection.state is None:  # it was made by that
            connection.state = sqlite_file.state_of(path)
        opened = opened or connection.state

    @event.listens_for(engine, "checkout")
    def _lent(connection: sqlite_file.FileConnection, _record: Any, _proxy: Any) -> None:
        if not connection.check():
            raise DisconnectionError(f"{path} has changed")  # the pool opens it anew

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # A transaction that reads first and writes later could not wait for another writer: it fails at once.
        writes = connection.get_execution_options().get(WRITE, False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


def _as_text(data: bytes) -> str:
    """Text of a column; what is no UTF-8 is found, and told, where the value is looked at."""
    return data.decode("utf-8", "surrogateescape")


def make_server_engine(url: URL, read_timeout_s: int | None = None) -> Engine:
    """An engine for a server; its URL may leave out the schema.

    A server that says nothing for so long is given up, as one that closed the connection: when it is asked to connect,
    or whether a connection is still good, CONNECT_TIMEOUT_S; within a transaction that may be run again,
    READ_TIMEOUT_S; else `read_timeout_s`, by default never, since a change of tables takes as long as it takes.
    """
    # The driver's limit for connecting ends before the greeting: one that never comes needs the limit for reading.
    limits = dict.fromkeys(("connect_timeout", "read_timeout", "write_timeout"), CONNECT_TIMEOUT_S)
    engine = create_engine(
        url,
        connect_args={**limits, "charset": "utf8mb4", "cursorclass": BlobCursor, **tls_arguments(url)},
        pool_pre_ping=True,
        pool_recycle=3600,
        isolation_level="REPEATABLE READ",
    )
    failover = Failover(url)

    @event.listens_for(engine, "do_connect")
    def _connect(dialect: Any, _record: Any, _arguments: Any, parameters: dict[str, Any]) -> Any:
        for name in set(parameters) & (TLS_KEYS | {HOSTS, "ssl"}):
            del parameters[name]  # what the dialect made of the URL's query
        return failover.connect(dialect, {**parameters, **tls_arguments(url)})

    # Before SQLAlchemy looks at the modes, for which it would quote names.
    event.listen(engine, "connect", _configure_server, insert=True)

    @event.listens_for(engine, "connect", insert=True)
    def _greeted(_connection: Any, _record: Any) -> None:
        answered.add(engine)  # it has let us in: a connection that is lost from here on may be made again

    event.listen(engine, "handle_error", _leave_node)
    _limit_waiting(engine, read_timeout_s)
    return engine


def _configure_server(connection: Any, record: Any) -> None:
    for name, value in _KEEPALIVE:
        if hasattr(socket, name):  # not on every system
            connection._sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
    with connection.cursor() as cursor:
        cursor.execute("SET " + ", ".join(f"SESSION {name} = {value}" for name, value in _SERVER_SETTINGS.items()))
        names = "'wsrep_sync_wait', 'group_replication_consistency', 'read_only', 'max_allowed_packet'"
        cursor.execute(f"SHOW SESSION VARIABLES WHERE Variable_name IN ({names})")
        variables = dict(cursor.fetchall())
        # Reads see what this cluster has committed: here, or before this node was elected.
        if "wsrep_sync_wait" in variables:
            cursor.execute("SET SESSION wsrep_sync_wait = 1")
        if variables.get("group_replication_consistency") in ("EVENTUAL", "BEFORE_ON_PRIMARY_FAILOVER"):
            level = "BEFORE" if variables.get("read_only") == "ON" else "BEFORE_ON_PRIMARY_FAILOVER"
            cursor.execute(f"SET SESSION group_replication_consistency = '{level}'")
        record.info["max_allowed_packet"] = connection.semdb_packet = int(variables["max_allowed_packet"])


def _leave_node(context: ExceptionContext) -> None:
    """All connections to a node that is of no use now are given up, whatever else is in hand; see `hosts`."""
    arguments = context.original_exception.args
    if len(arguments) > 1 and is_left(arguments[0], str(arguments[1])):
        context.is_disconnect = True


def _limit_waiting(engine: Engine, read_timeout_s: int | None) -> None:
    """How long the driver waits for a server, by what the connection is used for; see `make_server_engine`."""

    @event.listens_for(engine, "checkout")
    def _lent(connection: Any, _record: Any, _proxy: Any) -> None:
        _set_limit(connection, read_timeout_s)

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        if WRITE in connection.get_execution_options():
            _set_limit(connection.connection.driver_connection, READ_TIMEOUT_S)

    @event.listens_for(engine, "checkin")
    def _given_back(connection: Any, _record: Any) -> None:
        if connection is not None:  # it is asked whether it is still good before it is lent again
            _set_limit(connection, CONNECT_TIMEOUT_S)


def _set_limit(connection: Any, seconds: int | None) -> None:
    # The driver has no public name for it. Sending has a limit too: a server that hangs reads nothing either.
    connection._read_timeout = connection._write_timeout = seconds


def check_packet(connection: Connection, size: int, what: str) -> None:
    """Raises UnstorableError when a statement with `size` bytes of values is more than the server takes."""
    limit = connection.info.get("max_allowed_packet")
    if limit is not None and size > limit:
        raise UnstorableError(
            f"{what} needs a statement of {size} bytes, and the server takes {limit}: "
            f"raise max_allowed_packet on the server (SET GLOBAL max_allowed_packet = {_next_power(size)})"
        )


def _next_power(size: int) -> int:
    return 1 << (size - 1).bit_length()


def sqlite_path(url: URL) -> Path | None:
    """The file of a SQLite URL, None for a server."""
    return Path(url.database or "") if url.get_backend_name() == "sqlite" else None
