"""Scans of distances and of pairs, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel


@kernel(fastmath=True)
def scan_all(closeness: Any, nearest: Any, best: Any, second: Any, best_back: Any) -> None:
    """Of each row of `closeness` ``[n, m]`` the greatest, where it is, and the second greatest.

    `best_back` gets the greatest of each column. Of equal ones the first is the nearest. Without a second it is
    -1e38. The matrix must be finite and have a column; it is as it was when this returns.
    """
    least = np.float32(-1.0e38)
    best_back[:] = least
    for i in range(closeness.shape[0]):
        line = closeness[i]
        greatest = least
        for j in range(line.size):
            value = line[j]
            greatest = max(greatest, value)
            best_back[j] = max(best_back[j], value)
        at = 0
        while at + 1 < line.size and line[at] < greatest:
            at += 1
        line[at] = least
        following = least
        for j in range(line.size):
            following = max(following, line[j])
        line[at] = greatest
        nearest[i], best[i], second[i] = at, greatest, following


@kernel
def scan(closeness: Any, rows: Any, columns: Any, nearest: Any, best: Any, second: Any, best_back: Any) -> None:
    """`scan_all` of some `rows` and `columns`; indexes in `nearest` count `columns`."""
    least = np.float32(-1.0e38)
    best_back[:] = least
    for i in range(len(rows)):
        first, following, at = least, least, 0
        for j in range(len(columns)):
            value = closeness[rows[i], columns[j]]
            best_back[j] = max(best_back[j], value)
            if value > following:
                if value > first:
                    following, first, at = first, value, j
                else:
                    following = value
        nearest[i], best[i], second[i] = at, first, following


@kernel
def count_near(
    x: Any, y: Any, sign: Any, order: Any, to_x: Any, to_y: Any, to_sign: Any, radius: float, i: Any, j: Any
) -> int:
    """Pairs (i, j) of points of equal sign at most `radius` apart, by ascending j; fills `i`, `j` as far as they reach.

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
            if dx * dx + dy * dy <= radius * radius and sign[n] == to_sign[k]:
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


@kernel(fastmath=True)
def dot_pairs(first: Any, second: Any, i: Any, j: Any, out: Any) -> None:
    """Dot products ``[k]`` of rows ``i[k]`` of one and ``j[k]`` of the other."""
    for k in range(len(i)):
        one, two = i[k], j[k]
        total = np.float32(0)
        for d in range(first.shape[1]):
            total += first[one, d] * second[two, d]
        out[k] = total
