"""Exact cosines and orders that every source of the coarse step shares, so that all give the same to the last bit."""

from __future__ import annotations

import numpy as np

from semdb.compiled import kernel
from semdb.types import Float32Array, FloatArray, Int64Array


def best_first(keyframe_ids: Int64Array, scores: FloatArray, count: int | None = None) -> Int64Array:
    """Positions in order of falling score, ties in ascending order of id: the first `count` (None: all).

    Scores that are NaN are left out.
    """
    there = np.flatnonzero(~np.isnan(scores))
    if count is not None and 0 < count < len(there):
        chosen = scores[there]
        there = there[chosen >= np.partition(chosen, len(chosen) - count)[len(chosen) - count]]
    order = np.lexsort((keyframe_ids[there], -scores[there]))
    return there[order][:count].astype(np.int64, copy=False)


def exact_cosines(vectors: Float32Array, rows: Int64Array, query: Float32Array) -> FloatArray:
    """Inner products float64 ``[n]`` of ``vectors[rows]`` with `query` ``[d]``.

    Products of float32 are exact in float64 and are added in an order that depends on d alone: a row's cosine is the
    same to the last bit whatever else is asked for.
    """
    out = np.empty(len(rows), np.float64)
    _cosines(vectors, rows, np.ascontiguousarray(query, np.float64), out)
    return out


LANES = 8


@kernel
def _cosines(vectors: Float32Array, rows: Int64Array, query: FloatArray, out: FloatArray) -> None:
    size = query.shape[0]
    whole = size - size % LANES
    for n in range(rows.shape[0]):
        row = vectors[rows[n]]
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0
        for j in range(0, whole, LANES):
            s0 += row[j] * query[j]
            s1 += row[j + 1] * query[j + 1]
            s2 += row[j + 2] * query[j + 2]
            s3 += row[j + 3] * query[j + 3]
            s4 += row[j + 4] * query[j + 4]
            s5 += row[j + 5] * query[j + 5]
            s6 += row[j + 6] * query[j + 6]
            s7 += row[j + 7] * query[j + 7]
        rest = 0.0
        for j in range(whole, size):
            rest += row[j] * query[j]
        out[n] = ((s0 + s1) + (s2 + s3)) + ((s4 + s5) + (s6 + s7)) + rest
