"""One SELECT of a user on a SQLite file: opened to be read, run in a process of its own, leaving nothing behind.

The other side is `_sqlite_child`. A file in WAL mode needs files beside it while it is open, and a connection that only
reads does not take them away: left behind by another user, they would lock the owner out. So the owner's process holds
a connection of its own until the end, which does; where another user asks, and nobody has the file open, it is read as
it is and looked at again in the end.
"""

from __future__ import annotations

import contextlib
import json
import marshal
import os
import select
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

from semdb.database import sqlite_file
from semdb.database.sqlite_file import Opening
from semdb.database.statement import HIDDEN, PRIVATE
from semdb.errors import DatabaseError, SemdbError, UsageError

Row = tuple[Any, ...]
MEMORY = 2**30  # bytes of the process, half of them SQLite's
TEMPORARY = 4 * 2**30  # bytes of a temporary file, which large sorts need
LONGEST_VALUE = 128 * 2**20  # bytes
GRACE_S = 1.0  # after its own limit the process is ended
_SELF_DESTRUCTION_S = 10.0  # and so long after it ends itself, where nobody is left who could
_PROGRAM = Path(__file__).with_name("_sqlite_child.py")
_LENGTH = struct.Struct("<I")


def rows_of(
    path: Path, sql: str, limit_s: float, too_slow: str, *, private: bool = False
) -> Generator[Row, None, None]:
    """The names of the columns, then the rows; close it to end the statement early. `path` as `real_path` gives it.

    Raises UsageError for a statement without rows, DatabaseError when it is refused or over a limit (`too_slow`: what
    is said of the time).
    """
    with contextlib.ExitStack() as stack:
        opening = stack.enter_context(_opened(path))
        before = sqlite_file.state_of(path)
        query = "immutable=1" if opening is Opening.IMMUTABLE else "mode=ro"
        request = {
            "uri": f"{path.absolute().as_uri()}?{query}",
            "sql": sql,
            "hidden": [*HIDDEN, "sqlite_dbpage"],
            "private": PRIVATE if private else {},
            "seconds": limit_s,
            "grace": GRACE_S + _SELF_DESTRUCTION_S,
            "memory": MEMORY,
            "temporary": TEMPORARY,
            "longest": LONGEST_VALUE,
        }
        process = stack.enter_context(_child(request))
        for kind, *content in _messages(process, time.monotonic() + limit_s + GRACE_S, too_slow):
            if kind == "columns":
                yield tuple(content[0])
            elif kind == "rows":
                yield from content[0]
            elif kind == "error":
                raise _error(content[0], content[1], too_slow)
        if opening is Opening.IMMUTABLE and sqlite_file.state_of(path) != before:
            raise DatabaseError(
                f"the database {path} was changed while it was read, and rows may be wrong: run the statement again"
            )


def read_own(path: Path, sql: str) -> list[Row]:
    """The rows of a statement of ours, which ends soon, in this process. Raises DatabaseError."""
    try:
        with (
            _opened(path) as opening,
            contextlib.closing(sqlite_file.connect(path, opening, timeout_s=10)) as connection,
        ):
            return connection.execute(sql).fetchall()
    except sqlite3.Error as error:
        raise _refused(str(error)) from error


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Opening]:
    """How a file is to be opened to be read, so that in the end nothing is left beside it that was not there."""
    opening = sqlite_file.opening_of(path)
    with contextlib.ExitStack() as stack:
        if opening is Opening.WRITE:
            opening = _reading(path)
            if opening is Opening.READ and _is_own(path):
                stack.enter_context(_kept_open(path))
        yield opening


def _reading(path: Path) -> Opening:
    """How a file that could be written is read."""
    beside = [path.with_name(path.name + ending) for ending in ("-wal", "-shm")]
    return Opening.READ if _is_own(path) or all(file.exists() for file in beside) else Opening.IMMUTABLE


def _is_own(path: Path) -> bool:
    return os.geteuid() in (0, path.stat().st_uid)  # SQLite gives files that root makes to the owner


@contextlib.contextmanager
def _kept_open(path: Path) -> Iterator[None]:
    """A connection that may write, on which nothing is run: the last one that may takes the files away."""
    try:
        connection = sqlite_file.connect(path, Opening.WRITE, timeout_s=10)
    except sqlite3.Error as error:
        raise _refused(str(error)) from error
    try:
        connection.execute("SELECT COUNT(*) FROM sqlite_master")
        yield
    except sqlite3.Error as error:
        raise _refused(str(error)) from error
    finally:
        connection.close()


@contextlib.contextmanager
def _child(request: dict[str, Any]) -> Iterator[subprocess.Popen[bytes]]:
    """The process, ended in the end."""
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", str(_PROGRAM)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for us
    )
    try:
        with contextlib.suppress(BrokenPipeError), process.stdin or contextlib.nullcontext() as stdin:
            if stdin is not None:
                stdin.write(json.dumps(request).encode())
        yield process
    finally:
        process.kill()
        if process.stdout is not None:
            process.stdout.close()
        process.wait()


def _messages(process: subprocess.Popen[bytes], deadline: float, too_slow: str) -> Iterator[tuple[Any, ...]]:
    """What the process sends, but for its end. Raises DatabaseError when it sends nothing more before it."""
    assert process.stdout is not None
    source = process.stdout.fileno()
    while True:
        (length,) = _LENGTH.unpack(_read(process, source, _LENGTH.size, deadline, too_slow))
        message: tuple[Any, ...] = marshal.loads(_read(process, source, length, deadline, too_slow))
        if message[0] == "end":
            return
        yield message


def _read(process: subprocess.Popen[bytes], source: int, size: int, deadline: float, too_slow: str) -> bytes:
    data = bytearray()
    while len(data) < size:
        if not select.select([source], [], [], max(0.0, deadline - time.monotonic()))[0]:
            raise DatabaseError(too_slow)
        piece = os.read(source, min(size - len(data), 2**20))
        if not piece:
            code = process.wait()
            if time.monotonic() >= deadline:
                raise DatabaseError(too_slow)
            raise DatabaseError(
                f"the statement ended its process ({code}), which has {MEMORY // 2**20} MiB of memory: narrow it"
            )
        data += piece
    return bytes(data)


def _error(kind: str, text: str, too_slow: str) -> SemdbError:
    if kind == "no rows":
        return UsageError("the statement gives no rows")
    if kind == "slow":
        return DatabaseError(too_slow)
    if kind == "memory":
        return DatabaseError(f"the statement needs more than its {MEMORY // 2**20} MiB of memory: narrow it")
    return _refused(text)


def _refused(text: str) -> DatabaseError:
    return DatabaseError(f"the database refused the statement: {text}")
