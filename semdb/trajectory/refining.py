"""Poses of keyframes that are known, made consistent with what their images say: closures, pose graph, adjustment.

Recorded trajectories disagree with their images by centimetres. The keyframes' steps are believed as far as such
trajectories drift, closures that agree tie them together, and bundle adjustment over all of them has the last word. The
world stays where it was: the result lies on the given poses as well as one motion can lay it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.geometry import pose_from, project_to_so3
from semdb.trajectory.closures import ClosureSearch
from semdb.trajectory.consistency import chain_of, consistent
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.finish import SHARED_VARIANCE, keyframe_covariances
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.measuring import measured_again
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.sessions import StepNoise, chain_links, step_covariances
from semdb.trajectory.solving import Solution, adjust_components, solve_graph
from semdb.types import FloatArray

Progress = Callable[[str, int, int], None]
DRIFT = StepNoise(0.003, 0.02, 0.003, 0.02)
LOOKING = "looking for closures"  # what progress is told of
UNSURE = 1e4  # times the variance of a step: between recordings, whose frames need not be the same to a centimetre


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """`noise`: how far given poses may be off from step to step. `rounds` of looking for closures."""

    noise: StepNoise = DRIFT
    rounds: int = 2
    trajectory: TrajectoryOptions = field(default_factory=TrajectoryOptions)


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPoses:
    """Poses ``[n, 4, 4]``, covariances ``[n, 6, 6]`` (left perturbations), and closures as numbers of keyframes."""

    poses: FloatArray
    covariances: FloatArray
    closures: tuple[Edge, ...]


def refine_keyframes(
    keyframes: Keyframes,
    first_of_recording: Sequence[bool],
    options: PoseOptions | None = None,
    progress: Progress | None = None,
) -> RefinedPoses:
    """Better poses for `keyframes` of one world, in the order of recordings and frames.

    `first_of_recording` ``[n]`` marks those with no step to the one before. Fewer than two stay where they are.
    """
    options = options or PoseOptions()
    given = np.array(keyframes.poses).reshape(-1, 4, 4)
    count = len(given)
    world = [0] * count
    if count < 2:
        return RefinedPoses(given, np.zeros((count, 6, 6)), ())
    steps = step_covariances(given, options.noise)
    steps[np.asarray(first_of_recording, np.bool_)] *= UNSURE
    links = chain_links(given, steps)
    odometry = [
        Edge(int(a), int(b), EdgeKind.ODOMETRY, relative, information, 0)
        for a, b, relative, information in zip(
            links.first, links.second, links.first_from_second, links.information, strict=True
        )
    ]
    chain = chain_of(given, world, steps)
    search = ClosureSearch(keyframes, options.trajectory)
    solution, closures = Solution(given, world), list[Edge]()
    for _ in range(options.rounds):
        search.look(sorted({*search.alike(), *search.near(world)}), _told(progress, LOOKING))
        closures = consistent(search.edges, chain, options.trajectory.consistency)
        accepted = [edge for edge in closures if edge.state is EdgeState.ACCEPTED]
        solution = solve_graph(solution.poses, world, [*odometry, *accepted])
        keyframes.move(solution.poses)
    solution, _ = adjust_components(
        keyframes, solution, lambda _poses: np.zeros((count, 3)), options.trajectory, search.near, progress
    )
    closures = measured_again(closures, search.sights, keyframes, solution, options.trajectory)
    counted = [edge for edge in closures if edge.state is EdgeState.ACCEPTED]
    spread = SHARED_VARIANCE * keyframe_covariances(solution, [*odometry, *counted])
    poses = laid_on(solution.poses, given)
    turn = np.zeros((count, 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = poses[:, :3, :3]
    return RefinedPoses(poses, turn @ spread @ np.swapaxes(turn, 1, 2), tuple(closures))


def laid_on(poses: FloatArray, given: FloatArray) -> FloatArray:
    """`poses` ``[n, 4, 4]`` moved as one, so that they are nearest to `given` in turn and, then, in place."""
    relative = given[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)
    rotation = project_to_so3(relative.sum(axis=0))
    shift = (given[:, :3, 3] - poses[:, :3, 3] @ rotation.T).mean(axis=0)
    return np.asarray(pose_from(rotation, shift) @ poses)


def _told(progress: Progress | None, what: str) -> Callable[[int, int], None] | None:
    return None if progress is None else lambda done, total: progress(what, done, total)


def between_recordings(edges: Sequence[Edge], recording: Sequence[int]) -> list[Edge]:
    """`edges`, those between keyframes of different recordings of kind session."""
    return [
        replace(edge, kind=EdgeKind.SESSION) if recording[edge.first] != recording[edge.second] else edge
        for edge in edges
    ]
