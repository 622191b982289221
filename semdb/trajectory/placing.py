"""Frames between keyframes, placed again once these have moved: from what was seen when they were tracked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semdb.geometry import invert_pose, transform_points
from semdb.geometry.stacks import invert_poses
from semdb.localization.bundle import BundleProblem, MotionPrior, adjust
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.observations import FrameObservations
from semdb.trajectory.options import AdjustmentOptions
from semdb.trajectory.solving import Solution
from semdb.types import FloatArray

LEAST_PAIRS = 12  # fewer leave a frame where its keyframe carries it
HELD_M, HELD_RAD = 3e-4, 1e-4  # how far keyframes that were adjusted may still move, at a distance of 1


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
    turned, and how noisy pixels are; `guess` and `turn` ``[3]`` are of the frame.
    """
    if len(observations) < LEAST_PAIRS or solution.turns is None:
        return None
    numbers = np.unique(observations.keyframe)
    problem = _problem(observations, numbers, keyframes, poses, solution, turn, options)
    residual = solution.residual_turn_rad
    prior = MotionPrior(residual, HELD_M, HELD_RAD, min(options.least_turn_rad, residual))
    try:
        found = adjust(problem, invert_pose(guess), prior)
    except np.linalg.LinAlgError:
        return None
    pose = invert_pose(found.camera_from_world)
    if found.covariance is None or not np.isfinite(pose).all():
        return None
    return pose, found.covariance


def _problem(
    observations: FrameObservations,
    numbers: np.ndarray[tuple[int], np.dtype[np.int32]],
    keyframes: Keyframes,
    poses: Mapping[int, FloatArray],
    solution: Solution,
    turn: FloatArray,
    options: AdjustmentOptions,
) -> BundleProblem:
    """Each pair is a point that the frame and one keyframe see."""
    count, slot = len(observations), np.searchsorted(numbers, observations.keyframe)
    own, theirs, points = np.empty((count, 5)), np.empty((count, 5)), np.empty((count, 3))  # x, y, sigma, depth, row
    own[:, :2], own[:, 3], own[:, 4] = observations.xy, observations.depth, observations.row
    for which, number in enumerate(numbers.tolist()):
        here, view = slot == which, keyframes.all[number].view
        rows = observations.keypoint[here]
        theirs[here, :2], theirs[here, 3], theirs[here, 4] = view.xy[rows], view.points[rows, 2], view.image_row[rows]
        aligned = options.aligned_sigma_px * solution.noise_px[0] / view.focal
        loose = observations.sigma[here] * solution.noise_px[1]
        own[here, 2] = theirs[here, 2] = np.where(observations.aligned[here], aligned, loose)
        points[here] = transform_points(poses[number], view.points[rows])
    both = np.stack([own, theirs], axis=1).reshape(-1, 5)
    image = np.stack([np.zeros(count, np.int32), slot.astype(np.int32) + 1], axis=1).ravel()
    turns = np.zeros((0, 3)) if solution.turns is None else solution.turns[numbers]
    return BundleProblem(
        points=points,
        observed_point=np.repeat(np.arange(count, dtype=np.int32), 2),
        observed_image=image,
        xy=both[:, :2],
        sigma=both[:, 2],
        depth=both[:, 3],
        rows=both[:, 4],
        keyframe_from_world=invert_poses(np.stack([poses[number] for number in numbers.tolist()])),
        expected_turn=np.concatenate([turn[None], turns]),
    )
