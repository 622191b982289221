"""The one door: a database of maps, recordings and keyframes that a program, a command or a service asks."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Self

from semdb.api.base import Say
from semdb.api.describing import Describing
from semdb.api.granting import Granting
from semdb.api.scenes import Viewing
from semdb.api.tracing import Tracing
from semdb.api.tracking import TrackingCameras
from semdb.api.working import Working
from semdb.api.writing import Writing
from semdb.database.engine import parse_url, sqlite_path
from semdb.settings import Settings, settings_with

if TYPE_CHECKING:
    from semdb.door.protocol import SemanticDatabase


class Database(Describing, Writing, Tracing, TrackingCameras, Viewing, Granting, Working):
    """A semantic database. Made by `semdb.open`; close it, or use it in a ``with``.

    Any number of threads may ask it at the same time. Networks, indexes and keyframes stay in memory from one call to
    the next, and follow what other processes do to the database. A process that is forked off has it too, with nothing
    in memory yet. `say` is told, a line each, what was assumed where nothing was said (default: the logger ``semdb``).
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<semdb database {self.url}>"


def open_database(url: str | PathLike[str] | None = None, *, say: Say | None = None, **settings: object) -> Database:
    """See `semdb.open`."""
    given = dict(settings) | ({} if url is None else {"database_url": str(url)})
    database = Database(settings_with(given), say=say)
    path = sqlite_path(parse_url(database.settings.database_url))
    if path is None or (path.exists() and path.stat().st_size):
        database.check()  # says now what would be wrong later
    return database


if TYPE_CHECKING:
    _: SemanticDatabase = Database(Settings())
