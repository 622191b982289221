"""What pages and services show of a map beside its rows: files as recorded, relations, coverage, the log of queries."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

from semdb.api.base import Base
from semdb.database.records import StoredImage
from semdb.errors import NotFoundError, UsageError
from semdb.names import storable

if TYPE_CHECKING:
    from semdb.database.landmark_reading import StoredRelation
    from semdb.database.query_log import LoggedQuery, QueryFilter
    from semdb.database.records import FailedItem
    from semdb.localization.coverage import Coverage


class Surveying(Base):
    """Looks at what a map covers and was asked."""

    def keyframe_files(self, keyframe_id: int) -> StoredImage:
        """The colour and depth files of a keyframe, bytes as recorded. Raises NotFoundError, CodecError."""
        return self._store().load_image(keyframe_id)

    def has_recording(self, name: str, map: str | None = None) -> bool:
        """Whether a map, or any, has a recording of that name, at the price of small queries. Raises NotFoundError."""
        store = self._store()
        heads = [self._head(map)] if map is not None else store.map_heads()
        for head in heads:
            with contextlib.suppress(NotFoundError):
                store.find_recording(head.id, storable(name))
                return True
        return False

    def relations(
        self,
        map: str,
        *,
        kind: str | None = None,
        landmark: int | None = None,
        after: tuple[int, int, str] | None = None,
        limit: int | None = None,
    ) -> list[StoredRelation]:
        """How the landmarks of a map stand to each other, or one to others, by both ids and kind.

        With `limit` so many of those after such a key. Raises NotFoundError.
        """
        from semdb.database.landmark_reading import list_relations

        of_map = self._head(map).id
        return list_relations(self._store().engine, of_map, kind=kind, landmark=landmark, after=after, limit=limit)

    def up(self, map: str) -> tuple[float, float, float] | None:
        """Which way is up in a map, a unit vector; None where nobody found out. Raises NotFoundError, CodecError."""
        from semdb.database.landmark_rows import load_gravity

        found = load_gravity(self._store().engine, self._head(map).id)
        return None if found is None else found.up

    def coverage(self, map: str, position: Sequence[float] | None = None, *, radius_m: float = 2.0) -> Coverage:
        """How many keyframes are within `radius_m` of a place (X, Y, Z in metres), or at all, and where they look.

        Raises NotFoundError, UsageError for a place or radius that is none.
        """
        import math

        import numpy as np

        from semdb.localization.coverage import coverage_of

        if position is not None and (len(position) != 3 or not all(is_coordinate(value) for value in position)):
            raise UsageError(f"a place is three numbers in metres, x, y, z, not {tuple(position)}")
        if not (math.isfinite(radius_m) and 0 < radius_m <= 1e4):
            raise UsageError(f"a radius is a number of metres between 0 and 10000, not {radius_m}")
        store, head = self._store(), self._head(map)
        ids, poses = store.poses(head.id, bad=store.left_out)
        place = None if position is None else (float(position[0]), float(position[1]), float(position[2]))
        return coverage_of(head.name, np.array(ids, np.int64), poses, place, float(radius_m))

    def title_keyframe(self, map: str) -> int | None:
        """The id of the keyframe that shows most classes of a map; None where it has none. Raises NotFoundError."""
        from semdb.database.lookups import title_keyframe

        return title_keyframe(self._store().engine, self._head(map).id)

    def failures(self, recording: str, map: str) -> list[FailedItem]:
        """The keyframes of a recording that could not be stored, and why. Raises NotFoundError."""
        store = self._store()
        return store.failed_items(store.find_recording(self._head(map).id, storable(recording)))

    def queries(
        self, map: str, *, before: int | None = None, limit: int = 100, wanted: QueryFilter | None = None
    ) -> list[LoggedQuery]:
        """What was localized in a map, the newest first; `before` the id of the last one that is known already.

        With `wanted` only what it asks for. Raises NotFoundError, UsageError for a limit that is none, CodecError for a
        damaged row.
        """
        from semdb.database.query_log import list_queries

        if not 1 <= limit <= 10_000:
            raise UsageError(f"limit is between 1 and 10000, not {limit}")
        return list_queries(self._store().engine, self._head(map).id, before=before, limit=limit, wanted=wanted)

    def query(self, query_id: int) -> tuple[str, LoggedQuery]:
        """A logged localization, and the name of its map. Raises NotFoundError, CodecError."""
        from semdb.database.query_log import find_query

        return find_query(self._store().engine, query_id)

    def forget_queries(self, older_than_s: int) -> int:
        """Deletes what was logged more than so many seconds ago, in all maps. Returns how many."""
        from semdb.database.query_log import forget_queries

        return forget_queries(self._store().engine, older_than_s)


def is_coordinate(value: float) -> bool:
    """Whether a coordinate can be one of a map."""
    return -1e7 < value < 1e7
