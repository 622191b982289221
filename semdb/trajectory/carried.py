"""The edges of a trajectory between other frames than its keyframes: carried from each to the nearest of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from semdb.geometry import invert_pose, pose_distances
from semdb.geometry.stacks import adjoints
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.result import Trajectory
from semdb.types import FloatArray

FARTHEST = 1.0  # `pose_distances` over which an edge is carried
STEP_M, STEP_RAD = 0.002, 0.002  # of what is not on the way from keyframe to keyframe
RANK = {EdgeState.ACCEPTED: 2, EdgeState.CONTRADICTED: 1, EdgeState.FAILED: 0}


def carried_edges(trajectory: Trajectory, chosen: Sequence[int]) -> list[Edge]:
    """Edges between the frames at positions `chosen`, ascending, of the largest piece; numbers are places in `chosen`.

    An edge between keyframes becomes one between the chosen frames nearest to them, moved along the trajectory; of
    several between the same two the one that counts, with most inliers, is kept. What follows each other is tied by
    odometry, whose covariances add up on the way.
    """
    poses = _poses(trajectory)
    at = [trajectory.keyframes[number] for number in range(len(trajectory.keyframes))]
    stacked = np.array([poses[position] for position in chosen]).reshape(-1, 4, 4)
    nearest: dict[int, int] = {}
    for number, position in enumerate(at):
        if position in poses and len(stacked):
            distance = pose_distances(poses[position], stacked)
            if distance.min() < FARTHEST:
                nearest[number] = int(np.argmin(distance))
    best: dict[tuple[int, int], Edge] = {}
    for edge in trajectory.edges:
        ends = nearest.get(edge.first), nearest.get(edge.second)
        if edge.kind is EdgeKind.ODOMETRY or ends[0] is None or ends[1] is None or ends[0] == ends[1]:
            continue
        moved = _carried(edge, at, ends[0], ends[1], chosen, poses)
        key = min(ends[0], ends[1]), max(ends[0], ends[1])
        known = best.get(key)
        if known is None or _rank(moved) > _rank(known):
            best[key] = moved
    return [*_steps(trajectory, chosen, poses), *(best[key] for key in sorted(best))]


def _poses(trajectory: Trajectory) -> dict[int, FloatArray]:
    return {frame.position: frame.world_from_camera for frame in trajectory.used if frame.world_from_camera is not None}


def _rank(edge: Edge) -> tuple[int, int]:
    return RANK[edge.state], edge.inliers


def _carried(
    edge: Edge, at: Sequence[int], first: int, second: int, chosen: Sequence[int], poses: Mapping[int, FloatArray]
) -> Edge:
    """`edge` between the chosen frames `first` and `second`."""
    before = invert_pose(poses[chosen[first]]) @ poses[at[edge.first]]
    after = invert_pose(poses[at[edge.second]]) @ poses[chosen[second]]
    move = adjoints(after[None])[0]  # a perturbation before `after`, of one behind it
    return replace(
        edge,
        first=first,
        second=second,
        first_from_second=before @ edge.first_from_second @ after,
        information=move.T @ edge.information @ move,
    )


def _steps(trajectory: Trajectory, chosen: Sequence[int], poses: Mapping[int, FloatArray]) -> list[Edge]:
    """Odometry from each of `chosen` to the next, where a chain of it leads there."""
    chain = {trajectory.keyframes[edge.second]: edge for edge in trajectory.edges if edge.kind is EdgeKind.ODOMETRY}
    found = []
    for n in range(len(chosen) - 1):
        start, end = chosen[n], chosen[n + 1]
        between = [position for position in sorted(chain) if start < position <= end and position in poses]
        spread = np.diag(np.repeat([STEP_M**2, STEP_RAD**2], 3))
        inliers = []
        for position in between:
            edge = chain[position]
            carried = adjoints((invert_pose(poses[end]) @ poses[position])[None])[0]
            spread = spread + carried @ np.linalg.inv(edge.information) @ carried.T
            inliers.append(edge.inliers)
        relative = invert_pose(poses[start]) @ poses[end]
        information = np.linalg.inv(spread)
        information = (information + information.T) / 2
        found.append(Edge(n, n + 1, EdgeKind.ODOMETRY, relative, information, min(inliers, default=0)))
    return found
