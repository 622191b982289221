"""The coarse step in SQL: the reference that the index in memory is compared with."""

from __future__ import annotations

import time
from collections.abc import Collection

import numpy as np

from semdb.class_score import ClassQuery
from semdb.database.store import Store
from semdb.localization.changes import ChangeReader, SameEncoder, summary_of
from semdb.localization.coarse import CoarseSource, MapChange, Ranked, Scored
from semdb.localization.ranking import best_first, exact_cosines
from semdb.types import Float32Array, FloatArray, Int64Array


class SqlSource:
    """Asks the database for every query. Threads may share it where one of them at a time refreshes it."""

    def __init__(self, store: Store, map_id: int) -> None:
        self._store = store
        self._map_id = map_id
        self._changes = ChangeReader(store, map_id)
        self._encoder = SameEncoder(store, map_id)
        self._count: int | None = None
        self._completed = False
        self._frequencies: dict[str, int] = {}

    def refresh(self) -> MapChange:
        """Nothing is kept here but numbers of keyframes, of all and by class, and whether landmarks complete these.

        What others keep may be out of date.
        """
        if self._count is None:
            self._changes.skip()
            self._encoder.check(changed=True)
            self._count = self._store.keyframe_count(self._map_id)
            self._completed = self._store.completion_of(self._map_id) is not None
            return MapChange()
        change = summary_of(self._changes.read())
        self._encoder.check(bool(change))
        if change:
            self._count = self._store.keyframe_count(self._map_id)
            self._completed = self._store.completion_of(self._map_id) is not None
            self._frequencies = {}
        return change

    def keyframe_count(self) -> int:
        if self._count is None:
            self.refresh()
        return self._count or 0

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        known = self._frequencies  # another thread's refresh puts another one in its place
        unknown = [name for name in categories if name not in known]
        if unknown:
            found = self._store.document_frequencies(self._map_id, unknown)
            known.update((name, found.get(name, 0)) for name in unknown)
        return {name: known[name] for name in categories}

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        found = self._store.class_filter(self._map_id, query, minimum_share, at_most, self._completed)
        ids = np.array([keyframe.keyframe_id for keyframe in found], np.int64)
        return Scored(ids, np.array([keyframe.class_score for keyframe in found], np.float64))

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        ids, vectors = self._store.vectors_there(
            keyframe_ids, len(vector), self._store.left_out, self._encoder.model_id
        )
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
        for ids, vectors in self._store.iter_vectors(
            self._map_id, size=len(vector), bad=self._store.left_out, in_turn=True
        ):
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


class TimedSource:
    """A source for one query that adds up the time of the class filter."""

    def __init__(self, source: CoarseSource) -> None:
        self._source = source
        self.refresh = source.refresh
        self.keyframe_count = source.keyframe_count
        self.cosines = source.cosines
        self.nearest = source.nearest
        self.filter_ms = 0.0

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        started = time.perf_counter()
        found = self._source.document_frequencies(categories)
        self.filter_ms += 1000 * (time.perf_counter() - started)
        return found

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        started = time.perf_counter()
        found = self._source.filtered(query, minimum_share, at_most)
        self.filter_ms += 1000 * (time.perf_counter() - started)
        return found
