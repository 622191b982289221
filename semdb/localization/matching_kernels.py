"""Scans of distances and of pairs, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.compiled import kernel

BLOCK = 128  # columns that are looked at together


@kernel(fastmath=True)
def multiply(first: Any, second: Any, out: Any) -> None:
    """``first @ second`` of float32 matrices ``[n, d]`` and ``[d, m]``, on the calling thread alone.

    As fast as a BLAS on one core. The threads of a BLAS go on waiting for more on the other cores long after a
    product as small as these, and what runs there pays for it.
    """
    n, depth = first.shape
    for i in range(0, n - 3, 4):
        out0, out1, out2, out3 = out[i], out[i + 1], out[i + 2], out[i + 3]
        out0[:], out1[:], out2[:], out3[:] = 0, 0, 0, 0
        for k in range(0, depth - 3, 4):
            row0, row1, row2, row3 = second[k], second[k + 1], second[k + 2], second[k + 3]
            a0, a1, a2, a3 = first[i, k], first[i, k + 1], first[i, k + 2], first[i, k + 3]
            b0, b1, b2, b3 = first[i + 1, k], first[i + 1, k + 1], first[i + 1, k + 2], first[i + 1, k + 3]
            c0, c1, c2, c3 = first[i + 2, k], first[i + 2, k + 1], first[i + 2, k + 2], first[i + 2, k + 3]
            d0, d1, d2, d3 = first[i + 3, k], first[i + 3, k + 1], first[i + 3, k + 2], first[i + 3, k + 3]
            for j in range(out.shape[1]):
                x, y, z, w = row0[j], row1[j], row2[j], row3[j]
                out0[j] += a0 * x + a1 * y + a2 * z + a3 * w
                out1[j] += b0 * x + b1 * y + b2 * z + b3 * w
                out2[j] += c0 * x + c1 * y + c2 * z + c3 * w
                out3[j] += d0 * x + d1 * y + d2 * z + d3 * w
        for k in range(depth - depth % 4, depth):
            _add_rows(first, second, i, i + 4, k, out)
    for i in range(n - n % 4, n):
        out[i] = 0
        for k in range(depth):
            _add_rows(first, second, i, i + 1, k, out)


@kernel(fastmath=True)
def _add_rows(first: Any, second: Any, start: int, stop: int, k: int, out: Any) -> None:
    for i in range(start, stop):
        for j in range(out.shape[1]):
            out[i, j] += first[i, k] * second[k, j]


@kernel(fastmath=True)
def scan_all(closeness: Any, nearest: Any, best: Any, second: Any, best_back: Any) -> None:
    """Of each row of `closeness` ``[n, m]`` the greatest, where it is, and the second greatest.

    `best_back` gets the greatest of each column. Of equal ones the first is the nearest. Without a second it is
    -1e38. The matrix must be finite and have a column.
    """
    least, columns = np.float32(-1.0e38), closeness.shape[1]
    best_back[:] = least
    blocks = (columns + BLOCK - 1) // BLOCK
    tops = np.empty(blocks, np.float32)  # the greatest of each block: the second greatest needs no second pass
    for i in range(closeness.shape[0]):
        line = closeness[i]
        greatest = least
        for block in range(blocks):
            top = least
            for j in range(block * BLOCK, min(columns, (block + 1) * BLOCK)):
                value = line[j]
                top = max(top, value)
                best_back[j] = max(best_back[j], value)
            tops[block] = top
            greatest = max(greatest, top)
        first = 0
        while first + 1 < blocks and tops[first] < greatest:
            first += 1
        start, stop = first * BLOCK, min(columns, (first + 1) * BLOCK)
        at = start
        while at + 1 < stop and line[at] < greatest:
            at += 1
        following = least
        for j in range(start, at):
            following = max(following, line[j])
        for j in range(at + 1, stop):
            following = max(following, line[j])
        for block in range(blocks):
            if block != first:
                following = max(following, tops[block])
        nearest[i], best[i], second[i] = at, greatest, following


@kernel
def _scan_from(
    least: Any, closeness: Any, rows: Any, columns: Any, nearest: Any, best: Any, second: Any, best_back: Any
) -> None:
    """`scan` of numbers of the type of `least`, which is less than any of them."""
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
def scan(closeness: Any, rows: Any, columns: Any, nearest: Any, best: Any, second: Any, best_back: Any) -> None:
    """`scan_all` of some `rows` and `columns`; indexes in `nearest` count `columns`."""
    _scan_from(np.float32(-1.0e38), closeness, rows, columns, nearest, best, second, best_back)


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


@kernel
def multiply_bytes(first: Any, second: Any, out: Any) -> None:
    """``first @ second`` of int16 matrices ``[n, d]`` and ``[d, m]`` in 16 bits: the products of bytes must fit them.

    What overflows on the way does no harm, for it is counted modulo 2^16.
    """
    n, depth = first.shape
    for i in range(0, n - 3, 4):
        out0, out1, out2, out3 = out[i], out[i + 1], out[i + 2], out[i + 3]
        out0[:], out1[:], out2[:], out3[:] = 0, 0, 0, 0
        for k in range(0, depth - 3, 4):
            row0, row1, row2, row3 = second[k], second[k + 1], second[k + 2], second[k + 3]
            a0, a1, a2, a3 = first[i, k], first[i, k + 1], first[i, k + 2], first[i, k + 3]
            b0, b1, b2, b3 = first[i + 1, k], first[i + 1, k + 1], first[i + 1, k + 2], first[i + 1, k + 3]
            c0, c1, c2, c3 = first[i + 2, k], first[i + 2, k + 1], first[i + 2, k + 2], first[i + 2, k + 3]
            d0, d1, d2, d3 = first[i + 3, k], first[i + 3, k + 1], first[i + 3, k + 2], first[i + 3, k + 3]
            for j in range(out.shape[1]):
                x, y, z, w = row0[j], row1[j], row2[j], row3[j]
                out0[j] += np.int16(a0 * x + a1 * y + a2 * z + a3 * w)
                out1[j] += np.int16(b0 * x + b1 * y + b2 * z + b3 * w)
                out2[j] += np.int16(c0 * x + c1 * y + c2 * z + c3 * w)
                out3[j] += np.int16(d0 * x + d1 * y + d2 * z + d3 * w)
        for k in range(depth - depth % 4, depth):
            _add_byte_rows(first, second, i, i + 4, k, out)
    for i in range(n - n % 4, n):
        out[i] = 0
        for k in range(depth):
            _add_byte_rows(first, second, i, i + 1, k, out)


@kernel
def _add_byte_rows(first: Any, second: Any, start: int, stop: int, k: int, out: Any) -> None:
    for i in range(start, stop):
        for j in range(out.shape[1]):
            out[i, j] += np.int16(first[i, k] * second[k, j])


@kernel
def scan_bytes(closeness: Any, nearest: Any, best: Any, second: Any, best_back: Any) -> None:
    """`scan_all` of int16 products; without a second it is -32768.

    Loops are in functions of their own, and without branches, so that each is vectorised.
    """
    least, columns = np.int16(-32768), closeness.shape[1]
    best_back[:] = least
    blocks = (columns + BLOCK - 1) // BLOCK
    tops = np.empty(blocks, np.int16)  # the greatest of each block: the second greatest needs no second pass
    for i in range(closeness.shape[0]):
        line = closeness[i]
        for block in range(blocks):
            here = slice(block * BLOCK, min(columns, (block + 1) * BLOCK))
            tops[block] = _greatest(line[here], best_back[here])
        greatest = _top(tops)
        first = 0
        while tops[first] < greatest:
            first += 1
        start, stop = first * BLOCK, min(columns, (first + 1) * BLOCK)
        at = start
        while line[at] < greatest:
            at += 1
        tops[first] = max(_top(line[start:at]), _top(line[at + 1 : stop]))
        nearest[i], best[i], second[i] = at, greatest, _top(tops)


@kernel
def _greatest(line: Any, best_back: Any) -> Any:
    greatest = np.int16(-32768)
    for j in range(len(line)):
        value = line[j]
        greatest = max(greatest, value)
        best_back[j] = max(best_back[j], value)
    return greatest


@kernel
def _top(line: Any) -> Any:
    greatest = np.int16(-32768)
    for j in range(len(line)):
        greatest = max(greatest, line[j])
    return greatest


@kernel
def scan_some_bytes(closeness: Any, rows: Any, columns: Any, nearest: Any, best: Any, second: Any, back: Any) -> None:
    """`scan` of int16 products; without a second it is -32768."""
    _scan_from(np.int16(-32768), closeness, rows, columns, nearest, best, second, back)


@kernel
def dot_byte_pairs(first: Any, second: Any, i: Any, j: Any, out: Any) -> None:
    """`dot_pairs` of int8, as int32."""
    for k in range(len(i)):
        one, two = first[i[k]], second[j[k]]
        total = np.int32(0)
        for d in range(len(one)):
            total += np.int32(one[d]) * np.int32(two[d])
        out[k] = total
