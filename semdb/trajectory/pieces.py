"""Stretches that tracking did not join: which of them closures join, and how they lie to each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semdb.geometry import invert_pose
from semdb.trajectory.edges import Edge, EdgeState
from semdb.types import FloatArray


def components_of(pieces: Sequence[int], edges: Sequence[Edge]) -> list[int]:
    """Which component each keyframe is in ``[n]``; components are numbered by their first keyframe.

    `pieces` ``[n]`` is the piece of each keyframe; accepted edges join pieces.
    """
    root = list(range(max(pieces, default=-1) + 1))

    def find(piece: int) -> int:
        while root[piece] != piece:
            piece = root[piece]
        return piece

    for edge in edges:
        if edge.state is EdgeState.ACCEPTED:
            one, two = find(pieces[edge.first]), find(pieces[edge.second])
            root[max(one, two)] = min(one, two)
    return [find(piece) for piece in pieces]


def brought_together(poses: FloatArray, pieces: Sequence[int], edges: Sequence[Edge]) -> FloatArray:
    """`poses` ``[n, 4, 4]`` with pieces that accepted edges join moved into one world: that of the least piece.

    The edges with most inliers lay piece to piece; the pose graph does the rest.
    """
    moved, world = poses.copy(), list(pieces)
    joining = [e for e in edges if e.state is EdgeState.ACCEPTED and pieces[e.first] != pieces[e.second]]
    for edge in sorted(joining, key=lambda e: (-e.inliers, e.first, e.second)):
        one, two = world[edge.first], world[edge.second]
        if one == two:
            continue
        there = moved[edge.first] @ edge.first_from_second
        if one < two:
            motion, goes, stays = there @ invert_pose(moved[edge.second]), two, one
        else:
            motion, goes, stays = moved[edge.second] @ invert_pose(there), one, two
        for n in range(len(moved)):
            if world[n] == goes:
                moved[n], world[n] = motion @ moved[n], stays
    return moved


def held_of(components: Sequence[int]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """The first keyframe of each component ``[n]``: where its world is."""
    first: dict[int, int] = {}
    for number, component in enumerate(components):
        first.setdefault(component, number)
    held = np.zeros(len(components), np.bool_)
    held[list(first.values())] = True
    return held
