"""Frames between keyframes, placed again once these have moved: from what was seen when they were tracked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semdb.geometry import invert_pose, transform_points
from semdb.geometry.sensor import depth_noise
from semdb.geometry.stacks import invert_poses
from semdb.localization.bundle import (
    CAUCHY_SQUARED,
    FIRST_ITERATIONS,
    IGNORED,
    LEAST_GAIN,
    LEAST_STEP,
    NORMAL_MEDIAN,
)
from semdb.localization.sandwich import PARAMETERS_OF_QUERY, angle_between_views, cells_of, sandwich
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.observations import FrameObservations
from semdb.trajectory.options import AdjustmentOptions
from semdb.trajectory.solving import Solution
from semdb.types import FloatArray, IntArray

LEAST_PAIRS = 12  # fewer leave a frame where its keyframe carries it
MOST_ITERATIONS = 15


def place_again(
    observations: FrameObservations,
    keyframes: Keyframes,
    poses: Mapping[int, FloatArray],
    solution: Solution,
    guess: FloatArray,
    turn: FloatArray,
    options: AdjustmentOptions,
) -> tuple[FloatArray, FloatArray] | None:
    """Pose ``[4, 4]`` and covariance ``[6, 6]`` (in the world, as localization gives it) of a frame; None without one.

    `poses` ``[4, 4]`` are those of the keyframes that were seen, by number; they are held. `solution` knows how they
    turned, and how noisy pixels are; `guess` and `turn` ``[3]`` are of the frame. Its depth joins after some steps, as
    far as it agrees with what these show.
    """
    from semdb.trajectory.placing_kernels import minimise

    if len(observations) < LEAST_PAIRS or solution.turns is None:
        return None
    numbers = np.unique(observations.keyframe)
    slot = np.searchsorted(numbers, observations.keyframe).astype(np.int32) + 1
    own, theirs, points = _observed(observations, numbers, slot, keyframes, poses, solution, options)
    held = np.stack([poses[number] for number in numbers.tolist()])
    images = np.concatenate([invert_pose(guess)[None], invert_poses(held)])
    turns = np.concatenate([turn[None], solution.turns[numbers]])
    residual = max(solution.residual_turn_rad, options.least_turn_rad)
    matrix, pulls = np.zeros((PARAMETERS_OF_QUERY,) * 2), np.zeros((len(points), PARAMETERS_OF_QUERY))
    for most in (FIRST_ITERATIONS, MOST_ITERATIONS):
        own[:, 5] = IGNORED if most == FIRST_ITERATIONS else _looser(own[:, 3], points, images[0])
        if not minimise(
            points, slot, images, turns, own, theirs, CAUCHY_SQUARED, turn, 1 / residual**2, most, LEAST_GAIN,
            LEAST_STEP, matrix, pulls,
        ):  # fmt: skip
            return None
    prior = np.repeat([0.0, 1 / residual**2], [6, 3])
    cells = cells_of(own[:, :2])
    grouped = np.zeros((int(cells.max()) + 1, PARAMETERS_OF_QUERY))
    np.add.at(grouped, cells, pulls)
    pose = invert_pose(images[0])
    angle = angle_between_views(pose[:3, 3], held[slot - 1, :3, 3], points)
    try:
        return pose, sandwich(matrix, grouped, prior, np.ones(PARAMETERS_OF_QUERY), angle, images[0])
    except np.linalg.LinAlgError:
        return None


def _observed(
    observations: FrameObservations,
    numbers: IntArray,
    slot: IntArray,
    keyframes: Keyframes,
    poses: Mapping[int, FloatArray],
    solution: Solution,
    options: AdjustmentOptions,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What the frame and what keyframes saw ``[n, 6]`` (x, y, sigma, depth, row, factor of the depth's noise) of points
    ``[n, 3]``: each pair is one, that the frame and one keyframe see.
    """
    count = len(observations)
    own, theirs, points = np.ones((count, 6)), np.ones((count, 6)), np.empty((count, 3))
    own[:, :2], own[:, 3], own[:, 4] = observations.xy, observations.depth, observations.row
    loose = observations.sigma * solution.noise_px[1]
    for which, number in enumerate(numbers.tolist(), start=1):
        here, view = slot == which, keyframes.all[number].view
        rows = observations.keypoint[here]
        theirs[here, :2], theirs[here, 3], theirs[here, 4] = view.xy[rows], view.points[rows, 2], view.image_row[rows]
        aligned = options.aligned_sigma_px * solution.noise_px[0] / view.focal
        own[here, 2] = theirs[here, 2] = np.where(observations.aligned[here], aligned, loose[here])
        points[here] = transform_points(poses[number], view.points[rows])
    return own, theirs, points


def _looser(depth: FloatArray, points: FloatArray, camera_from_world: FloatArray) -> float:
    """How many times the sensor's noise a frame's `depth` ``[n]`` has, as `points` ``[n, 3]`` show it."""
    known = np.isfinite(depth)
    if not known.any():
        return 1.0
    z = points[known] @ camera_from_world[2, :3] + camera_from_world[2, 3]
    excess = float(np.median(np.abs(z - depth[known]) / depth_noise(depth[known]))) * NORMAL_MEDIAN
    return max(1.0, excess) ** 2
