"""What is there: maps, recordings, keyframes, things, rows."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from semdb.client.content import RemoteContent
from semdb.client.transport import Transport, segment
from semdb.errors import DatabaseError, NotFoundError, UsageError
from semdb.names import storable

if TYPE_CHECKING:
    from semdb.database.records import MapInfo, RecordingStatus
    from semdb.door.changed import Changes
    from semdb.door.found import Found
    from semdb.door.links import KeyframeLink
    from semdb.door.values import Keyframe, Rows
    from semdb.types import ModelInfo

Say = Callable[[str], None]
PAGE = 1000
MOST_HITS = 1000
_LOG = logging.getLogger("semdb")


class Reading:
    """Looks at what the database behind a service holds."""

    def __init__(self, transport: Transport, *, say: Say | None = None) -> None:
        self._transport = transport
        self._content = RemoteContent(transport)
        self._say: Say = say or _LOG.warning

    @property
    def url(self) -> str:
        """The address of the service."""
        return self._transport.url

    def check(self) -> None:
        """Asks for something now. Raises DatabaseError."""
        self._get("/v1/maps", limit=1)

    def maps(self) -> list[MapInfo]:
        """All maps that the token may see, with how many recordings and keyframes they have, by id."""
        from semdb.client.values import map_of

        return [map_of(one) for one in self._pages("/v1/maps")]

    def map(self, name: str) -> MapInfo:
        """The map of that name. Raises NotFoundError."""
        from semdb.client.values import map_of

        return map_of(self._get(f"/v1/maps/{segment(name)}"))

    def models(self, map: str) -> tuple[ModelInfo, ...]:
        """The detector, encoder and features that describe a map; empty for an empty one. Raises NotFoundError."""
        from semdb.client.values import model_of

        return tuple(model_of(one) for one in self._get(f"/v1/maps/{segment(map)}")["models"])

    def recordings(self, map: str | None = None) -> list[RecordingStatus]:
        """The recordings of a map, or of all, with what is planned and stored. Raises NotFoundError."""
        from semdb.client.values import recording_of

        return [recording_of(one) for one in self._pages("/v1/recordings", map=map)]

    def recording(self, name: str, map: str | None = None) -> RecordingStatus:
        """The recording of that name. Raises NotFoundError, UsageError where several maps have one."""
        everything = self.recordings(map)
        found = [recording for recording in everything if recording.name == storable(name)]
        if not found:
            names = ", ".join(sorted({recording.name for recording in everything})) or "none"
            raise NotFoundError(f"there is no recording {name!r} in {self.url}; recordings: {names}")
        if len(found) > 1:
            maps = ", ".join(recording.map for recording in found)
            raise UsageError(f"the maps {maps} each have a recording {name!r}: say which with --map")
        return found[0]

    def keyframe(self, keyframe_id: int) -> Keyframe:
        """The keyframe with that id. Raises NotFoundError."""
        from semdb.client.values import keyframe_of

        return keyframe_of(self._get(f"/v1/keyframes/{key_of(keyframe_id)}"), self._content)

    def keyframes(
        self,
        map: str | None = None,
        recording: str | None = None,
        *,
        ids: Iterable[int] | None = None,
        after: int = 0,
        limit: int | None = None,
    ) -> list[Keyframe]:
        """The keyframes of a map, or of a recording of it, by id; at most `limit` of those after the id `after`.

        Or those with certain `ids`, by id. What is large of them is asked for when it is looked at. Raises
        NotFoundError, UsageError for neither or both.
        """
        from semdb.client.values import keyframe_of

        if (map is None) == (ids is None):
            raise UsageError("keyframes are those of a map= or those with certain ids=: say which")
        if ids is not None:
            return [self.keyframe(key) for key in sorted({int(key) for key in ids})]
        path = f"/v1/maps/{segment(map)}/keyframes"
        found = self._pages(path, limit, recording=recording, after=max(0, int(after)))
        return [keyframe_of(one, self._content) for one in found]

    def loops(
        self,
        map: str | None = None,
        *,
        odometry: bool = False,
        after: tuple[int, int, str] | None = None,
        limit: int | None = None,
    ) -> list[KeyframeLink]:
        """What ties keyframes of a map, or of all, together: closures, and with `odometry` what follows each other.

        By the ids of both keyframes and kind, with `limit` so many of those after such a key. Raises NotFoundError.
        """
        from semdb.client.values import link_of

        names = [info.name for info in self.maps()] if map is None else [map]
        asked: dict[str, Any] = {
            "odometry": odometry or None,
            "after": None if after is None else "-".join(str(part) for part in after),
        }
        found = [
            link_of(one) for name in names for one in self._pages(f"/v1/maps/{segment(name)}/loops", limit, **asked)
        ]
        found.sort(key=lambda one: (one.keyframe, one.other_keyframe, one.kind))
        return found if limit is None else found[:limit]

    def find(
        self,
        what: str,
        *,
        near: str | None = None,
        on: str | None = None,
        not_near: str | None = None,
        map: str | None = None,
        seen_after: str | int | datetime | None = None,
        origin: Sequence[float] | None = None,
        limit: int = 10,
    ) -> Found:
        """Landmarks of a class, or of what a word means, the best first: see `semdb.api.Database.find`.

        Raises UsageError for words that mean nothing, NotFoundError.
        """
        from semdb.client.values import found_of

        if not 1 <= limit <= MOST_HITS:
            raise UsageError(f"limit is between 1 and {MOST_HITS}, not {limit}")
        if isinstance(seen_after, datetime):
            seen_after = seen_after.isoformat()
        elif isinstance(seen_after, int):
            seen_after = f"{max(0, seen_after):019d}"  # of so many digits it is nanoseconds
        place = {} if origin is None else dict(zip("xyz", three(origin), strict=True))
        given = {"near": near, "on": on, "not_near": not_near, "map": map, "seen_after": seen_after}
        return found_of(self._get("/v1/find", what=what, limit=limit, **given, **place))

    def changes(self, before: str, after: str, map: str | None = None) -> Changes:
        """What appeared, disappeared and moved from one recording of a map to another one.

        `map` is needed where several have both. Raises UsageError, NotFoundError.
        """
        from semdb.client.values import changes_of

        name = map if map is not None else self.recording(before).map
        return changes_of(self._get(f"/v1/maps/{segment(name)}/changes", before=before, after=after))

    def sql(self, statement: str) -> Rows:
        """The rows of one read-only statement. Bytes are hex and times ISO 8601, as JSON has them.

        Where the service leaves rows out, a DatabaseError says so after the last one that it gave. Raises UsageError
        for what is no query, DatabaseError.
        """
        from semdb.door.values import Rows

        found = self._get("/v1/sql", sql=statement, format="json")
        return Rows(tuple(found["columns"]), self._rows(found))

    def _rows(self, found: dict[str, Any]) -> Generator[tuple[Any, ...], None, None]:
        for row in found["rows"]:
            yield tuple(row)
        if found["truncated"]:
            raise DatabaseError(
                f"{self.url}: the service gives no more than these {len(found['rows'])} rows, and there are more: ask "
                "for less (LIMIT), or raise SEMDB_SERVE_SQL_ROWS and SEMDB_SERVE_SQL_MB there"
            )

    def tables(self) -> dict[str, tuple[str, ...]]:
        """The columns of each table and view that `sql` can ask."""
        return {name: tuple(columns) for name, columns in self._get("/v1/tables")["tables"].items()}

    def get(self, path: str, **parameters: Any) -> Any:
        """The JSON of any address of the service that begins with a slash: what no method here has.

        `parameters` are those of the query. Raises SemdbError.
        """
        return self._get(path, **parameters)

    def _get(self, path: str, **parameters: Any) -> Any:
        given = {name: _text(value) for name, value in parameters.items() if value is not None}
        return self._transport.json("GET", path, params=given)

    def _pages(self, path: str, limit: int | None = None, *, under: str = "items", **parameters: Any) -> Iterator[Any]:
        """The items of a list, page by page; `under` is what the answer calls them."""
        by = "before" if "before" in parameters else "after"  # lists with the newest first go backwards
        left, key = limit, parameters.pop(by, None)
        while left is None or left > 0:
            page = self._get(path, **parameters, **{by: key}, limit=PAGE if left is None else min(PAGE, left))
            yield from page[under]
            left = None if left is None else left - len(page[under])
            key = page["key"]
            if key is None:
                return
            by = "before" if "before" in parse_qs(urlsplit(str(page["next"])).query) else "after"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, float) else storable(str(value))


def key_of(keyframe_id: int) -> int:
    """The id of a keyframe. Raises NotFoundError for what can be none."""
    key = int(keyframe_id)
    if not 0 < key < 2**63:
        raise NotFoundError(f"there is no keyframe {key}")
    return key


def three(origin: Sequence[float]) -> tuple[float, float, float]:
    """A place. Raises UsageError for what is none."""
    if len(origin) != 3:
        raise UsageError(f"a place is three numbers in metres, X,Y,Z, not {origin}")
    x, y, z = (float(value) for value in origin)
    return x, y, z
