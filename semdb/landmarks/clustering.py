"""Sightings to things: edges of a graph with weights for and against, cut so that the weights inside are largest.

Greedy additive edge contraction (Keuper and others, ICCV 2015) for the correlation clustering problem: the two clusters
between which the sum of the weights is largest are joined, until no sum is positive. Weights are whole numbers, so sums
do not depend on their order; of equal sums the pair whose first sightings come first is joined.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np

from semdb.types import Int64Array

UNIT = 1000  # of a weight


def clusters(count: int, a: Int64Array, b: Int64Array, weight: Int64Array) -> Int64Array:
    """The cluster of each of `count` nodes, int64 ``[count]``: the smallest node of it.

    Edges ``a[k]``, ``b[k]`` have whole weights, positive ones for being one; several of one pair are added.
    """
    joined = contract(range(count), a.tolist(), b.tolist(), weight.tolist())
    found = np.arange(count, dtype=np.int64)
    for node in range(count):
        root = node
        while joined[root] != root:
            root = joined[root]
        found[node] = root
    return found


def contract(nodes: Sequence[int], a: Sequence[int], b: Sequence[int], weight: Sequence[int]) -> dict[int, int]:
    """For each node the one that it was joined to: itself, or a smaller one."""
    joined = {node: node for node in nodes}
    beside: dict[int, dict[int, int]] = {node: {} for node in nodes}
    for one, other, value in zip(a, b, weight, strict=True):
        if one != other:
            total = beside[one].get(other, 0) + value
            beside[one][other] = beside[other][one] = total
    heap = [(-w, one, other) for one, near in beside.items() for other, w in near.items() if one < other and w > 0]
    heapq.heapify(heap)
    while heap:
        negative, one, other = heapq.heappop(heap)
        if beside.get(one, {}).get(other) != -negative:
            continue  # one of them is gone, or the weight has changed
        kept, gone = one, other  # the smaller name stays, whichever has more neighbours
        joined[gone] = kept
        near, old = beside[kept], beside.pop(gone)
        del near[gone]
        for third, value in old.items():
            if third == kept:
                continue
            del beside[third][gone]
            total = near.get(third, 0) + value
            near[third] = beside[third][kept] = total
            if total > 0:
                heapq.heappush(heap, (-total, min(kept, third), max(kept, third)))
    return joined
