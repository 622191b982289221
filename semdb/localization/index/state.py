"""One state of a map in memory: what queries read. States share arrays; what a state shows never changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.class_score import MOST_OBJECTS, ClassQuery
from semdb.localization.coarse import Ranked, Scored
from semdb.localization.index.kernels import ByteArray, CodeArray, best_rows, class_sums, scan_codes
from semdb.localization.index.reduction import Reduction
from semdb.localization.index.vectors import Vectors
from semdb.localization.ranking import best_first
from semdb.threads import each
from semdb.types import BoolArray, Float32Array, FloatArray, Int64Array, IntArray

SMALL = 20_000  # rows below which threads cost more than they save


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Rows 0..n of all arrays are the keyframes of the map, the dead ones among them left out of every answer."""

    ids: Int64Array  # [n]
    alive: BoolArray  # [n]
    living: int  # how many are alive
    sorted_rows: Int64Array | None  # rows in ascending order of id, the living alone; None: 0..n are that
    categories: Mapping[str, int]  # word (`semdb.class_score.word`) -> row of `counts`
    counts: ByteArray  # [classes, n or more]
    held: IntArray  # [n] strength of all that a keyframe shows
    frequencies: Int64Array  # [classes] living keyframes that show a class
    vectors: Vectors
    reduction: Reduction | None = None
    codes: CodeArray | None = None  # [n or more, components]
    rerank: int = 0  # rows that a reduced scan hands on to the exact ranking
    threads: int = 1

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        """As `CoarseSource.filtered`."""
        rows, sums = self._filtered_rows(query, minimum_share, at_most)
        return Scored(self.ids[rows], sums / query.whole)

    def _filtered_rows(
        self, query: ClassQuery, minimum_share: float, at_most: int | None
    ) -> tuple[Int64Array, Int64Array]:
        sums = self._sums(query)
        if sums is None:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        rows = self._best(sums, query.least(minimum_share), len(self.ids) if at_most is None else at_most)
        rows = rows[np.lexsort((self.ids[rows], -sums[rows]))]
        return rows, sums[rows]

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        """As `CoarseSource.cosines`."""
        rows, there = self.find(keyframe_ids)
        result = np.full(len(keyframe_ids), np.nan)
        if there.any():
            result[there] = self.vectors.cosines(rows[there], vector)
        return result

    def find(self, keyframe_ids: Int64Array) -> tuple[Int64Array, BoolArray]:
        """Rows of these keyframes, and which of them are there (the row of another one means nothing)."""
        order = self.sorted_rows
        ids = self.ids if order is None else self.ids[order]
        if not len(ids):
            return np.zeros(len(keyframe_ids), np.int64), np.zeros(len(keyframe_ids), np.bool_)
        place = np.minimum(np.searchsorted(ids, keyframe_ids), len(ids) - 1)
        there = ids[place] == keyframe_ids
        rows = place if order is None else order[place]
        return rows, there & self.alive[rows]

    def nearest(self, vector: Float32Array, count: int, query: ClassQuery | None, class_weight: float) -> Ranked:
        """As `CoarseSource.nearest`; exact where there is no reduction."""
        sums = self._sums(query) if query is not None else None
        total = 1 if query is None else query.whole
        if self.reduction is None:
            rows = np.arange(len(self.ids)) if self.living == len(self.ids) else np.flatnonzero(self.alive)
        else:
            rows = self._scan(vector, max(count, self.rerank), sums, class_weight / total)
        cosines = self._cosines(rows, vector)
        scores = np.zeros(len(rows)) if sums is None else sums[rows] / total
        order = best_first(self.ids[rows], cosines + class_weight * scores, count)
        return Ranked(self.ids[rows[order]], scores[order], cosines[order])

    def _scan(self, vector: Float32Array, count: int, sums: Int64Array | None, per_sum: float) -> Int64Array:
        """The best rows by their codes, in no order."""
        assert self.reduction is not None
        assert self.codes is not None
        codes, (query, _) = self.codes, self.reduction.query(vector)
        estimates = np.empty(len(self.ids), np.float32)

        def scan(start: int, stop: int) -> None:
            scan_codes(codes, query, start, stop, estimates)
            if sums is not None and per_sum:
                estimates[start:stop] += sums[start:stop] * np.float32(per_sum)

        self._spread(scan)
        return self._best(estimates, -np.inf, count)

    def _cosines(self, rows: Int64Array, vector: Float32Array) -> FloatArray:
        out = np.empty(len(rows), np.float64)

        def part(start: int, stop: int) -> None:
            out[start:stop] = self.vectors.cosines(rows[start:stop], vector)

        self._spread(part, len(rows))
        return out

    def _sums(self, query: ClassQuery) -> Int64Array | None:
        """The points of every row ``[n]``; None where no class of the query is known."""
        known = [term for term in query.terms if term.word in self.categories]
        if not known or not len(self.ids):
            return None
        objects = np.arange(MOST_OBJECTS + 1, dtype=np.int64)
        tables = np.array([np.minimum(term.full, term.per_object * objects) for term in known])
        rows = np.array([self.categories[term.word] for term in known], np.int64)
        out = np.empty(len(self.ids), np.int64)

        def part(start: int, stop: int) -> None:
            class_sums(self.counts, rows, tables, start, stop, out)
            out[start:stop] = query.points(out[start:stop], self.held[start:stop].astype(np.int64))

        self._spread(part)
        return out

    def _best(self, scores: npt.NDArray[Any], least: float, count: int) -> Int64Array:
        """The best `count` living rows that score `least` or more, by score and then id, in no order."""
        if count >= len(self.ids):
            return np.flatnonzero(self.alive & (scores >= least))
        found: list[Int64Array] = []

        def part(start: int, stop: int) -> None:
            rows = np.empty(min(count, stop - start), np.int64)
            found.append(rows[: best_rows(scores, self.ids, self.alive, float(least), start, stop, rows)])

        self._spread(part)
        rows = np.concatenate(found)
        if len(found) > 1 and len(rows) > count:
            rows = rows[np.lexsort((self.ids[rows], -scores[rows].astype(np.float64)))[:count]]
        return rows

    def _spread(self, work: Callable[[int, int], object], count: int | None = None) -> None:
        """Runs ``work(start, stop)`` over all rows, on the threads where there are enough rows."""
        count = len(self.ids) if count is None else count
        if self.threads < 2 or count < SMALL:
            work(0, count)
            return
        bounds = np.linspace(0, count, self.threads + 1).astype(int).tolist()
        each(lambda part: work(*part), list(pairwise(bounds)), self.threads)


def order_of(ids: Int64Array, alive: BoolArray) -> Int64Array | None:
    """Living rows in ascending order of id, or None where the ids of all rows ascend anyway."""
    if len(ids) < 2 or bool((ids[1:] > ids[:-1]).all()):
        return None
    rows = np.flatnonzero(alive)
    return rows[np.argsort(ids[rows], kind="stable")]
