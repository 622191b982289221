"""Descriptor matching between a query and a keyframe, with the objects as evidence.

A pair is accepted when it is a mutual nearest neighbour and passes the ratio test, over the whole image or, for
keypoints on objects, among the keypoints on objects of the same class (section III-D of the paper). Semantics
are evidence, not a blindfold: a pair that contradicts (both on objects, of different classes) has to pass a
stricter ratio, a pair of the same class is also accepted when only its class' own keypoints are compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from semdb.types import BoolArray, Float32Array, FloatArray, IntArray

BACKGROUND = -1


class Evidence(StrEnum):
    """Which keypoints may match."""

    ALL = "all"  # the whole image, same class as evidence
    OBJECTS = "objects"  # only keypoints on objects of the same class: the paper as written


@dataclass(frozen=True, slots=True)
class MatchingOptions:
    """Ratio tests compare nearest with second nearest distance; smaller is stricter."""

    evidence: Evidence = Evidence.ALL
    ratio: float = 0.85
    contradiction_ratio: float = 0.75
    guided_radius_px: float = 12.0
    guided_ratio: float = 0.92


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Index pairs and descriptor distances, sorted by the query's index."""

    query: IntArray  # [m]
    keyframe: IntArray  # [m]
    distance: Float32Array  # [m]
    same_class: BoolArray  # [m]

    def __len__(self) -> int:
        return len(self.query)


def _no_matches() -> Matches:
    empty = np.zeros(0, np.int32)
    return Matches(empty, empty, np.zeros(0, np.float32), np.zeros(0, np.bool_))


def squared_distances(first: npt.NDArray[np.generic], second: npt.NDArray[np.generic]) -> Float32Array:
    """Distances ``[n, m]``: squared Euclidean for float32 unit vectors, Hamming for packed uint8 bits."""
    if first.dtype == np.uint8:
        a = np.unpackbits(np.asarray(first, np.uint8), axis=1).astype(np.float32)
        b = np.unpackbits(np.asarray(second, np.uint8), axis=1).astype(np.float32)
        hamming: Float32Array = a.sum(1)[:, None] + b.sum(1)[None] - 2 * (a @ b.T)
        return hamming
    product = np.asarray(first, np.float32) @ np.asarray(second, np.float32).T
    return np.asarray(np.maximum(2 - 2 * product, 0), np.float32)


def _two_nearest(distances: Float32Array) -> tuple[IntArray, Float32Array, Float32Array]:
    """Index of the nearest, its distance, and the second nearest distance (inf where there is none), per row."""
    rows = np.arange(len(distances))
    nearest = distances.argmin(axis=1).astype(np.int32)
    best = distances[rows, nearest].copy()
    if distances.shape[1] < 2:
        return nearest, best, np.full(len(distances), np.inf, np.float32)
    distances[rows, nearest] = np.inf
    second = distances.min(axis=1)
    distances[rows, nearest] = best
    return nearest, best, second


def _ratio_power(dtype: np.dtype[np.generic]) -> int:
    """Ratios are of distances: squared Euclidean distances compare with the squared ratio."""
    return 1 if dtype == np.uint8 else 2


def _mutual_ratio_pairs(distances: Float32Array, ratio: float | Float32Array) -> tuple[IntArray, IntArray]:
    """Mutual nearest neighbours whose distance is below `ratio` (to the power of the measure) of the second."""
    nearest, best, second = _two_nearest(distances)
    rows = np.arange(len(distances), dtype=np.int32)
    mutual = distances.argmin(axis=0)[nearest] == rows
    accepted = mutual & (best < ratio * second)
    return rows[accepted], nearest[accepted]


def match_keypoints(
    query_descriptors: npt.NDArray[np.generic],
    keyframe_descriptors: npt.NDArray[np.generic],
    query_classes: IntArray,
    keyframe_classes: IntArray,
    options: MatchingOptions | None = None,
) -> Matches:
    """Pairs between two sets of descriptors ``[n, d]`` and ``[m, d]`` of one kind.

    `query_classes` ``[n]`` and `keyframe_classes` ``[m]`` are class numbers of the object each keypoint lies on
    (any numbering shared by both), -1 in the background.
    """
    options = options or MatchingOptions()
    if len(query_descriptors) == 0 or len(keyframe_descriptors) == 0:
        return _no_matches()
    distances = squared_distances(query_descriptors, keyframe_descriptors)
    power = _ratio_power(query_descriptors.dtype)
    found: dict[tuple[int, int], None] = {}
    if options.evidence is Evidence.ALL:
        i, j = _mutual_ratio_pairs(distances, options.ratio**power)
        keep = _not_contradicting(distances, i, j, query_classes, keyframe_classes, options, power)
        found.update(dict.fromkeys(zip(i[keep].tolist(), j[keep].tolist(), strict=True)))
    taken_query = {pair[0] for pair in found}
    taken_keyframe = {pair[1] for pair in found}
    for pair in _same_class_pairs(distances, query_classes, keyframe_classes, options.ratio**power):
        if pair[0] not in taken_query and pair[1] not in taken_keyframe:
            found[pair] = None
    return _as_matches(sorted(found), distances, query_classes, keyframe_classes)


def _not_contradicting(
    distances: Float32Array,
    i: IntArray,
    j: IntArray,
    query_classes: IntArray,
    keyframe_classes: IntArray,
    options: MatchingOptions,
    power: int,
) -> BoolArray:
    """Pairs on objects of two different classes stay only where they pass the stricter ratio."""
    q, k = query_classes[i], keyframe_classes[j]
    contradicts = (q != k) & (q != BACKGROUND) & (k != BACKGROUND)
    keep: BoolArray = ~contradicts
    if contradicts.any():
        _, best, second = _two_nearest(distances[i[contradicts]])
        keep[contradicts] = best < options.contradiction_ratio**power * second
    return keep


def _same_class_pairs(
    distances: Float32Array, query_classes: IntArray, keyframe_classes: IntArray, ratio: float
) -> list[tuple[int, int]]:
    pairs: list[tuple[int, int]] = []
    for category in np.intersect1d(query_classes, keyframe_classes):
        if category == BACKGROUND:
            continue
        rows = np.flatnonzero(query_classes == category)
        columns = np.flatnonzero(keyframe_classes == category)
        i, j = _mutual_ratio_pairs(distances[np.ix_(rows, columns)], ratio)
        pairs += zip(rows[i].tolist(), columns[j].tolist(), strict=True)
    return pairs


def _as_matches(
    pairs: list[tuple[int, int]], distances: Float32Array, query_classes: IntArray, keyframe_classes: IntArray
) -> Matches:
    if not pairs:
        return _no_matches()
    i, j = np.array(pairs, np.int32).T
    same = (query_classes[i] == keyframe_classes[j]) & (query_classes[i] != BACKGROUND)
    return Matches(i, j, distances[i, j], same)


def match_guided(
    query_descriptors: npt.NDArray[np.generic],
    keyframe_descriptors: npt.NDArray[np.generic],
    query_xy: FloatArray,
    projected_xy: FloatArray,
    query_classes: IntArray,
    keyframe_classes: IntArray,
    options: MatchingOptions | None = None,
) -> Matches:
    """Second matching with a pose at hand: only keypoints near the projection of a keyframe's points compete.

    `query_xy` ``[n, 2]`` are undistorted pixels, `projected_xy` ``[m, 2]`` those of the keyframe's 3D points in
    the query's camera (NaN where a point is behind it or has no depth). Nearest and second nearest are taken
    among the keypoints within `guided_radius_px`, so that repeated texture elsewhere does not reject a pair.
    """
    options = options or MatchingOptions()
    visible = np.flatnonzero(np.isfinite(projected_xy).all(axis=1))
    if len(query_descriptors) == 0 or len(visible) == 0:
        return _no_matches()
    i, j = _pairs_within(query_xy, projected_xy[visible], options.guided_radius_px)
    j = visible[j].astype(np.int32)
    same_class = (query_classes[i] == keyframe_classes[j]) & (query_classes[i] != BACKGROUND)
    if options.evidence is Evidence.OBJECTS:
        i, j, same_class = i[same_class], j[same_class], same_class[same_class]
    distance = _paired_distances(query_descriptors, keyframe_descriptors, i, j)
    ratio = options.guided_ratio ** _ratio_power(query_descriptors.dtype)
    ceiling = _distance_ceiling(query_descriptors.dtype, query_descriptors.shape[1])
    best, second = _two_least(distance, i, len(query_descriptors))
    best_back, _ = _two_least(distance, j, len(keyframe_descriptors))
    accepted = (
        (distance <= best[i]) & (distance <= best_back[j]) & (distance < ceiling) & (distance < ratio * second[i])
    )
    order = np.flatnonzero(accepted)
    order = order[np.lexsort((j[order], i[order]))]
    return Matches(i[order], j[order], distance[order], same_class[order])


def _pairs_within(first: FloatArray, second: FloatArray, radius: float) -> tuple[IntArray, IntArray]:
    """Indexes of all pairs of points ``[n, 2]`` and ``[m, 2]`` that are at most `radius` apart."""
    near = KDTree(first).sparse_distance_matrix(KDTree(second), radius, output_type="coo_matrix")
    return near.row.astype(np.int32), near.col.astype(np.int32)


def _paired_distances(
    first: npt.NDArray[np.generic], second: npt.NDArray[np.generic], i: IntArray, j: IntArray
) -> Float32Array:
    """`squared_distances` of rows `i` of one with rows `j` of the other, ``[k]``."""
    if first.dtype == np.uint8:
        differing = np.bitwise_count(np.asarray(first[i], np.uint8) ^ np.asarray(second[j], np.uint8))
        return np.asarray(differing.sum(axis=1), np.float32)
    product = np.einsum("kd,kd->k", np.asarray(first[i], np.float32), np.asarray(second[j], np.float32))
    return np.asarray(np.maximum(2 - 2 * product, 0), np.float32)


def _two_least(values: Float32Array, groups: IntArray, count: int) -> tuple[Float32Array, Float32Array]:
    """Least and second least of the `values` of each of `count` groups; inf where there is none."""
    least = np.full(count, np.inf, np.float32)
    second = np.full(count, np.inf, np.float32)
    order = np.lexsort((values, groups))
    sorted_groups = groups[order]
    first = np.flatnonzero(np.diff(sorted_groups, prepend=-1) != 0)
    least[sorted_groups[first]] = values[order[first]]
    following = first + 1
    following = following[following < len(order)]
    following = following[sorted_groups[following] == sorted_groups[following - 1]]
    second[sorted_groups[following]] = values[order[following]]
    return least, second


def _distance_ceiling(dtype: np.dtype[np.generic], width: int) -> float:
    """A pair without competitors must still look alike: cosine .75, or a quarter of the bits different."""
    return width * 8 * 0.25 if dtype == np.uint8 else 0.5
