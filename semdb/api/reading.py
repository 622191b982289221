"""What is there: maps, recordings, keyframes, rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from semdb.api.answers import StoredContent, keyframe_of
from semdb.api.base import Base
from semdb.database.records import FailedItem, MapInfo, RecordingStatus, Refinement
from semdb.door.values import Keyframe, Rows
from semdb.errors import NotFoundError, UsageError
from semdb.names import storable

if TYPE_CHECKING:
    from datetime import datetime

    from semdb.database.landmark_reading import StoredLandmark
    from semdb.database.reporting import WorkerStatus
    from semdb.door.changed import Changes
    from semdb.door.found import Found
    from semdb.door.links import KeyframeLink
    from semdb.localization.query_image import PathText
    from semdb.types import ModelInfo


@dataclass(frozen=True, slots=True)
class Status:
    """The recordings of a map, or of all, the keyframes of them that failed, and what `refine` has computed."""

    url: str  # without its password
    recordings: tuple[RecordingStatus, ...]
    failed: tuple[FailedItem, ...]
    refinements: tuple[Refinement, ...]


class Reading(Base):
    """Looks at what a database holds."""

    def maps(self) -> list[MapInfo]:
        """All maps with how many recordings and keyframes they have, by id."""
        return self._store().maps()

    def map(self, name: str) -> MapInfo:
        """The map of that name. Raises NotFoundError, which names the maps there are."""
        return self._store().find_map(name)

    def models(self, map: str) -> tuple[ModelInfo, ...]:
        """The detector, encoder and features that describe a map; empty for an empty one. Raises NotFoundError."""
        return self._head(map).models

    def recordings(self, map: str | None = None) -> list[RecordingStatus]:
        """The recordings of a map, or of all, with what is planned and stored. Raises NotFoundError."""
        return self._store().status(self._map_id(map))

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
        return keyframe_of(self._store().keyframe_heads_of([keyframe_id])[0], StoredContent(self._store))

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

        Or those with certain `ids`, by id. Raises NotFoundError, UsageError for neither or both.
        """
        store, content = self._store(), StoredContent(self._store)
        if (map is None) == (ids is None):
            raise UsageError("keyframes are those of a map= or those with certain ids=: say which")
        if ids is not None:
            return [keyframe_of(head, content) for head in store.keyframe_heads_of(sorted({int(key) for key in ids}))]
        map_id = self._head(str(map)).id
        recording_id = None if recording is None else store.find_recording(map_id, recording)
        heads = store.keyframe_heads(map_id, recording_id, after=after, limit=limit, bad=store.left_out)
        return [keyframe_of(head, content) for head in heads]

    def check_keyframes(self, ids: Iterable[int]) -> None:
        """Raises NotFoundError, naming it, for a keyframe that is not there; damaged ones are."""
        self._store().check_keyframes([int(key) for key in ids])

    def loops(
        self,
        map: str | None = None,
        *,
        odometry: bool = False,
        after: tuple[int, int, str] | None = None,
        limit: int | None = None,
    ) -> list[KeyframeLink]:
        """What ties keyframes of a map, or of all, together: closures, and with `odometry` what follows each other.

        By the ids of both keyframes and kind, with `limit` so many of those after such a key. A damaged row is left
        out aloud. Raises NotFoundError.
        """
        from semdb.api.links import links_of

        return links_of(self._store(), self._map_id(map), odometry=odometry, after=after, limit=limit)

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
        """Landmarks of a class, or of what a word means, the best first: where they are and from where they are seen.

        They may have to stand `near` or `on` something, or `not_near` it, and to have been seen after a time (also in
        nanoseconds), or in the recording of that name. The nearer to `origin` (X, Y, Z) the better. Where there is no
        hit, `missing` says why. Raises UsageError for words that mean nothing, NotFoundError, and ModelError where
        `SEMDB_WORDS` names no network for words.
        """
        from semdb.api.finding import find

        return find(
            *(self._store(), what),
            near=near,
            on=on,
            not_near=not_near,
            map=map,
            seen_after=seen_after,
            origin=origin,
            limit=limit,
            vectors=self._here.words,
        )

    def changes(self, before: str, after: str, map: str | None = None) -> Changes:
        """What appeared, disappeared and moved from one recording of a map to another one, and what both say of each
        landmark.

        `map` is needed where several have both. Raises UsageError, NotFoundError also where there are no landmarks.
        """
        from semdb.api.changing import changes_of

        return changes_of(self._store(), before, after, map)

    def plot_changes(self, found: Changes, folder: PathText) -> list[Path]:
        """Draws the map from above with what changed, as ``MAP-changes.png``, and the crops before and after, as
        ``MAP-crops.png``. Returns the files. Raises UsageError for a folder that cannot be written.
        """
        from semdb.api.plotting import plot_changes

        return plot_changes(self._store(), found, Path(folder))

    def landmarks(
        self,
        map: str,
        *,
        category: str | None = None,
        state: str | None = None,
        after: int = 0,
        limit: int | None = None,
    ) -> list[StoredLandmark]:
        """The landmarks of a map by id, those of a class and state, `limit` of those after an id.

        Raises NotFoundError, CodecError for a damaged row.
        """
        from semdb.database.landmark_reading import list_landmarks

        store = self._store()
        of_map = store.find_map(map).id
        return list_landmarks(store.engine, of_map, category=category, state=state, after=after, limit=limit)

    def plot_found(self, found: Found, folder: PathText) -> list[Path]:
        """Draws the maps of the hits from above, the hits in red, as ``MAP-landmarks.png``. Returns the files.

        Raises UsageError for a folder that cannot be written.
        """
        from semdb.api.plotting import plot_found

        return plot_found(self._store(), found, Path(folder))

    def sql(self, statement: str, *, private: bool = False) -> Rows:
        """The rows of one read-only statement, fetched while they are iterated over.

        On a server it runs as the account of ``SEMDB_READER_URL``. Raises UsageError for what is no query,
        DatabaseError where the database refuses it or the time limit ``SEMDB_SQL_TIME_LIMIT_S`` is over, also while
        rows are fetched. With `private` nothing is told of where files lie: such columns are null, and of a server
        their tables are refused.
        """
        from semdb.database.catalogue import ask

        self._here.check_open()
        return Rows(*ask(self.settings, statement, private=private))

    def tables(self) -> dict[str, tuple[str, ...]]:
        """The columns of each table and view that `sql` can ask. Raises what `sql` raises."""
        from semdb.database.catalogue import tables_and_columns

        self._here.check_open()
        return tables_and_columns(self.settings)

    def status(self, map: str | None = None) -> Status:
        """The recordings of a map, or of all, what failed of them, and what `refine` has computed."""
        store = self._store()
        recordings = store.status(self._map_id(map))
        known = {recording.recording_id for recording in recordings}
        failed = [item for item in store.failed_items() if item.recording_id in known]
        return Status(store.url, tuple(recordings), tuple(failed), tuple(store.refinements()))

    def workers(self) -> list[WorkerStatus]:
        """Who works on keyframes now, by name."""
        from semdb.database.reporting import workers

        return workers(self._store().engine)

    def unsent(self) -> int:
        """How many planned keyframes wait for which no message to workers is known to be on its way."""
        from semdb.database.items import unsent

        return unsent(self._store().engine)
