"""semdb: a visual semantic database of indoor places.

``semdb.open(url)`` gives a `Database`: recordings become rows, images become camera poses. See docs/python.md.
"""

from __future__ import annotations

TYPE_CHECKING = False  # as of typing, which takes longer to import than all of this
if TYPE_CHECKING:
    from collections.abc import Callable
    from os import PathLike
    from typing import Any

    from semdb.api import Answer, Database, Keyframe, Rows, Seen, SeenObject, SemanticDatabase
    from semdb.client import AsyncDatabase, RemoteDatabase
    from semdb.errors import SemdbError
    from semdb.recordings.memory import make_frame
    from semdb.recordings.options import ReadOptions
    from semdb.types import Camera, Frame, InstanceMasks, Verdict

__version__ = "0.1.0"

# name -> module; imported when it is first asked for, so that `import semdb` is instant
_LAZY = {
    "Answer": "semdb.api",
    "AsyncDatabase": "semdb.client",
    "Camera": "semdb.types",
    "Database": "semdb.api",
    "Frame": "semdb.types",
    "InstanceMasks": "semdb.types",
    "Keyframe": "semdb.api",
    "ReadOptions": "semdb.recordings.options",
    "RemoteDatabase": "semdb.client",
    "Rows": "semdb.api",
    "Seen": "semdb.api",
    "SeenObject": "semdb.api",
    "SemanticDatabase": "semdb.api",
    "SemdbError": "semdb.errors",
    "Verdict": "semdb.types",
    "make_frame": "semdb.recordings.memory",
}
__all__ = [
    "Answer",
    "AsyncDatabase",
    "Camera",
    "Database",
    "Frame",
    "InstanceMasks",
    "Keyframe",
    "ReadOptions",
    "RemoteDatabase",
    "Rows",
    "Seen",
    "SeenObject",
    "SemanticDatabase",
    "SemdbError",
    "Verdict",
    "connect",
    "connect_async",
    "make_frame",
    "open",
]


def open(
    url: str | PathLike[str] | None = None, *, say: Callable[[str], None] | None = None, **settings: object
) -> Database:
    """The database at `url`: ``sqlite:///FILE`` or ``mysql+pymysql://USER:PASSWORD@HOST/SCHEMA``.

    Without `url` it is that of ``SEMDB_DATABASE_URL``. Other `settings` (`detector`, `encoder`, `features`, `device`,
    `threads`, ...: docs/settings.md) win over their environment variables. `say` is told, a line each, what was assumed
    where nothing was said. A SQLite file that is not there is made by the first ingest.

    Raises UsageError for a URL or setting that makes no sense, DatabaseError where the database does not answer,
    SchemaError for a schema that is missing on a server, older or newer.
    """
    from semdb.api import open_database

    return open_database(url, say=say, **settings)


def connect(
    url: str,
    *,
    token: str | None = None,
    timeout_s: float = 60.0,
    retries: int = 5,
    patience_s: float = 60.0,
    say: Callable[[str], None] | None = None,
) -> RemoteDatabase:
    """The database of the service (``semdb serve``) at `url`, as ``http://HOST:8765``: the interface of `open`.

    Without `token` it is that of ``SEMDB_TOKEN``, or the one in the file of ``SEMDB_TOKEN_FILE``. A request without an
    answer for `timeout_s` is given up; what can be asked twice is asked again, up to `retries` times and within
    `patience_s`. Connects when it is first asked. docs/python.md says what it takes.

    Raises UsageError for an address or token that is none, and where httpx is not installed (``semdb[client]``).
    """
    from semdb.client import connect as connecting

    return connecting(url, token=token, timeout_s=timeout_s, retries=retries, patience_s=patience_s, say=say)


def connect_async(
    url: str,
    *,
    token: str | None = None,
    timeout_s: float = 60.0,
    retries: int = 5,
    patience_s: float = 60.0,
    say: Callable[[str], None] | None = None,
) -> AsyncDatabase:
    """As `connect`, with coroutines: ``async with semdb.connect_async(url) as db: await db.localize(image)``."""
    return connect(url, token=token, timeout_s=timeout_s, retries=retries, patience_s=patience_s, say=say).aio


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
