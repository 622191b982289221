"""The loops over all keyframes of a map: class sums, the reduced scan, the best of many. Compiled, without the GIL."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.compiled import kernel
from semdb.types import BoolArray, Float32Array, Int64Array

ByteArray = npt.NDArray[np.uint8]
CodeArray = npt.NDArray[np.int8]

BLOCK = 4096


@kernel
def class_sums(counts: ByteArray, rows: Int64Array, tables: Int64Array, start: int, stop: int, out: Int64Array) -> None:
    """For the keyframes start..stop: the sum of ``tables[t, counts[rows[t], k]]`` over the terms t.

    `counts` ``[classes, keyframes]`` are objects per class, `tables` ``[terms, 256]`` what so many of them add.
    """
    for k in range(start, stop):
        out[k] = 0
    for begin in range(start, stop, BLOCK):
        end = min(begin + BLOCK, stop)
        for t in range(rows.shape[0]):
            row = counts[rows[t]]
            table = tables[t]
            for k in range(begin, end):
                out[k] += table[row[k]]


@kernel(fastmath={"reassoc", "contract", "nsz"})
def scan_codes(codes: CodeArray, query: Float32Array, start: int, stop: int, out: Float32Array) -> None:
    """Inner products of ``codes[start:stop]`` ``[n, d]`` with `query` ``[d]``, in single precision."""
    for k in range(start, stop):
        row = codes[k]
        total = np.float32(0)
        for j in range(query.shape[0]):
            total += np.float32(row[j]) * query[j]
        out[k] = total


@kernel
def best_rows(
    scores: npt.NDArray[Any], ids: Int64Array, alive: BoolArray, least: float, start: int, stop: int, rows: Int64Array
) -> int:
    """The best of the rows start..stop that are alive and score `least` or more, into `rows` ``[k]``; how many.

    Best: by falling score, then by ascending id. They are given in no order: `rows` is a heap, the worst first.
    """
    size = 0
    capacity = rows.shape[0]
    if capacity == 0:
        return 0
    for k in range(start, stop):
        score = scores[k]
        if not (score >= least) or not alive[k]:
            continue
        if size < capacity:
            hole = size
            size += 1
            while hole > 0:
                parent = (hole - 1) // 2
                other = rows[parent]
                if scores[other] < score or (scores[other] == score and ids[other] > ids[k]):
                    break  # the parent is worse still
                rows[hole] = other
                hole = parent
            rows[hole] = k
            continue
        worst = rows[0]
        if score < scores[worst] or (score == scores[worst] and ids[k] > ids[worst]):
            continue
        hole = 0
        while True:
            child = 2 * hole + 1
            if child >= size:
                break
            left = rows[child]
            if child + 1 < size:
                right = rows[child + 1]
                if scores[right] < scores[left] or (scores[right] == scores[left] and ids[right] > ids[left]):
                    child += 1
                    left = right
            if score < scores[left] or (score == scores[left] and ids[k] > ids[left]):
                break  # the new one is the worst of the three
            rows[hole] = left
            hole = child
        rows[hole] = k
    return size
