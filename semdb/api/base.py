"""What all parts of the door stand on: settings, and what is in memory in this process."""

from __future__ import annotations

import logging
from collections.abc import Callable

from semdb.api.here import Here, forget_after_fork
from semdb.database.engine import parse_url, safe_url
from semdb.database.records import MapHead
from semdb.database.store import Store
from semdb.errors import NotFoundError
from semdb.settings import Settings

Say = Callable[[str], None]
_LOG = logging.getLogger("semdb")


class Base:
    """A database that is connected to when it is first asked for something."""

    def __init__(self, settings: Settings, *, say: Say | None = None) -> None:
        self.settings = settings
        self._say: Say = say or _LOG.warning
        self._here = Here(settings, self._say)
        forget_after_fork(self)

    def close(self) -> None:
        """Writes what indexes have not on disk yet, and lets go of connections and networks."""
        self._here.close()

    def check(self) -> None:
        """Connects now, and not when it is first asked for something. Raises DatabaseError, SchemaError."""
        self._store()

    @property
    def url(self) -> str:
        """The URL without its password."""
        return safe_url(parse_url(self.settings.database_url))

    def _store(self, *, create: bool = False) -> Store:
        return self._here.store(create=create)

    def _map_id(self, name: str | None) -> int | None:
        """Of a map that is there. Raises NotFoundError, which names the maps there are."""
        return None if name is None else self._head(name).id

    def _head(self, name: str) -> MapHead:
        for head in self._store().map_heads():
            if head.name == name:
                return head
        self._store().find_map(name)
        raise NotFoundError(f"the map {name!r} was deleted a moment ago")
