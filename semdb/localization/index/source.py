"""The coarse step from an index."""

from __future__ import annotations

from collections.abc import Collection

from semdb.class_score import ClassQuery
from semdb.localization.changes import SameEncoder
from semdb.localization.coarse import MapChange, Ranked, Scored
from semdb.localization.index.map_index import MapIndex
from semdb.types import Float32Array, FloatArray, Int64Array


class IndexSource:
    """What one thread sees of an index: one state of the map from one `refresh` to the next."""

    def __init__(self, index: MapIndex) -> None:
        self._index = index
        self._encoder = SameEncoder(index.store, index.map_id)
        self._version, self._state = index.current

    def refresh(self) -> MapChange:
        self._index.refresh()
        before, current = self._version, self._index.current
        self._encoder.check(current[0] != before)
        if current[0] == before:
            return MapChange()
        self._version, self._state = current
        return self._index.changes_between(before, self._version)

    def keyframe_count(self) -> int:
        return self._state.living

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        state = self._state
        return {name: int(state.frequencies[state.categories[name]]) for name in categories if name in state.categories}

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        return self._state.filtered(query, minimum_share, at_most)

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        return self._state.cosines(vector, keyframe_ids)

    def nearest(self, vector: Float32Array, count: int, query: ClassQuery | None, class_weight: float) -> Ranked:
        return self._state.nearest(vector, count, query, class_weight)
