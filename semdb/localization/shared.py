"""What a localizer reads, shared by threads: one cache of keyframes, and sources whose refreshes take turns."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection

from semdb.class_score import ClassQuery
from semdb.localization.coarse import CoarseSource, MapChange, Ranked, Scored
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.types import Float32Array, FloatArray, Int64Array


class SharedSource:
    """A source of the coarse step for any number of threads; each has one of `make`'s own, which may be the same.

    What a refresh finds is forgotten by `cache` before another thread may refresh: none goes on with what it has not
    been told is out of date.
    """

    def __init__(self, make: Callable[[], CoarseSource], cache: KeyframeCache) -> None:
        self._make = make
        self._cache = cache
        self._turn = threading.Lock()
        self._own = threading.local()

    def refresh(self) -> MapChange:
        """Nothing is left for the caller to forget."""
        with self._turn:
            change = self._source.refresh()
            if change:
                self._cache.forget(change)
        return MapChange()

    def keyframe_count(self) -> int:
        return self._source.keyframe_count()

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        return self._source.document_frequencies(categories)

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        return self._source.filtered(query, minimum_share, at_most)

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        return self._source.cosines(vector, keyframe_ids)

    def nearest(self, vector: Float32Array, count: int, query: ClassQuery | None, class_weight: float) -> Ranked:
        return self._source.nearest(vector, count, query, class_weight)

    @property
    def _source(self) -> CoarseSource:
        source: CoarseSource | None = getattr(self._own, "source", None)
        if source is None:
            source = self._own.source = self._make()
        return source
