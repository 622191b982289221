"""Which classes the detector takes for each other, without labels: objects of two keyframes at one place in the map.

A cupboard that is a refrigerator from the left and an oven from the right lies at one place under two names. Pairs of
objects of different keyframes at one place are counted by their two classes; how much of what is found at the place of
a class goes by another name is how far a query's object of the one may stand for a keyframe's object of the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from semdb.types import FloatArray, Int64Array

MILLION = 1_000_000
_CHUNK = 20_000


@dataclass(frozen=True, slots=True)
class ConfusionOptions:
    """`near`: centres at most this share of the smaller object's half diagonal apart are at one place.

    `size_ratio`: and neither is larger than the other by more than this. `neighbours`: objects that are looked at for
    each one, the nearest first. A pair of classes counts from `minimum_pairs` and a share of `minimum_weight` on;
    `prior` pairs are added to the whole, so that a few pairs do not make a large share.
    """

    near: float = 0.5
    size_ratio: float = 2.0
    neighbours: int = 32
    minimum_pairs: int = 3
    minimum_weight: float = 0.02
    prior: int = 4


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObjects:
    """Objects of a map. Their order does not change what is computed of them."""

    keyframe: Int64Array  # [n] any number that is the same for objects of one keyframe
    category: Int64Array  # [n] number of the class
    centre: FloatArray  # [n, 3] metres, in the map
    half_diagonal: FloatArray  # [n] metres: half of the diagonal of the box about the object

    def __len__(self) -> int:
        return len(self.keyframe)


@dataclass(frozen=True, slots=True)
class Confusion:
    """`weight` (millionths) of what was found at the places of `category` was called `other`, in `pairs` pairs."""

    category: int
    other: int
    pairs: int
    weight: int


def co_detections(placed: PlacedObjects, classes: int, options: ConfusionOptions | None = None) -> Int64Array:
    """How often an object of class b of another keyframe lies at the place of one of class a: int64 ``[a, b]``."""
    options = options or ConfusionOptions()
    counts = np.zeros((classes, classes), np.int64)
    if len(placed) < 2:
        return counts
    order = np.lexsort((placed.category, placed.keyframe, *placed.centre.T))
    keyframe, category = placed.keyframe[order], placed.category[order]
    centre, half = placed.centre[order], placed.half_diagonal[order]
    tree = cKDTree(centre)
    wanted = min(options.neighbours + 1, len(placed))
    for start in range(0, len(placed), _CHUNK):
        stop = min(start + _CHUNK, len(placed))
        reach = options.near * float(half[start:stop].max())
        if reach <= 0:
            continue
        nearest = tree.query(centre[start:stop], k=wanted, distance_upper_bound=np.nextafter(reach, np.inf))
        distance, found = (np.asarray(part).ravel() for part in nearest)
        one = np.repeat(np.arange(start, stop), wanted)
        there = found < len(placed)  # the tree gives n for "none within reach"
        one, distance, found = one[there], distance[there], found[there]
        small, large = np.minimum(half[one], half[found]), np.maximum(half[one], half[found])
        same = (distance <= options.near * small) & (large <= options.size_ratio * small)
        same &= keyframe[one] != keyframe[found]
        np.add.at(counts, (category[one[same]], category[found[same]]), 1)
    return counts


def confusions(counts: Int64Array, options: ConfusionOptions | None = None) -> list[Confusion]:
    """The pairs of different classes worth knowing of, by class, from `co_detections`."""
    options = options or ConfusionOptions()
    found = []
    totals = counts.sum(axis=1) + options.prior
    for a, b in np.argwhere(counts >= options.minimum_pairs).tolist():
        weight = int(counts[a, b]) * MILLION // int(totals[a])
        if a != b and weight >= options.minimum_weight * MILLION:
            found.append(Confusion(a, b, int(counts[a, b]), weight))
    return found
