"""Where the coarse step asks: SQL, which is the reference, or a mirror of one map in memory."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from semdb.class_score import ClassQuery
from semdb.database.records import Change, ChangeKind, ChangeMark
from semdb.database.store import Store
from semdb.localization.coarse import MapChange, Ranked, Scored
from semdb.localization.ranking import best_first, exact_cosines
from semdb.types import Float32Array, FloatArray, Int64Array

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
        self._newest = 0
        self._mark = NOTHING
        self._seen: frozenset[int] = frozenset()

    def skip(self) -> None:
        """What the log holds now counts as seen."""
        self._newest = self._store.change_mark(self._map_id, 0).newest
        self._mark, self._seen = NOTHING, frozenset()
        self.read()

    def read(self) -> list[Change] | None:
        """Changes that were not seen before, ascending; each is told once.

        None when the newest that was seen is not there any more: the log was cut off, or is another database's.
        """
        since = max(0, self._newest - self._overlap)
        mark = self._store.change_mark(self._map_id, since)
        if mark == self._mark:
            return []
        if mark.newest < self._newest:
            self.skip()
            return None
        changes = self._store.changes_since(self._map_id, since)
        new = [change for change in changes if change.id not in self._seen]
        self._newest = max([self._newest, *(change.id for change in changes)])
        since = max(0, self._newest - self._overlap)
        self._seen = frozenset(change.id for change in changes if change.id > since)
        self._mark = ChangeMark(max(self._seen, default=0), len(self._seen), sum(self._seen))
        return new


def summary_of(changes: list[Change] | None) -> MapChange:
    """Changes as sets of keyframes. One that was added and then deleted is only gone."""
    if changes is None:
        return MapChange(everything=True)
    gone = frozenset(change.keyframe_id for change in changes if change.kind is not ChangeKind.ADDED)
    added = frozenset(change.keyframe_id for change in changes if change.kind is ChangeKind.ADDED)
    return MapChange(added - gone, gone)


class SqlSource:
    """Asks the database for every query."""

    def __init__(self, store: Store, map_id: int) -> None:
        self._store = store
        self._map_id = map_id
        self._changes = ChangeReader(store, map_id)
        self._count: int | None = None

    def refresh(self) -> MapChange:
        """Nothing is kept here but the number of keyframes; what others keep may be out of date."""
        if self._count is None:
            self._changes.skip()
            self._count = self._store.keyframe_count(self._map_id)
            return MapChange()
        change = summary_of(self._changes.read())
        if change:
            self._count = self._store.keyframe_count(self._map_id)
        return change

    def keyframe_count(self) -> int:
        if self._count is None:
            self.refresh()
        return self._count or 0

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        return self._store.document_frequencies(self._map_id, categories)

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        found = self._store.class_filter(self._map_id, query, minimum_share, at_most)
        ids = np.array([keyframe.keyframe_id for keyframe in found], np.int64)
        return Scored(ids, np.array([keyframe.class_score for keyframe in found], np.float64))

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        ids, vectors = self._store.vectors_there(keyframe_ids)
        result = np.full(len(keyframe_ids), np.nan)
        if len(ids):
            place = np.minimum(np.searchsorted(ids, keyframe_ids), len(ids) - 1)
            there = ids[place] == keyframe_ids
            result[there] = exact_cosines(vectors, place[there], vector)
        return result

    def nearest(self, vector: Float32Array, count: int, query: ClassQuery | None, class_weight: float) -> Ranked:
        """Reads all vectors of the map, a chunk at a time."""
        shared = self.filtered(query, 0.0, None) if query is not None else Scored(np.empty(0, np.int64), np.empty(0))
        known = dict(zip(shared.keyframe_ids.tolist(), shared.class_scores.tolist(), strict=True))
        best = Ranked(np.empty(0, np.int64), np.empty(0), np.empty(0))
        for ids, vectors in self._store.iter_vectors(self._map_id):
            scores = np.array([known.get(i, 0.0) for i in ids.tolist()])
            cosines = exact_cosines(vectors, np.arange(len(ids)), vector)
            both = Ranked(
                np.concatenate([best.keyframe_ids, ids]),
                np.concatenate([best.class_scores, scores]),
                np.concatenate([best.cosines, cosines]),
            )
            order = best_first(both.keyframe_ids, both.cosines + class_weight * both.class_scores, count)
            best = Ranked(both.keyframe_ids[order], both.class_scores[order], both.cosines[order])
        return best


class MemorySource:
    """A mirror of one map: counts per class and keyframe, and all vectors. Reread when the map changes."""

    def __init__(self, store: Store, map_id: int) -> None:
        self._store = store
        self._map_id = map_id
        self._changes = ChangeReader(store, map_id)
        self._changes.skip()
        self._load()

    def refresh(self) -> MapChange:
        change = summary_of(self._changes.read())
        if change:
            self._load()
        return change

    def _load(self) -> None:
        parts = list(self._store.iter_vectors(self._map_id))
        self._ids = np.concatenate([np.empty(0, np.int64), *(ids for ids, _ in parts)])
        self._vectors = np.concatenate([vectors for _, vectors in parts]) if parts else np.empty((0, 0), np.float32)
        self._counts: dict[str, FloatArray] = {}
        for keyframe_id, name, count in self._store.category_counts(self._map_id):
            row = self._counts.setdefault(name, np.zeros(len(self._ids)))
            row[np.searchsorted(self._ids, keyframe_id)] += count

    def keyframe_count(self) -> int:
        return len(self._ids)

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        return {name: int(np.count_nonzero(self._counts[name])) for name in categories if name in self._counts}

    def _shared(self, query: ClassQuery | None) -> FloatArray:
        shared = np.zeros(len(self._ids))
        for term in query.terms if query is not None else ():
            if term.category in self._counts:
                shared += np.minimum(term.full, term.per_object * self._counts[term.category])
        return shared

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        shared = self._shared(query)
        order = best_first(self._ids, np.where(shared >= query.least(minimum_share), shared, np.nan), at_most)
        return Scored(self._ids[order], shared[order] / query.total)

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        return exact_cosines(self._vectors, np.searchsorted(self._ids, keyframe_ids), vector)

    def nearest(self, vector: Float32Array, count: int, query: ClassQuery | None, class_weight: float) -> Ranked:
        cosines = exact_cosines(self._vectors, np.arange(len(self._ids)), vector)
        scores = self._shared(query) / (query.total if query is not None else 1)
        order = best_first(self._ids, cosines + class_weight * scores, count)
        return Ranked(self._ids[order], scores[order], cosines[order])
