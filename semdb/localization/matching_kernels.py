"""Scans of distances and of pairs, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel


@kernel
def scan(distances: Any, rows: Any, columns: Any, nearest: Any, best: Any, second: Any, best_back: Any) -> None:
    """Nearest, its distance and the second least of each of `rows` among `columns` of `distances` ``[n, m]``.

    `best_back` gets the least distance of each of `columns`. Of equal ones the first is the nearest. Indexes in
    `nearest` count `columns`; without a second it is inf.
    """
    best_back[:] = np.inf
    for i in range(len(rows)):
        line = distances[rows[i]]
        first, following, at = np.float32(np.inf), np.float32(np.inf), 0
        for j in range(len(columns)):
            value = line[columns[j]]
            best_back[j] = min(best_back[j], value)
            if value < following:
                if value < first:
                    following, first, at = first, value, j
                else:
                    following = value
        nearest[i], best[i], second[i] = at, first, following


@kernel
def count_near(x: Any, y: Any, order: Any, to_x: Any, to_y: Any, radius: float, i: Any, j: Any) -> int:
    """Pairs (i, j) of points that are at most `radius` apart, by ascending j; fills `i` and `j` as far as they reach.

    `order` sorts `x`. Returns how many there are, which may be more than there is room for.
    """
    found = 0
    for k in range(len(to_x)):
        low, high = 0, len(order)
        start = to_x[k] - radius
        while low < high:
            middle = (low + high) // 2
            if x[order[middle]] < start:
                low = middle + 1
            else:
                high = middle
        while low < len(order):
            n = order[low]
            dx = x[n] - to_x[k]
            if dx > radius:
                break
            dy = y[n] - to_y[k]
            if dx * dx + dy * dy <= radius * radius:
                if found < len(i):
                    i[found], j[found] = n, k
                found += 1
            low += 1
    return found


@kernel
def two_least(values: Any, groups: Any, least: Any, second: Any) -> None:
    """Least and second least of the `values` of each group; both start at infinity."""
    for k in range(len(values)):
        value, group = values[k], groups[k]
        if value < least[group]:
            second[group], least[group] = least[group], value
        elif value < second[group]:
            second[group] = value


@kernel
def dot_pairs(first: Any, second: Any, i: Any, j: Any, out: Any) -> None:
    """Dot products ``[k]`` of rows ``i[k]`` of one and ``j[k]`` of the other."""
    for k in range(len(i)):
        a, b = first[i[k]], second[j[k]]
        total = np.float32(0)
        for d in range(len(a)):
            total += a[d] * b[d]
        out[k] = total
