"""Sightings to things: edges of a graph with weights for and against, cut so that the weights inside are largest.

Greedy additive edge contraction (Keuper and others, ICCV 2015) for the correlation clustering problem: the two clusters
between which the sum of the weights is largest are joined, until no sum is positive. Weights are whole numbers, so sums
do not depend on their order; of equal sums the pair whose first sightings come first is joined.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from semdb.types import Int64Array

UNIT = 1000  # of a weight


def clusters(count: int, a: Int64Array, b: Int64Array, weight: Int64Array) -> Int64Array:
    """The cluster of each of `count` nodes, int64 ``[count]``: the smallest node of it.

    Edges ``a[k]``, ``b[k]`` have whole weights, positive ones for being one; several of one pair are added. What no
    positive edges join is never joined, so each part that they join is cut for itself; one without an edge that is
    negative is one cluster.
    """
    low, high = np.minimum(a, b), np.maximum(a, b)
    pairs, place = np.unique(low * max(count, 1) + high, return_inverse=True)
    total = np.zeros(len(pairs), np.int64)
    np.add.at(total, place, weight)
    low, high = np.divmod(pairs, max(count, 1))
    low, high, total = (values[low != high] for values in (low, high, total))
    part = _parts(count, low[total > 0], high[total > 0])
    inside = part[low] == part[high]
    low, high, total = low[inside], high[inside], total[inside]
    found = part.copy()
    torn = np.unique(part[low[total < 0]])
    chosen = np.isin(part[low], torn)
    low, high, total = low[chosen], high[chosen], total[chosen]
    order = np.argsort(part[low], kind="stable")
    ends = np.searchsorted(part[low][order], torn, side="right").tolist()
    start = 0
    for end in ends:
        edges = order[start:end]
        start = end
        nodes = np.unique(np.concatenate([low[edges], high[edges]])).tolist()
        joined = contract(nodes, low[edges].tolist(), high[edges].tolist(), total[edges].tolist())
        for node in nodes:  # ascending: the one that it was joined to has its own already
            found[node] = node if joined[node] == node else found[joined[node]]
    return found


def _parts(count: int, a: Int64Array, b: Int64Array) -> Int64Array:
    """Of each node the smallest one that edges join it to, int64 ``[count]``."""
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(count, count))
    label = connected_components(graph, directed=False)[1] if count else np.empty(0, np.int64)
    first = np.unique(label, return_index=True)[1]
    return np.asarray(first[label], np.int64)


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
