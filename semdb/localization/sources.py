"""Where the coarse step reads from: SQL, which is the reference, or a mirror of one map in memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from semdb.database.class_filter import class_weight
from semdb.database.store import Store
from semdb.types import Float32Array, IntArray

# Change ids commit out of order: how far behind the newest one a late one may still turn up.
OVERLAP = 1000


class SqlSource:
    """Asks the database for every query."""

    def __init__(self, store: Store, map_id: int) -> None:
        self._store = store
        self._map_id = map_id
        self._seen: list[int] | None = None

    def refresh(self) -> bool:
        """Nothing is kept here, but what others keep of the map is out of date when its keyframes are others."""
        ids = self._store.keyframe_ids(self._map_id)
        changed = self._seen is not None and ids != self._seen
        self._seen = ids
        return changed

    def keyframe_ids(self) -> Sequence[int]:
        return self._store.keyframe_ids(self._map_id)

    def class_scores(self, counts: Mapping[str, float]) -> dict[int, float]:
        return {k.keyframe_id: k.class_score for k in self._store.class_scores(self._map_id, counts)}

    def filtered(self, counts: Mapping[str, float], minimum_share: float) -> dict[int, float]:
        return {k.keyframe_id: k.class_score for k in self._store.class_filter(self._map_id, counts, minimum_share)}

    def vectors(self, keyframe_ids: Sequence[int]) -> Float32Array:
        return self._store.load_vectors(keyframe_ids)


class MemorySource:
    """A mirror of one map: counts per class and keyframe, and all vectors. Gives what `SqlSource` gives.

    `refresh` rereads the map when the change log says that it changed, by this or any other process.
    """

    def __init__(self, store: Store, map_id: int) -> None:
        self._store = store
        self._map_id = map_id
        self._seen: set[int] = set()
        self._newest = 0
        self._ids: list[int] = []
        self._position: dict[int, int] = {}
        self._counts: IntArray = np.zeros((0, 0), np.int32)  # [classes, keyframes]
        self._classes: dict[str, int] = {}
        self._vectors: Float32Array = np.zeros((0, 0), np.float32)
        if not self.refresh():
            self._load()

    def refresh(self) -> bool:
        """Rereads the map if it changed since the last call; whether it did."""
        changes = self._store.changes_since(self._map_id, max(0, self._newest - OVERLAP))
        ids = {change.id for change in changes}
        new = ids - self._seen
        self._newest = max([self._newest, *ids])
        self._seen = {i for i in self._seen | ids if i > self._newest - 2 * OVERLAP}
        if new:
            self._load()
        return bool(new)

    def _load(self) -> None:
        self._ids = list(self._store.keyframe_ids(self._map_id))
        self._position = {keyframe_id: p for p, keyframe_id in enumerate(self._ids)}
        rows = [row for row in self._store.category_counts(self._map_id) if row[0] in self._position]
        self._classes = {name: p for p, name in enumerate(sorted({row[1] for row in rows}))}
        self._counts = np.zeros((len(self._classes), len(self._ids)), np.int32)
        for keyframe_id, name, count in rows:
            self._counts[self._classes[name], self._position[keyframe_id]] += count
        self._vectors = self._store.load_vectors(self._ids)

    def keyframe_ids(self) -> Sequence[int]:
        return self._ids

    def class_scores(self, counts: Mapping[str, float]) -> dict[int, float]:
        return self.filtered(counts, 0.0)

    def filtered(self, counts: Mapping[str, float], minimum_share: float) -> dict[int, float]:
        """The same integer arithmetic as the SQL, so the same scores to the last bit."""
        shared = np.zeros(len(self._ids), np.int64)
        total = 0
        for name in sorted(name for name, count in counts.items() if count > 0):
            row = self._classes.get(name)
            held = np.zeros(len(self._ids), np.int32) if row is None else self._counts[row]
            weight = class_weight(row, counts[name], len(self._ids), int(np.count_nonzero(held)))
            total += weight.full
            enough = held >= math.ceil(weight.wanted)
            shared += np.where(enough, weight.full, weight.per_object * held.astype(np.int64))
        least = max(1, math.ceil(minimum_share * total - 1e-6))
        return {self._ids[p]: int(shared[p]) / total for p in np.flatnonzero(shared >= least)}

    def vectors(self, keyframe_ids: Sequence[int]) -> Float32Array:
        rows = [self._position[i] for i in keyframe_ids]
        return self._vectors[rows]
