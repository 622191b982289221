"""What speaks for and against two sightings being one thing.

Of two sightings a and b of different keyframes: how far the visible points of a lie in the mask of b, and those of b in
the mask of a (`overlap`, an intersection over union that does not depend on how densely either is sampled); what other
keyframes say that see both, where both lie in one mask (`agree`) or in two (`conflict`); and their classes. Keyframes
are sparse, so counts are thin: none of these decides alone, and their weights are log odds.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.compiled import kernel
from semdb.landmarks.clustering import UNIT
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.options import LinkOptions
from semdb.landmarks.visibility import VISIBLE, Sightings, Views
from semdb.types import FloatArray, Int64Array, IntArray

LEAST_VISIBLE = 8  # points, and this share of them: from here on a view has a say
VISIBLE_SHARE = 0.25
IN_MASK = 0.6  # share of the visible points in one mask
THIN = 0.5  # most that speaks for a pair of which next to nothing is seen
NOT_SEEN, NO_MASK = -1, 0


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Pairs of sightings a < b of different keyframes that touch, by a and b; `e` of them."""

    a: Int64Array  # [e]
    b: Int64Array  # [e]
    overlap: FloatArray  # [e] 0..1, NaN where neither keyframe sees the other's points
    silhouette: FloatArray  # [e] as overlap, with points not far behind a mask
    evidence: IntArray  # [e] visible points that `overlap` rests on
    agree: IntArray  # [e] other keyframes
    conflict: IntArray  # [e]


def signatures(sightings: Sightings, views: Views) -> Int64Array:
    """The label of the mask that each pair of `views` lies in ``[p]``; `NO_MASK`, or `NOT_SEEN` where too little is."""
    visible = views.seen[:, VISIBLE]
    enough = (visible >= LEAST_VISIBLE) & (visible >= VISIBLE_SHARE * sightings.count[views.sighting])
    signature = np.where(enough, NO_MASK, NOT_SEEN).astype(np.int64)
    inside = (views.overlap_label > 0) & (views.overlap[:, 0] >= IN_MASK * visible[views.overlap_pair])
    inside &= views.overlap[:, 0] > 0
    inside &= enough[views.overlap_pair]
    signature[views.overlap_pair[inside]] = views.overlap_label[inside]
    own = views.keyframe == sightings.keyframe[views.sighting]
    signature[own] = sightings.label[views.sighting[own]]
    return signature


def sighting_table(lifted: Sequence[LiftedKeyframe], sightings: Sightings) -> tuple[Int64Array, Int64Array]:
    """`offset` ``[keyframes + 1]`` and `number` ``[labels]``: ``number[offset[k] + label - 1]``, -1 without place."""
    counts = np.array([len(frame.points) for frame in lifted], np.int64)
    offset = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    number = np.full(int(offset[-1]), -1, np.int64)
    number[offset[sightings.keyframe] + sightings.label - 1] = np.arange(len(sightings))
    return offset, number


def find_links(lifted: Sequence[LiftedKeyframe], sightings: Sightings, views: Views) -> Links:
    """All pairs of sightings that share points, or that see each other and whose boxes meet."""
    offset, number = sighting_table(lifted, sightings)
    n = len(sightings)
    keyframe = views.keyframe[views.overlap_pair]
    labelled = views.overlap_label > 0
    one = views.sighting[views.overlap_pair][labelled]
    other = number[offset[keyframe[labelled]] + views.overlap_label[labelled] - 1]
    there = (other >= 0) & (keyframe[labelled] != sightings.keyframe[one])
    one, other = one[there], other[there]
    touch = views.overlap[labelled][there]
    # directed: what of `one` lies in `other`
    keys, first = np.unique(one * n + other, return_index=True)
    inside, behind = touch[first, 0], touch[first, 1]
    pair_key = views.sighting * len(lifted) + views.keyframe  # sorted
    low, high = np.minimum(one, other), np.maximum(one, other)
    edges = np.unique(low * n + high)
    a, b = np.divmod(edges, n) if n else (edges, edges)

    def directed(x: Int64Array, y: Int64Array) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Of points of `x` in the keyframe of `y`: in its mask, behind it, visible, and visible or near behind."""
        place = np.searchsorted(keys, x * n + y)
        place_c = np.minimum(place, max(len(keys) - 1, 0))
        hit = keys[place_c] == x * n + y if len(keys) else np.zeros(len(x), np.bool_)
        view = np.searchsorted(pair_key, x * len(lifted) + sightings.keyframe[y])
        view_c = np.minimum(view, max(len(pair_key) - 1, 0))
        seen = pair_key[view_c] == x * len(lifted) + sightings.keyframe[y] if len(pair_key) else hit
        visible = np.where(seen, views.seen[view_c, VISIBLE], 0)
        near = np.where(seen, behind_any[view_c], 0)
        return np.where(hit, inside[place_c], 0), np.where(hit, behind[place_c], 0), visible, visible + near

    behind_any = np.bincount(views.overlap_pair, views.overlap[:, 1], len(views.sighting)).astype(np.int64)
    in_ab, behind_ab, vis_ab, all_ab = directed(a, b)
    in_ba, behind_ba, vis_ba, all_ba = directed(b, a)
    overlap = _union_share(in_ab, vis_ab, in_ba, vis_ba)
    silhouette = _union_share(in_ab + behind_ab, all_ab, in_ba + behind_ba, all_ba)
    evidence = np.minimum(vis_ab, vis_ba).astype(np.int32)
    signature = signatures(sightings, views)
    start = np.searchsorted(views.sighting, np.arange(n + 1)).astype(np.int64)
    agree, conflict = np.zeros(len(a), np.int32), np.zeros(len(a), np.int32)
    third_views(a, b, sightings.keyframe, start, views.keyframe, signature, agree, conflict)
    return Links(a, b, overlap, silhouette, evidence, agree, conflict)


def _union_share(in_ab: IntArray, of_ab: IntArray, in_ba: IntArray, of_ba: IntArray) -> FloatArray:
    """Intersection over union of two surfaces from the shares that lie in each other; a guess from one share."""
    with np.errstate(divide="ignore", invalid="ignore"):
        p, q = in_ab / of_ab, in_ba / of_ba
        both = 1 / (1 / p + 1 / q - 1)
        one = np.where(of_ab > 0, p, q)  # a part of the truth: a small thing lies in a large one altogether
        found = np.where((of_ab > 0) & (of_ba > 0), np.where((p > 0) & (q > 0), both, 0.0), one * 0.5)
    return np.asarray(found, np.float64)


def weights(links: Links, category: Int64Array, names: FloatArray, options: LinkOptions) -> Int64Array:
    """Whole weights int64 ``[e]`` (thousandths of log odds) of being one thing.

    `category` ``[n]`` is the class of each sighting, `names` what a thing of a class is called.
    """
    overlap = np.minimum(np.nan_to_num(links.overlap), options.most_overlap)
    one, other = category[links.a], category[links.b]
    mixed = np.maximum(names, names.T)
    known = mixed[one, other] > 2 * float(names.min()) if names.size else np.zeros(len(one), np.bool_)
    of_class = np.where(known, options.taken_for, options.other_class)
    of_class = np.where(one == other, options.same_class, of_class)
    weight = options.bias + options.overlap * overlap + of_class
    weight += options.agree * np.minimum(links.agree, options.most_views)
    weight += options.conflict * np.minimum(links.conflict, options.most_views)
    thin = (links.evidence < LEAST_VISIBLE) & (links.agree + links.conflict == 0)
    weight = np.where(thin, np.minimum(weight, THIN), weight)
    return np.rint(weight * UNIT).astype(np.int64)


@kernel
def third_views(a, b, keyframe, start, view_keyframe, signature, agree, conflict):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Counts keyframes, other than those of a and b, where both lie in one mask, and where they lie in two."""
    for e in range(len(a)):
        i, j = start[a[e]], start[b[e]]
        i_end, j_end = start[a[e] + 1], start[b[e] + 1]
        while i < i_end and j < j_end:
            f, g = view_keyframe[i], view_keyframe[j]
            if f < g:
                i += 1
            elif g < f:
                j += 1
            else:
                if f != keyframe[a[e]] and f != keyframe[b[e]]:
                    s, t = signature[i], signature[j]
                    if s > 0 and t > 0:
                        if s == t:
                            agree[e] += 1
                        else:
                            conflict[e] += 1
                i += 1
                j += 1
