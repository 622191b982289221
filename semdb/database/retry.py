"""The one place where a transaction is run, and run again when the database asks for it.

Retried with back-off: deadlock and failed certification (1213, 3101), lock timeout (1205), lost connection (2006, 2013,
4031, also when a server hangs and says nothing for `READ_TIMEOUT_S`; 2003 while a server that has answered before
restarts), a server that shuts down or has no connection left (1053, 1040), a node that is out of its cluster or takes
no writes any more (`hosts.is_left`), and a busy SQLite file. The work is given a fresh transaction each time, so it
must not keep anything from an earlier attempt; all writes of semdb are idempotent, so a commit whose answer was lost is
safe to repeat. What lasts longer is repeated by workers as whole tasks, by the same rules: `task_delay_s`.
"""

from __future__ import annotations

import random
import sqlite3
import struct
import time
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy import Connection, Engine
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError, OperationalError, SQLAlchemyError

from semdb.database.engine import WRITE, answered, safe_url
from semdb.database.hosts import HOSTS, is_left
from semdb.database.sqlite_file import FileConnection
from semdb.errors import DatabaseError, DatabaseUnavailableError, RecordingUnavailableError, UnstorableError

T = TypeVar("T")
_now = time.monotonic
listeners: list[Callable[[], None]] = []  # told of each transaction that is run again
ATTEMPTS = 10
FIRST_DELAY_S = 0.05
LONGEST_DELAY_S = 3.0
RESTART_S = 60.0  # so long a write waits for a server that has answered before, however often it was tried
RETRIED_CODES = frozenset({1213, 1205, 2006, 2013, 4031, 1047, 1040, 1053, 3032, 3100, 3101, 3796, 3797, 3798, 3799})
# What a task may meet and is worth repeating later.
MAY_HEAL = (DatabaseUnavailableError, RecordingUnavailableError)
FIRST_TASK_DELAY_S = 2.0
LONGEST_TASK_DELAY_S = 300.0
_NO_ROOM = {3, 28, 1021, 1026, 1114}
# Values that their column, a statement or the log of changes does not take: null, a row, packet, number, text or date.
_UNFIT = {1048, 1118, 1153, 1264, 1265, 1292, 1366, 1367, 1406}
# Nothing listens, no such host, access denied, no such schema: trying again does not help.
_UNREACHABLE = {2002, 2003, 2005}
_LOST = {2006, 2013, 4031}
LONGEST_REASON = 300  # characters of what a driver says
_DENIED = {1044, 1045, 1049, 1698, 1142, 1227}
_READ_ONLY = {1290, 1792, 1836}  # the server, the transactions that it begins, the schema
_LARGE_PACKET = 1153
_SEVERAL_PRIMARIES = 3098
_NO_TLS, _TLS_ONLY, _WRONG_ACCOUNT = 2026, 3159, 1045

_NO_ROOM_ADVICE = "cannot grow: its disk, or the room that it was given, is full; make room and run the command again"


def read(engine: Engine, work: Callable[[Connection], T]) -> T:
    """The result of `work` in one read transaction (a consistent snapshot). Raises DatabaseError."""
    return _run(engine, work, write=False)


def write(engine: Engine, work: Callable[[Connection], T]) -> T:
    """The result of `work` in one committed transaction. IntegrityError passes through; else DatabaseError."""
    return _run(engine, work, write=True)


def _run(engine: Engine, work: Callable[[Connection], T], *, write: bool) -> T:
    delay, attempt, gone_since = FIRST_DELAY_S, 0, None
    while True:
        attempt += 1
        try:
            return _once(engine, work, write=write)
        except IntegrityError as error:
            if error_code(error) != 1213:  # a certification failure may be reported on any statement
                raise
            failure: DBAPIError = error
        except DBAPIError as error:
            if not is_transient(error, answered=engine in answered, several=HOSTS in engine.url.query):
                raise explain(engine, error) from error
            failure = error
        except SQLAlchemyError as error:
            raise explain(engine, error) from error
        except (OverflowError, UnicodeError, struct.error) as error:  # of the driver, on writing down a value
            raise UnstorableError(f"the database {safe_url(engine.url)} cannot hold a value: {error}") from error
        gone_since = (gone_since or _now()) if _may_be_starting(failure) else None
        patient = write and gone_since is not None and _now() - gone_since < RESTART_S
        if attempt >= ATTEMPTS and not patient:
            raise explain(engine, failure, attempts=attempt) from failure
        for listener in listeners:
            listener()
        time.sleep(delay * random.uniform(0.5, 1.0))
        delay = min(delay * 2, LONGEST_DELAY_S)


def _once(engine: Engine, work: Callable[[Connection], T], *, write: bool) -> T:
    with engine.connect().execution_options(**{WRITE: write}) as connection:
        answered.add(engine)
        try:
            with connection.begin():
                found = work(connection)
            _check_untorn(connection)
            return found
        except DBAPIError:
            _check_untorn(connection)
            raise


def _check_untorn(connection: Connection) -> None:
    """Raises the error of a busy file when one that was read without locks has been changed meanwhile."""
    driver = connection.connection.driver_connection if not connection.invalidated else None
    if isinstance(driver, FileConnection) and driver.is_torn():
        reason = sqlite3.OperationalError(f"{driver.path} was changed while it was read")
        reason.sqlite_errorname = "SQLITE_BUSY_SNAPSHOT"
        raise OperationalError(None, None, reason)


def task_delay_s(retries: int) -> float:
    """Seconds before a task that met one of `MAY_HEAL` is run again, after so many `retries`."""
    return float(min(FIRST_TASK_DELAY_S * 2 ** min(retries, 16), LONGEST_TASK_DELAY_S) * random.uniform(0.5, 1.0))


def error_code(error: Exception) -> int | None:
    """The server's error number, of SQLAlchemy's errors and the driver's; None where there is none (SQLite)."""
    arguments = getattr(getattr(error, "orig", None) or error, "args", ())
    return arguments[0] if arguments and isinstance(arguments[0], int) else None


def is_transient(error: DBAPIError, *, answered: bool = True, several: bool = False) -> bool:
    """Whether the same transaction may succeed when it is run again.

    A server that cannot be reached is a wrong URL when it has never `answered`, and else one that restarts. One that
    takes no writes stays like this when it is the only one, and `several` elect one that does.
    """
    if _is_away(error):
        return answered
    return error_code(error) in RETRIED_CODES or is_busy(error) or (several and _is_left(error))


def _may_be_starting(error: DBAPIError) -> bool:
    """Whether the server is not there or not ready, as while it reads its log of changes again."""
    return _is_away(error) or _is_left(error)


def _is_left(error: DBAPIError) -> bool:
    return is_left(error_code(error), str(error.orig))


def _is_away(error: DBAPIError) -> bool:
    """Whether nobody answers at the other end."""
    code = error_code(error)
    if error.connection_invalidated and code in (None, 0):  # the driver's own word for a connection that is closed
        return True
    return code in _UNREACHABLE or code in _LOST


def is_busy(error: Exception) -> bool:
    """Whether a SQLite file is held by another connection."""
    # The base class names are the result codes; extended codes such as SQLITE_BUSY_SNAPSHOT start with them.
    name = getattr(getattr(error, "orig", None), "sqlite_errorname", "") or ""
    return name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED"))


def explain(
    engine: Engine, error: Exception, attempts: int = 1, *, setting: str = "SEMDB_DATABASE_URL"
) -> DatabaseError:
    """The error for people: which database, what it said, what to do. `setting` is where its URL came from."""
    reason = str(getattr(error, "orig", None) or error).splitlines()[0]
    code = error_code(error)
    name = getattr(getattr(error, "orig", None), "sqlite_errorname", "") or ""
    advice = _of_tls(engine, code, reason, setting) or _of_sqlite(name, setting)
    if advice is None:
        advice = _of_server(code, attempts, setting, answered=engine in answered)
    heals = is_busy(error) or code in _UNREACHABLE | _LOST | _NO_ROOM | RETRIED_CODES or name == "SQLITE_FULL"
    heals = heals or is_left(code, reason)
    unfit = isinstance(error, DataError) or code in _UNFIT or name in ("SQLITE_TOOBIG", "SQLITE_MISMATCH")
    kind = DatabaseUnavailableError if heals else UnstorableError if unfit else DatabaseError
    short = reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]}..."  # it may quote what was given
    return kind(f"the database {safe_url(engine.url)} {advice} ({short})")


def _of_tls(engine: Engine, code: int | None, reason: str, setting: str) -> str | None:
    """What to do about a connection that is not, or not as it has to be, encrypted; None for other errors."""
    if code == _NO_TLS:
        return f"has no TLS, and {setting} asks for it: set TLS up on the server, or change ssl_mode"
    if code in _UNREACHABLE | _LOST and "[SSL" in reason and "EOF" not in reason:  # EOF: the server has ended
        return (
            f"answers, but TLS failed: check that ssl_ca of {setting} is the certificate, or the authority, of this "
            "server, that its certificate is for this host and not out of date, and ssl_cert and ssl_key where given"
        )
    unencrypted = str(engine.url.query.get("ssl_mode", "")).upper() == "DISABLED"
    if code == _TLS_ONLY or (code == _WRONG_ACCOUNT and unencrypted):
        others = "" if code == _TLS_ONLY else f"check user and password of {setting}; or it "
        return f"refuses: {others}takes encrypted connections only: remove ssl_mode=DISABLED from {setting}"
    return None


def _of_sqlite(name: str, setting: str) -> str | None:
    """What to do about an error of SQLite of that `name`; None for others."""
    if name == "SQLITE_CANTOPEN":
        return "cannot be opened: check that its folder exists and can be written"
    if name == "SQLITE_NOTADB":
        return f"is not a database: check the path of {setting}"
    if name.startswith("SQLITE_CORRUPT"):
        return "is damaged: restore it from a backup, or delete the file and ingest again"
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return "is held by another process: wait for it or end it"
    if name.startswith("SQLITE_READONLY"):
        return "cannot be written: check the rights of the file, its folder and the files beside it, and its medium"
    if name.startswith("SQLITE_IOERR"):
        return "cannot be read or written as it has to be: check its disk (full, unplugged, a network share?)"
    return _NO_ROOM_ADVICE if name == "SQLITE_FULL" else None


def _of_server(code: int | None, attempts: int, setting: str, *, answered: bool) -> str:
    if code in _UNREACHABLE or (code in _LOST and not answered):
        return f"does not answer: check that the server runs and that host and port of {setting} are right"
    if code in _DENIED:
        return f"refuses: check user, password and schema of {setting}, and the account's rights"
    if code in _READ_ONLY:
        return f"takes no writes: give {setting} the server that does, or make this one writable"
    if code == _SEVERAL_PRIMARIES:
        return "takes no cascading foreign keys: run its group with one primary (group_replication_single_primary_mode)"
    if code == _LARGE_PACKET:
        return "takes no statement that large: raise max_allowed_packet on the server"
    if code in _NO_ROOM:
        return _NO_ROOM_ADVICE
    if code in RETRIED_CODES:
        return f"failed {attempts} times in a row: the server is down or overloaded; run the command again"
    return "refused a statement"
