"""Tracks: keypoints of different keyframes that are the same point of the scene."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.compiled import kernel
from semdb.types import Float32Array, Int64Array, IntArray


def join_tracks(
    first: Int64Array, second: Int64Array, distance: Float32Array, frame_of: IntArray
) -> tuple[Int64Array, Int64Array]:
    """Joins matched nodes to tracks that hold at most one node of each frame.

    A node is a keypoint of a frame: `frame_of` ``[n]``. Matches `first`, `second`, `distance` ``[m]`` are joined from
    the most alike on; one that would bring two nodes of a frame into one track is left out. The result does not depend
    on the order of the matches, nor on which of the two nodes comes first.
    Returns the nodes of all tracks of two or more, ascending within a track and tracks by their first node, and where
    each track starts ``[t + 1]``.
    """
    low, high = np.minimum(first, second), np.maximum(first, second)
    order = np.lexsort((high, low, distance))
    following, root = np.arange(len(frame_of)), np.arange(len(frame_of))
    _join(low[order], high[order], np.asarray(frame_of, np.int32), following, root)
    by_track = np.lexsort((np.arange(len(root)), root))
    sizes = np.bincount(root, minlength=len(root))
    nodes = by_track[sizes[root[by_track]] > 1]
    # a root is any node of its track: tracks by their first node need another sort
    heads = np.flatnonzero(np.r_[True, root[nodes][1:] != root[nodes][:-1]]) if len(nodes) else np.zeros(0, np.int64)
    lengths = np.diff(np.r_[heads, len(nodes)])
    order = np.argsort(nodes[heads], kind="stable")
    starts = np.r_[0, np.cumsum(lengths[order])].astype(np.int64)
    place = np.repeat(heads[order] - starts[:-1], lengths[order]) + np.arange(len(nodes))
    return nodes[place].astype(np.int64), starts


@kernel
def _join(first: Any, second: Any, frame_of: Any, following: Any, root: Any) -> None:
    """Union by ring: `following` links the nodes of a track, `root` ``[n]`` names it in the end."""
    for k in range(len(first)):
        a, b = first[k], second[k]
        if root[a] == root[b] or _share_a_frame(a, b, frame_of, following):
            continue
        name = root[a]
        node = b
        while True:
            root[node] = name
            node = following[node]
            if node == b:
                break
        following[a], following[b] = following[b], following[a]


@kernel
def _share_a_frame(a: int, b: int, frame_of: Any, following: Any) -> bool:
    one = a
    while True:
        two = b
        while True:
            if frame_of[one] == frame_of[two]:
                return True
            two = following[two]
            if two == b:
                break
        one = following[one]
        if one == a:
            break
    return False


def pairs_of_tracks(nodes: Int64Array, starts: Int64Array) -> tuple[Int64Array, Int64Array]:
    """All ordered pairs of two nodes of one track, ``[p]`` each, by the first node's place."""
    lengths = np.diff(starts)
    own = np.repeat(lengths, lengths)  # of each node's track
    begin = np.repeat(starts[:-1], lengths)
    one = np.repeat(np.arange(len(nodes)), own)
    within: npt.NDArray[np.int64] = np.arange(len(one)) - np.repeat(np.cumsum(own) - own, own)
    two = begin[one] + within
    keep = one != two
    return nodes[one[keep]], nodes[two[keep]]
