"""Descriptor matching between a query and a keyframe, with the objects as evidence.

A pair is accepted when it is a mutual nearest neighbour and passes the ratio test, over the whole image or, for
keypoints on objects, among the keypoints on objects of the same class (section III-D of the paper). Semantics
are evidence, not a blindfold: a pair that contradicts (both on objects, of different classes) has to pass a
stricter ratio, a pair of the same class is also accepted when only its class' own keypoints are compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.byte_descriptors import SCALE, from_bytes, to_bytes
from semdb.types import BoolArray, Float32Array, FloatArray, IntArray

BACKGROUND = -1
NOTHING = -1e30  # what is less close is not there
NO_PRODUCT = -32768  # the same of products of bytes
SMALL = 4096  # numbers of classes up to here are counted, not sorted


class Evidence(StrEnum):
    """Which keypoints may match."""

    ALL = "all"  # the whole image, same class as evidence
    OBJECTS = "objects"  # only keypoints on objects of the same class: the paper as written


@dataclass(frozen=True, slots=True)
class MatchingOptions:
    """Ratio tests compare nearest with second nearest distance; smaller is stricter.

    Ceilings are squared distances of float descriptors that a pair has to stay below.
    """

    evidence: Evidence = Evidence.ALL
    ratio: float = 0.85
    contradiction_ratio: float = 0.75
    guided_radius_px: float = 12.0
    guided_ratio: float = 0.92
    ceiling: float = float("inf")
    guided_ceiling: float = 0.5  # cosine .75: a pair without competitors must still look alike


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Index pairs and descriptor distances, sorted by the query's index."""

    query: IntArray  # [m]
    keyframe: IntArray  # [m]
    distance: Float32Array  # [m]
    same_class: BoolArray  # [m]

    def __len__(self) -> int:
        return len(self.query)


def no_matches() -> Matches:
    """No pair at all."""
    empty = np.zeros(0, np.int32)
    return Matches(empty, empty, np.zeros(0, np.float32), np.zeros(0, np.bool_))


def of_one_kind(
    first: npt.NDArray[np.generic], second: npt.NDArray[np.generic]
) -> tuple[npt.NDArray[np.generic], npt.NDArray[np.generic]]:
    """Both as they are; of one of bytes (int8) and one of float both as bytes, or as float where these do not fit.

    Rows of one map may be of either kind.
    """
    if (first.dtype == np.int8) == (second.dtype == np.int8) or np.uint8 in (first.dtype, second.dtype):
        return first, second
    if first.dtype == np.int8:
        second, first = of_one_kind(second, first)
        return first, second
    small = to_bytes(first)
    if small is not None:
        return small, second
    return first, from_bytes(np.asarray(second, np.int8))


def closeness(first: npt.NDArray[np.generic], second: npt.NDArray[np.generic]) -> npt.NDArray[Any]:
    """How alike descriptors are ``[n, m]``.

    Cosine of float32 unit vectors; the product of int8 (`semdb.byte_descriptors`), int16; minus the bits in which
    uint8 differ.
    """
    if first.dtype == np.int8:
        from semdb.localization.matching_kernels import multiply_bytes

        product = np.empty((len(first), len(second)), np.int16)
        multiply_bytes(np.ascontiguousarray(first, np.int16), np.ascontiguousarray(second.T, np.int16), product)
        return product
    if first.dtype == np.uint8:
        a = np.unpackbits(np.asarray(first, np.uint8), axis=1).astype(np.float32)
        b = np.unpackbits(np.asarray(second, np.uint8), axis=1).astype(np.float32)
        return np.asarray(2 * (a @ b.T) - a.sum(1)[:, None] - b.sum(1)[None], np.float32)
    from semdb.localization.matching_kernels import multiply

    close = np.empty((len(first), len(second)), np.float32)
    multiply(np.ascontiguousarray(first, np.float32), np.ascontiguousarray(second.T, np.float32), close)
    return close


def distance_of(close: npt.NDArray[Any], dtype: np.dtype[np.generic]) -> Float32Array:
    """The distance that goes with `closeness`: squared Euclidean of unit vectors, Hamming of bits; inf for none."""
    if dtype == np.int8:
        return np.asarray(_distances_of_products()[close], np.float32)
    distance = -close if dtype == np.uint8 else np.maximum(2 - 2 * close, 0)
    return np.asarray(np.where(close < NOTHING, np.inf, distance), np.float32)


@cache
def _distances_of_products() -> Float32Array:
    """The distance of every int16 product ``[65536]``, negative ones counted from the end; inf of `NO_PRODUCT`."""
    products = np.arange(2**16, dtype=np.uint16).view(np.int16)
    found = _distance_of_products(products)
    found[NO_PRODUCT] = np.inf
    return found


def _distance_of_products(product: npt.NDArray[Any]) -> Float32Array:
    """Squared Euclidean distances of what `semdb.byte_descriptors` made bytes of, by their products."""
    squared = np.float32(2) - product.astype(np.float32) * np.float32(2 / SCALE**2)
    return np.asarray(np.maximum(squared, 0), np.float32)


def _ratio_power(dtype: np.dtype[np.generic]) -> int:
    """Ratios are of distances: squared Euclidean distances compare with the squared ratio."""
    return 1 if dtype == np.uint8 else 2


@dataclass(frozen=True, slots=True, eq=False)
class _Mutual:
    """Mutual nearest neighbours, and what the ratio test needs of them."""

    rows: IntArray  # [k]
    columns: IntArray  # [k]
    distance: Float32Array  # [k]
    second: Float32Array  # [k] distance of the second nearest column, inf where there is none

    def passing(self, ratio: float | FloatArray, ceiling: float) -> BoolArray:
        return np.asarray((self.distance < ratio * self.second) & (self.distance < ceiling))


def _mutual(
    close: npt.NDArray[Any], dtype: np.dtype[np.generic], rows: IntArray | None = None, columns: IntArray | None = None
) -> _Mutual:
    """Mutual nearest neighbours between `rows` and `columns` (or all) of the `closeness` ``[n, m]`` of `dtype`."""
    from semdb.localization import matching_kernels as kernels

    everything = rows is None or columns is None
    if rows is None or columns is None:
        rows, columns = (np.arange(size, dtype=np.int32) for size in close.shape)
    n, m = len(rows), len(columns)
    nearest, best, second = np.empty(n, np.int32), np.empty(n, close.dtype), np.empty(n, close.dtype)
    best_back = np.empty(m, close.dtype)
    whole, part = (
        (kernels.scan_bytes, kernels.scan_some_bytes) if dtype == np.int8 else (kernels.scan_all, kernels.scan)
    )
    if everything:
        whole(close, nearest, best, second, best_back)
    else:
        part(close, rows, columns, nearest, best, second, best_back)
    keep = best >= best_back[nearest]
    return _Mutual(rows[keep], columns[nearest[keep]], distance_of(best[keep], dtype), distance_of(second[keep], dtype))


def match_keypoints(
    query_descriptors: npt.NDArray[np.generic],
    keyframe_descriptors: npt.NDArray[np.generic],
    query_classes: IntArray,
    keyframe_classes: IntArray,
    options: MatchingOptions | None = None,
    *,
    query_signs: npt.NDArray[np.int8] | None = None,
    keyframe_signs: npt.NDArray[np.int8] | None = None,
) -> Matches:
    """Pairs between two sets of descriptors ``[n, d]`` and ``[m, d]`` of one kind.

    `query_classes` ``[n]`` and `keyframe_classes` ``[m]`` are class numbers of the object each keypoint lies on
    (any numbering shared by both), -1 in the background. With signs of the Laplacian, ``[n]`` and ``[m]``, only
    keypoints of equal sign are compared (bright blobs with bright ones: Bay et al., SURF, section 4.3), which is
    also half the work.
    """
    options = options or MatchingOptions()
    query_descriptors, keyframe_descriptors = of_one_kind(query_descriptors, keyframe_descriptors)
    if query_signs is None or keyframe_signs is None:
        query_signs, keyframe_signs = (
            np.zeros(len(query_descriptors), np.int8),
            np.zeros(len(keyframe_descriptors), np.int8),
        )
    found = []
    for sign in _in_both(query_signs, keyframe_signs):
        rows = np.flatnonzero(query_signs == sign).astype(np.int32)
        columns = np.flatnonzero(keyframe_signs == sign).astype(np.int32)
        here = _match_block(
            query_descriptors[rows],
            keyframe_descriptors[columns],
            query_classes[rows],
            keyframe_classes[columns],
            options,
        )
        found.append(Matches(rows[here.query], columns[here.keyframe], here.distance, here.same_class))
    return _sorted(found)


def _in_both(first: IntArray | npt.NDArray[np.int8], second: IntArray | npt.NDArray[np.int8]) -> list[int]:
    """The numbers that two arrays share, ascending; faster than by sorting where they are small and not below -1."""
    if not len(first) or not len(second):
        return []
    if min(first.min(), second.min()) < -1 or max(first.max(), second.max()) > SMALL:
        return [int(number) for number in np.intersect1d(first, second)]
    size = int(max(first.max(), second.max())) + 2
    there = [np.bincount(np.asarray(numbers, np.intp) + 1, minlength=size) > 0 for numbers in (first, second)]
    return [int(number) - 1 for number in np.flatnonzero(there[0] & there[1])]


def _match_block(
    query_descriptors: npt.NDArray[np.generic],
    keyframe_descriptors: npt.NDArray[np.generic],
    query_classes: IntArray,
    keyframe_classes: IntArray,
    options: MatchingOptions,
) -> Matches:
    """Pairs of descriptors that may all be compared. First the whole image, then what the classes add."""
    close, dtype = closeness(query_descriptors, keyframe_descriptors), query_descriptors.dtype
    power, ceiling = _ratio_power(dtype), float("inf") if dtype == np.uint8 else options.ceiling
    taken_query, taken_keyframe = (np.zeros(size, np.bool_) for size in close.shape)
    found: list[tuple[IntArray, IntArray]] = []
    if options.evidence is Evidence.ALL:
        pairs = _mutual(close, dtype)
        q, k = query_classes[pairs.rows], keyframe_classes[pairs.columns]
        contradicts = (q != k) & (q != BACKGROUND) & (k != BACKGROUND)
        keep = pairs.passing(np.where(contradicts, options.contradiction_ratio, options.ratio) ** power, ceiling)
        found.append((pairs.rows[keep], pairs.columns[keep]))
        taken_query[pairs.rows[keep]] = taken_keyframe[pairs.columns[keep]] = True
    for category in _in_both(query_classes, keyframe_classes):
        if category == BACKGROUND:
            continue
        rows = np.flatnonzero(query_classes == category).astype(np.int32)
        columns = np.flatnonzero(keyframe_classes == category).astype(np.int32)
        pairs = _mutual(close, dtype, rows, columns)
        keep = pairs.passing(options.ratio**power, ceiling) & ~taken_query[pairs.rows] & ~taken_keyframe[pairs.columns]
        found.append((pairs.rows[keep], pairs.columns[keep]))
    i = np.concatenate([pair[0] for pair in found]) if found else np.zeros(0, np.int32)
    j = np.concatenate([pair[1] for pair in found]) if found else np.zeros(0, np.int32)
    same = (query_classes[i] == keyframe_classes[j]) & (query_classes[i] != BACKGROUND)
    return Matches(i, j, distance_of(close[i, j], dtype), same)


def _sorted(blocks: Sequence[Matches]) -> Matches:
    """The pairs of all `blocks` by the query's index."""
    if not blocks:
        return no_matches()
    i, j = np.concatenate([b.query for b in blocks]), np.concatenate([b.keyframe for b in blocks])
    order = np.lexsort((j, i))
    distance = np.concatenate([b.distance for b in blocks])
    same = np.concatenate([b.same_class for b in blocks])
    return Matches(i[order], j[order], distance[order], same[order])


def match_guided(
    query_descriptors: npt.NDArray[np.generic],
    keyframe_descriptors: npt.NDArray[np.generic],
    query_xy: FloatArray,
    projected_xy: FloatArray,
    query_classes: IntArray,
    keyframe_classes: IntArray,
    options: MatchingOptions | None = None,
    *,
    query_signs: npt.NDArray[np.int8] | None = None,
    keyframe_signs: npt.NDArray[np.int8] | None = None,
) -> Matches:
    """Second matching with a pose at hand: only keypoints near the projection of a keyframe's points compete.

    `query_xy` ``[n, 2]`` are undistorted pixels, `projected_xy` ``[m, 2]`` those of the keyframe's 3D points in
    the query's camera (NaN where a point is behind it or has no depth). Nearest and second nearest are taken
    among the keypoints within `guided_radius_px`, so that repeated texture elsewhere does not reject a pair.
    """
    options = options or MatchingOptions()
    visible = np.flatnonzero(np.isfinite(projected_xy).all(axis=1))
    if len(query_descriptors) == 0 or len(visible) == 0:
        return no_matches()
    query_descriptors, keyframe_descriptors = of_one_kind(query_descriptors, keyframe_descriptors)
    if query_signs is None or keyframe_signs is None:
        query_signs, keyframe_signs = np.zeros(len(query_xy), np.int8), np.zeros(len(projected_xy), np.int8)
    i, j = _pairs_within(
        query_xy, projected_xy[visible], query_signs, keyframe_signs[visible], options.guided_radius_px
    )
    j = visible[j].astype(np.int32)
    same_class = (query_classes[i] == keyframe_classes[j]) & (query_classes[i] != BACKGROUND)
    if options.evidence is Evidence.OBJECTS:
        i, j, same_class = i[same_class], j[same_class], same_class[same_class]
    distance = _paired_distances(query_descriptors, keyframe_descriptors, i, j)
    ratio = options.guided_ratio ** _ratio_power(query_descriptors.dtype)
    ceiling = _guided_ceiling(query_descriptors, options)
    best, second = _two_least(distance, i, len(query_descriptors))
    best_back, _ = _two_least(distance, j, len(keyframe_descriptors))
    accepted = (
        (distance <= best[i]) & (distance <= best_back[j]) & (distance < ceiling) & (distance < ratio * second[i])
    )
    order = np.flatnonzero(accepted)
    order = order[np.lexsort((j[order], i[order]))]
    return Matches(i[order], j[order], distance[order], same_class[order])


def _pairs_within(
    first: FloatArray,
    second: FloatArray,
    first_signs: npt.NDArray[np.int8],
    second_signs: npt.NDArray[np.int8],
    radius: float,
) -> tuple[IntArray, IntArray]:
    """Indexes of all pairs of points ``[n, 2]`` and ``[m, 2]`` of equal sign that are at most `radius` apart."""
    from semdb.localization.matching_kernels import count_near

    x, y = np.ascontiguousarray(first[:, 0]), np.ascontiguousarray(first[:, 1])
    to_x, to_y = np.ascontiguousarray(second[:, 0]), np.ascontiguousarray(second[:, 1])
    order = np.argsort(x, kind="stable")
    room = 8 * (len(first) + len(second))
    while True:
        i, j = np.empty(room, np.int32), np.empty(room, np.int32)
        found = count_near(x, y, first_signs, order, to_x, to_y, second_signs, radius, i, j)
        if found <= room:
            return i[:found], j[:found]
        room = found


def _paired_distances(
    first: npt.NDArray[np.generic], second: npt.NDArray[np.generic], i: IntArray, j: IntArray
) -> Float32Array:
    """Distances of rows `i` of one with rows `j` of the other, ``[k]``."""
    if first.dtype == np.uint8:
        differing = np.bitwise_count(np.asarray(first[i], np.uint8) ^ np.asarray(second[j], np.uint8))
        return np.asarray(differing.sum(axis=1), np.float32)
    from semdb.localization.matching_kernels import dot_byte_pairs, dot_pairs

    if first.dtype == np.int8:
        products = np.empty(len(i), np.int32)
        dot_byte_pairs(np.asarray(first, np.int8), np.asarray(second, np.int8), i, j, products)
        return _distance_of_products(products)
    product = np.empty(len(i), np.float32)
    dot_pairs(np.asarray(first, np.float32), np.asarray(second, np.float32), i, j, product)
    return np.asarray(np.maximum(2 - 2 * product, 0), np.float32)


def _two_least(values: Float32Array, groups: IntArray, count: int) -> tuple[Float32Array, Float32Array]:
    """Least and second least of the `values` of each of `count` groups; inf where there is none."""
    from semdb.localization.matching_kernels import two_least

    least, second = np.full(count, np.inf, np.float32), np.full(count, np.inf, np.float32)
    two_least(values, groups, least, second)
    return least, second


def _guided_ceiling(descriptors: npt.NDArray[np.generic], options: MatchingOptions) -> float:
    """A pair without competitors must still look alike: of bits at most a quarter may differ."""
    return descriptors.shape[1] * 8 * 0.25 if descriptors.dtype == np.uint8 else options.guided_ceiling
