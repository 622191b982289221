"""Closures that bundle adjustment finds: keyframes far apart in time that share points with each other.

Views from quite different sides have few pairs that stand out in the whole of both images. Where all keyframes together
say how two lie to each other, to a centimetre, pairs are looked for at their projections, and more are found. Whether
these alone put the two keyframes where all others do is then measured, both ways, as of any closure.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from semdb.geometry import invert_pose
from semdb.trajectory.adjustment import SharedPoints
from semdb.trajectory.depth_views import depth_agreement
from semdb.trajectory.edges import Edge, EdgeKind
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.measuring import measure
from semdb.trajectory.observations import FrameObservations
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.solving import Sharing, Solution
from semdb.types import Float32Array, FloatArray, IntArray

CELLS = 4  # along each side of an image


def ties(
    sharings: Sequence[Sharing],
    pairs: Collection[tuple[int, int]],
    keyframes: Keyframes,
    solution: Solution,
    options: TrajectoryOptions,
) -> list[Edge]:
    """Edges between those of `pairs` that share enough points, measured by these alone."""
    found = []
    for sharing in sharings:
        place = {number: n for n, number in enumerate(sharing.members)}
        for first, second in sorted(pairs):
            if first in place and second in place:
                edge = _tie(sharing, place, first, second, keyframes, solution, options)
                if edge is not None:
                    found.append(edge)
    return found


def _tie(
    sharing: Sharing,
    place: dict[int, int],
    first: int,
    second: int,
    keyframes: Keyframes,
    solution: Solution,
    options: TrajectoryOptions,
) -> Edge | None:
    limits = options.closures
    one, two = _in_both(sharing, place[first], place[second])
    if len(one) < limits.tie_points:
        return None
    shared = sharing.shared
    spreads = [_spread(keyframes, first, shared.keypoint[one]), _spread(keyframes, second, shared.keypoint[two])]
    if min(spreads) < limits.tie_spread:
        return None
    expected = invert_pose(solution.poses[first]) @ solution.poses[second]
    depths = keyframes.all[first].depth, keyframes.all[second].depth
    agreement = depth_agreement(*depths, expected)
    if agreement is not None and agreement < limits.least_agreement:
        return None
    sights = {
        (first, second): _sights(first, shared, one, two),
        (second, first): _sights(second, shared, two, one),
    }
    kinds = keyframes.all[first].piece == keyframes.all[second].piece
    kind = EdgeKind.LOOP if kinds else EdgeKind.SESSION
    edge = Edge(first, second, kind, expected, np.eye(6), len(one))
    return measure(edge, sights, keyframes, solution, options)


def _in_both(sharing: Sharing, first: int, second: int) -> tuple[IntArray, IntArray]:
    """Rows of observations of the points that both see: one of each point, of either keyframe ``[s]``."""
    shared = sharing.shared
    rows = [np.flatnonzero(sharing.agree & (shared.image == image)) for image in (first, second)]
    _, one, two = np.intersect1d(shared.point[rows[0]], shared.point[rows[1]], return_indices=True)
    return rows[0][one].astype(np.int32), rows[1][two].astype(np.int32)


def _sights(anchor: int, shared: SharedPoints, there: IntArray, own: IntArray) -> FrameObservations:
    """What a keyframe (rows `own`) saw of keypoints of `anchor` (rows `there`)."""

    def small(values: FloatArray) -> Float32Array:
        return values[own].astype(np.float32)

    return FrameObservations(
        keyframe=np.full(len(own), anchor, np.int32),
        keypoint=shared.keypoint[there],
        xy=small(shared.xy),
        sigma=small(shared.sigma),
        aligned=shared.aligned[own] & shared.aligned[there],
        depth=small(shared.depth),
        row=small(shared.row),
    )


def _spread(keyframes: Keyframes, number: int, keypoints: IntArray) -> float:
    """Share of the cells of a 4x4 grid over a keyframe's image that hold one of its `keypoints`."""
    view = keyframes.all[number].view
    size = np.array([view.camera.width, view.camera.height])
    cells = np.clip((view.seen_xy[keypoints] * CELLS / size).astype(int), 0, CELLS - 1)
    return len(np.unique(cells[:, 0] * CELLS + cells[:, 1])) / CELLS**2
