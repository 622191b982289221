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
    from semdb.errors import SemdbError
    from semdb.recordings.memory import make_frame
    from semdb.recordings.options import ReadOptions
    from semdb.types import Camera, Frame, InstanceMasks, Verdict

__version__ = "0.1.0"

# name -> module; imported when it is first asked for, so that `import semdb` is instant
_LAZY = {
    "Answer": "semdb.api",
    "Camera": "semdb.types",
    "Database": "semdb.api",
    "Frame": "semdb.types",
    "InstanceMasks": "semdb.types",
    "Keyframe": "semdb.api",
    "ReadOptions": "semdb.recordings.options",
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
    "Camera",
    "Database",
    "Frame",
    "InstanceMasks",
    "Keyframe",
    "ReadOptions",
    "Rows",
    "Seen",
    "SeenObject",
    "SemanticDatabase",
    "SemdbError",
    "Verdict",
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


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
