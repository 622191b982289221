"""Pose graph and bundle adjustment of keyframes, each world on its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry import invert_pose
from semdb.trajectory.adjustment import SharedPoints, adjust_keyframes
from semdb.trajectory.correspondences import shared_points
from semdb.trajectory.edges import Edge, stack_edges
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.pieces import held_of
from semdb.trajectory.pose_graph import optimise
from semdb.types import BoolArray, FloatArray

Progress = Callable[[str, int, int], None]
Rates = Callable[[FloatArray], FloatArray]
FarPairs = Callable[[Sequence[int]], Sequence[tuple[int, int]]]
AGREEING = 9.0  # squared sigmas of two pixels


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Keyframes ``[n, 4, 4]`` in worlds that `components` ``[n]`` number; `turns` ``[n, 3]`` over a readout."""

    poses: FloatArray
    components: Sequence[int]
    turns: FloatArray | None = None
    readout_s: float = 0.0
    residual_turn_rad: float = 0.02
    noise_px: tuple[float, float] = (1.0, 1.0)  # times the assumed, of aligned pixels and of others


@dataclass(frozen=True, slots=True, eq=False)
class Sharing:
    """Points that keyframes `members` share in the end, and which observations agree with them ``[k]``."""

    members: Sequence[int]
    shared: SharedPoints
    agree: BoolArray


def solve_graph(poses: FloatArray, components: Sequence[int], edges: Sequence[Edge]) -> Solution:
    """The pose graph of accepted `edges`; the first keyframe of each component is held."""
    found = optimise(poses, stack_edges(edges), held_of(components))
    return Solution(found.poses, components)


def adjust_components(
    keyframes: Keyframes,
    solution: Solution,
    rates_at: Rates,
    options: TrajectoryOptions,
    far_pairs: FarPairs | None = None,
    progress: Progress | None = None,
) -> tuple[Solution, list[Sharing]]:
    """Bundle adjustment of each component of two or more keyframes, in as many rounds as there are radii.

    `rates_at` tells how the camera turns in each keyframe ``[n, 3]`` when keyframes are at given poses, `far_pairs`
    which keyframes, far apart in time, see the same then. Also returns the points that they share in the end.
    """
    poses, turns = solution.poses.copy(), np.zeros((len(solution.poses), 3))
    numbers = np.asarray(solution.components)
    sizes = {int(c): int(np.count_nonzero(numbers == c)) for c in np.unique(numbers)}
    largest = max(sizes, key=lambda c: (sizes[c], -c), default=-1)
    sharings: list[Sharing] = []
    readout_s, residual, noise_px = 0.0, options.adjustment.residual_turn_rad, (1.0, 1.0)
    steps = len(options.adjustment.radii_px)
    for done, radius in enumerate(options.adjustment.radii_px):
        rounds = options.adjustment.noise_rounds if done + 1 == steps else 1  # rough first
        adjustment = replace(options.adjustment, noise_rounds=rounds)
        rates = rates_at(poses)
        keyframes.move(poses)
        far = [] if far_pairs is None else far_pairs(solution.components)
        sharings = []
        for component, size in sizes.items():
            if size < 2:
                continue
            members = np.flatnonzero(numbers == component)
            shared = shared_points(keyframes, members.tolist(), poses[members], radius, options, far)
            if not len(shared):
                continue
            held = np.bincount(shared.image, minlength=size) < options.adjustment.least_observations
            anchor = poses[members[0]].copy()
            held[0] = True
            found = adjust_keyframes(shared, poses[members], held, rates[members], adjustment)
            poses[members] = anchor @ invert_pose(found.poses[0]) @ found.poses
            poses[members[0]] = anchor  # exactly
            turns[members] = found.turn
            sharings.append(Sharing(members.tolist(), shared, found.chi2 < AGREEING))
            if component == largest:
                readout_s, residual, noise_px = found.readout_s, found.residual_turn_rad, found.noise_px
        if progress is not None:
            progress("bundle adjustment", done + 1, steps)
    keyframes.move(poses)
    return Solution(poses, solution.components, turns, readout_s, residual, noise_px), sharings
