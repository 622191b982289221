"""Following the log of changes of a map, whoever writes it."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from semdb.database.records import Change, ChangeKind, ChangeMark
from semdb.database.store import Store
from semdb.errors import ProvenanceError
from semdb.localization.coarse import MapChange

# Change ids commit out of order: how far behind the newest one a late one may still turn up.
OVERLAP = 1000
NOTHING = ChangeMark(0, 0, 0)


class ChangeReader:
    """Tells what the log of changes has that was not seen before, at the price of one small query when nothing has.

    Ids commit out of order, so it looks again at the last `overlap` ids before the newest that it has seen.
    """

    def __init__(self, store: Store, map_id: int, overlap: int = OVERLAP) -> None:
        self._store = store
        self._map_id = map_id
        self._overlap = overlap
        self._mark = NOTHING
        self.newest = 0
        self.seen: frozenset[int] = frozenset()  # the last `overlap` of them

    def restore(self, newest: int, seen: Collection[int]) -> None:
        """Goes on from what another reader had seen."""
        self.newest, self.seen, self._mark = newest, frozenset(seen), NOTHING

    def skip(self) -> None:
        """What the log holds now counts as seen."""
        self.restore(self._store.change_mark(self._map_id, 0).newest, ())
        self._note(self._store.change_ids_since(self._map_id, self._since()))

    def read(self) -> list[Change] | None:
        """Changes that were not seen before, ascending; each is told once.

        None when the newest that was seen is not there any more: the log was cut off, or is another database's.
        """
        if self._store.change_mark(self._map_id, self._since()) == self._mark:
            return []
        changes = self._store.changes_since(self._map_id, self._since())
        if self.newest and all(change.id != self.newest for change in changes):
            self.skip()
            return None
        new = [change for change in changes if change.id not in self.seen]
        self._note([change.id for change in changes])
        return new

    def _since(self) -> int:
        return max(0, self.newest - self._overlap)

    def _note(self, ids: Sequence[int]) -> None:
        self.newest = max([self.newest, *ids])
        since = self._since()
        self.seen = frozenset(number for number in ids if number > since)
        self._mark = ChangeMark(max(self.seen, default=0), len(self.seen), sum(self.seen))


class SameEncoder:
    """Whether a map is still asked by the vectors of the encoder that it had when this was made."""

    def __init__(self, store: Store, map_id: int) -> None:
        self._store = store
        self._map_id = map_id
        self.model_id = store.encoder_id(map_id)
        self._known = False

    def check(self, changed: bool) -> None:
        """Looks at first, where the map has `changed`, and after an error.

        Raises ProvenanceError where it is not: vectors of queries are compared with those of their own encoder. A map
        that was deleted has none, and no keyframe, which whoever asks it is told.
        """
        if self._known and not changed:
            return
        found = self._store.encoder_id(self._map_id)
        if self.model_id is None:
            self.model_id = found  # it was empty
        self._known = found in (None, self.model_id)
        if not self._known:
            raise ProvenanceError(
                f"map {self._map_id} was described anew by another encoder since it was opened: ask again, and it is "
                "opened as it is now"
            )


def summary_of(changes: Sequence[Change] | None) -> MapChange:
    """Changes as sets of keyframes. One that was added and then deleted is only gone."""
    if changes is None:
        return MapChange(everything=True)
    gone = frozenset(change.keyframe_id for change in changes if change.kind is not ChangeKind.ADDED)
    added = frozenset(change.keyframe_id for change in changes if change.kind is ChangeKind.ADDED)
    return MapChange(added - gone, gone)
