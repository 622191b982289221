"""Edges measured again once it is known how each keyframe turned while it was read out.

While keyframes were looked at two by two, the turn of each was a guess of its own, and a guess too many: it takes part
of the parallax for a turn. Bundle adjustment over all of them knows it. So each edge is fitted again to the pairs that
made it; a closure that then disagrees with where all keyframes together put it does not count any more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp
from semdb.geometry.stacks import adjoints, differences
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.observations import FrameObservations
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.placing import place_again
from semdb.trajectory.solving import Solution
from semdb.types import FloatArray

Sights = Mapping[tuple[int, int], FrameObservations]  # (anchor, query): what keyframe `query` saw of `anchor`


def joined(
    forth: FloatArray, forth_spread: FloatArray, back: FloatArray, back_spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One relative pose ``[4, 4]`` and its covariance of two: one of the second keyframe in the frame of the first
    (`forth`), one of the first in that of the second (`back`), each with the covariance of a right perturbation.

    Both come from the same images, so together they are no surer than one; where they differ they are less sure.
    """
    turned = invert_pose(back)
    moved = adjoints(back[None])[0]
    apart = differences(forth[None], turned[None])[0]
    middle = forth @ pose_from(so3_exp(apart[3:] / 2), apart[:3] / 2)
    spread = (forth_spread + moved @ back_spread @ moved.T) / 2 + np.outer(apart, apart) / 4
    return middle, spread


def measured_again(
    edges: Sequence[Edge], sights: Sights, keyframes: Keyframes, solution: Solution, options: TrajectoryOptions
) -> list[Edge]:
    """`edges`, those accepted fitted again to what `sights` holds of them, closures judged by the solution."""
    if solution.turns is None:
        return list(edges)
    found: list[Edge] = []
    for edge in edges:
        if edge.state is not EdgeState.ACCEPTED:
            found.append(edge)
            continue
        again = measure(edge, sights, keyframes, solution, options) or edge
        found.append(again if edge.kind is EdgeKind.ODOMETRY else judged(again, solution, options))
    return found


def measure(
    edge: Edge, sights: Sights, keyframes: Keyframes, solution: Solution, options: TrajectoryOptions
) -> Edge | None:
    """`edge` fitted again to what `sights` holds of it; None where that does not determine it."""
    forth = _one_way(edge.first, edge.second, edge.first_from_second, sights, keyframes, solution, options)
    if forth is None:
        return None
    pose, spread = forth
    back = _one_way(edge.second, edge.first, invert_pose(pose), sights, keyframes, solution, options)
    if back is not None:
        pose, spread = joined(pose, spread, *back)
    information = np.asarray(np.linalg.inv(spread), np.float64)
    return replace(edge, first_from_second=pose, information=(information + information.T) / 2)


def _one_way(
    anchor: int,
    query: int,
    guess: FloatArray,
    sights: Sights,
    keyframes: Keyframes,
    solution: Solution,
    options: TrajectoryOptions,
) -> tuple[FloatArray, FloatArray] | None:
    """Pose ``[4, 4]`` of keyframe `query` in the frame of `anchor`, and the covariance of a right perturbation."""
    seen = sights.get((anchor, query))
    if seen is None or solution.turns is None:
        return None
    own = seen.of_keyframe(anchor)
    at = {anchor: np.eye(4)}
    found = place_again(own, keyframes, at, solution, guess, solution.turns[query], options.adjustment)
    if found is None:
        return None
    pose, in_world = found
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = pose[:3, :3].T
    return pose, turn @ in_world @ turn.T


def judged(edge: Edge, solution: Solution, options: TrajectoryOptions) -> Edge:
    """`edge`, contradicted where it is off from where all keyframes together put it."""
    there = invert_pose(solution.poses[edge.first]) @ solution.poses[edge.second]
    metres, degrees = pose_error(there, edge.first_from_second)
    if metres <= options.closures.most_off_m and degrees <= options.closures.most_off_deg:
        return edge
    reason = f"off by {metres:.3f} m and {degrees:.1f} deg from where all others put it"
    return replace(edge, state=EdgeState.CONTRADICTED, reason=reason)
