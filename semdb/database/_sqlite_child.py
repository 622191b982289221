"""One statement on a SQLite file, in a process that can be stopped and has little memory.

Run by its path, by a Python without site packages (it starts in 20 ms), and never imported: `readonly_sqlite` is the
other side. A single call of a function may take as long, and as much memory, as it likes: SQLite asks between its own
steps only whether to go on. So what holds is that this process ends.

stdin: one JSON object. stdout: messages, each four bytes of length (little-endian) and `marshal`'s bytes of a tuple:
``("columns", names)``, ``("rows", rows)``, ``("end",)``, ``("error", kind, text)``.
"""

from __future__ import annotations

import contextlib
import json
import marshal
import resource
import signal
import sqlite3
import struct
import sys
import time
from typing import Any

_ALLOWED_ACTIONS = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_FUNCTION, sqlite3.SQLITE_RECURSIVE}
_DENIED_FUNCTIONS = {"load_extension", "fts3_tokenizer"}
_MESSAGE_ROWS, _MESSAGE_BYTES = 500, 2**20


def main() -> None:
    request = json.load(sys.stdin)
    _limit(resource.RLIMIT_AS, request["memory"])
    _limit(resource.RLIMIT_FSIZE, request["temporary"])
    _limit(resource.RLIMIT_CORE, 0)
    # The process that asked may have been killed; the default of this signal ends also what is in one call.
    signal.setitimer(signal.ITIMER_REAL, request["seconds"] + request["grace"])
    try:
        _run(request)
        _send(("end",))
    except BrokenPipeError:
        pass
    except MemoryError:
        _send(("error", "memory", ""))
    except (sqlite3.Error, sqlite3.Warning) as error:
        _send(("error", _kind(str(error)), str(error)))
    except (ValueError, OverflowError, TypeError) as error:  # of a statement that is no text
        _send(("error", "refused", str(error)))


def _kind(text: str) -> str:
    if "interrupted" in text:
        return "slow"
    return "memory" if "out of memory" in text else "refused"


def _limit(what: int, value: int) -> None:
    _, hard = resource.getrlimit(what)
    value = value if hard == resource.RLIM_INFINITY else min(value, hard)
    with contextlib.suppress(ValueError, OSError):  # a system that has no such limit
        resource.setrlimit(what, (value, hard))


def _run(request: dict[str, Any]) -> None:
    deadline = time.monotonic() + request["seconds"]
    connection = sqlite3.connect(request["uri"], uri=True, timeout=10, isolation_level=None)
    connection.text_factory = lambda data: data.decode("utf-8", "backslashreplace")
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, request["longest"])
    connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    connection.execute(f"PRAGMA hard_heap_limit = {request['memory'] // 2}")
    connection.execute("PRAGMA query_only = ON")
    connection.set_authorizer(lambda *asked: _authorize(request["hidden"], request["private"], *asked))
    connection.set_progress_handler(lambda: int(time.monotonic() > deadline), 10_000)
    cursor = connection.execute(request["sql"])
    if cursor.description is None:
        _send(("error", "no rows", ""))
        return
    _send(("columns", tuple(column[0] for column in cursor.description)))
    rows: list[tuple[Any, ...]] = []
    size = 0
    for row in cursor:
        rows.append(row)
        size += 16 * len(row) + sum(len(value) for value in row if isinstance(value, (str, bytes)))
        if len(rows) >= _MESSAGE_ROWS or size >= _MESSAGE_BYTES:
            _send(("rows", rows))
            rows, size = [], 0
    if rows:
        _send(("rows", rows))


def _authorize(
    hidden: list[str], private: dict[str, str], action: int, first: str | None, second: str | None, *_: str | None
) -> int:
    if action not in _ALLOWED_ACTIONS:
        return sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_READ:
        table, column = (first or "").lower(), (second or "").lower()
        if table in hidden:
            return sqlite3.SQLITE_DENY
        if private.get(table) == column:
            return sqlite3.SQLITE_IGNORE  # it is null
    if action == sqlite3.SQLITE_FUNCTION and (second or "").lower() in _DENIED_FUNCTIONS:
        return sqlite3.SQLITE_DENY
    return sqlite3.SQLITE_OK


def _send(message: tuple[Any, ...]) -> None:
    data = marshal.dumps(message)
    sys.stdout.buffer.write(struct.pack("<I", len(data)))
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()


main()
