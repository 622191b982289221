"""A SQLite file where it lies: how it can be opened there, and whether it is still the file that was opened.

A file in WAL mode needs a log (``-wal``) and an index of it (``-shm``) beside it while it is open. On a medium, or with
rights, that allow neither they cannot be made, and SQLite reads such a file only when it is told that nobody changes it
("immutable"). That is what is done here, and since somebody may change it after all, what is known of the file is
compared again after each transaction.
"""

from __future__ import annotations

import os
import sqlite3
import stat
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from semdb.errors import DatabaseError, UsageError

_HEADER_BYTES = 20
_VERSIONS = slice(18, 20)  # of the header: 2 and 2 in WAL mode, else 1 and 1


class Opening(StrEnum):
    """How a file is opened; the values are SQLite's names, but for the last."""

    CREATE = "rwc"
    WRITE = "rw"
    READ = "ro"  # with locks, beside writers
    IMMUTABLE = "immutable"  # without locks, where SQLite could not make what they need


@dataclass(frozen=True, slots=True)
class FileState:
    """Which file it is, and what a change of its contents changes."""

    device: int
    inode: int
    size: int
    changed_ns: int
    log: int  # bytes of the -wal file, which an immutable file is read without

    def same_file(self, other: FileState) -> bool:
        return (self.device, self.inode) == (other.device, other.inode)


class FileConnection(sqlite3.Connection):
    """A connection that knows how its file was opened and which one it was."""

    path: Path
    opening: Opening
    state: FileState | None = None

    def is_torn(self) -> bool:
        """Whether a file that was taken for immutable has been changed since it was opened."""
        return self.opening is Opening.IMMUTABLE and self.state != state_of(self.path)

    def check(self) -> bool:
        """Whether it can be used on; False where another one must be opened.

        Raises DatabaseError when the file was deleted, or another one was put in its place.
        """
        if self.state is None:
            return True
        now = check_same(self.path, self.state)
        return self.opening is not Opening.IMMUTABLE or now == self.state


def check_same(path: Path, before: FileState) -> FileState:
    """What the file is now. Raises DatabaseError when it was deleted, or another one was put in its place."""
    now = state_of(path)
    if now is not None and now.same_file(before):
        return now
    what = "deleted" if now is None else "replaced by another file"
    raise DatabaseError(f"the database {path} was {what} while it was in use: start again")


def real_path(path: Path) -> Path:
    """Where the file is: SQLite puts the others beside what a link points to."""
    return Path(os.path.realpath(path))


def state_of(path: Path) -> FileState | None:
    """None where there is no file. Raises OSError."""
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return FileState(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, _size(_beside(path, "-wal")))


def opening_of(path: Path) -> Opening:
    """How the file at `path` (see `real_path`) can be opened by this process; CREATE where there is none.

    Raises UsageError for what is no file, DatabaseError where it cannot be read, or only without its latest changes.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return Opening.CREATE
    if stat.S_ISDIR(mode):
        raise UsageError(f"{path} is a folder: give a file in it, as sqlite:///{path / 'semdb.sqlite3'}")
    if not stat.S_ISREG(mode):
        raise UsageError(f"{path} is no regular file, so no database can be in it")
    if not _may(path, os.R_OK):
        raise DatabaseError(f"the database {path} cannot be read: check the rights of the file")
    wal, index = _beside(path, "-wal"), _beside(path, "-shm")
    in_use = [file for file in (wal, index) if file.exists()]
    if _may(path, os.W_OK) and _may(path.parent, os.W_OK | os.X_OK) and all(_may(file, os.W_OK) for file in in_use):
        return Opening.WRITE
    if _size(_beside(path, "-journal")):
        raise _unreadable(path, "a change that was not finished is in", "-journal")
    if not _in_wal_mode(path) or (wal.exists() and index.exists() and all(_may(file, os.R_OK) for file in in_use)):
        return Opening.READ
    if _size(wal):
        raise _unreadable(path, "its latest changes are in", "-wal")
    return Opening.IMMUTABLE


def connect(path: Path, opening: Opening, *, timeout_s: float) -> FileConnection:
    """Opens a file. Raises sqlite3.Error."""
    query = "immutable=1" if opening is Opening.IMMUTABLE else f"mode={opening.value}"
    before = state_of(path)
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{query}",
        uri=True,
        timeout=timeout_s,
        check_same_thread=False,
        isolation_level=None,  # the driver's own BEGIN leaves DDL and reads outside of transactions
        factory=FileConnection,
    )
    connection.path, connection.opening, connection.state = path, opening, before
    return connection


def how_it_is_read(path: Path) -> str | None:
    """For people, how a file that cannot be written is read; None for one that can be written. Raises as `opening_of`.

    `path` as in a URL.
    """
    real = real_path(path)
    opening = opening_of(real)
    if opening in (Opening.CREATE, Opening.WRITE):
        return None
    why = "its medium, or the rights of the file, its folder or the files beside it, allow no writing"
    return f"the database {path} is read only: {why}"


def _may(path: Path, what: int) -> bool:
    return os.access(path, what, effective_ids=os.access in os.supports_effective_ids)


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _in_wal_mode(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(_HEADER_BYTES)[_VERSIONS] == b"\2\2"


def _unreadable(path: Path, what: str, ending: str) -> DatabaseError:
    return DatabaseError(
        f"the database {path} cannot be read here: {what} {path.name}{ending}, which only who may write it can take "
        "in; run `semdb status` with such an account, or where the medium can be written, and copy it then"
    )
