"""Bundle adjustment of one query: equation (5) of the paper, with measured depth as a prior on the points.

Unknown are the query's pose and every matched 3D point; the keyframes stay where they are. A point is held by
its pixel in each keyframe that saw it and by the depth measured there, and pulls on the pose through its pixel
(and depth, where the query has one) in the query. Levenberg-Marquardt on the Schur complement, analytic
Jacobians, a Cauchy loss on each block of residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.geometry import so3_exp
from semdb.types import Float32Array, FloatArray, IntArray

CAUCHY_SQUARED = 4.0  # (2 sigma)^2: where the loss leaves the parabola


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """What was seen. Pixels are divided by the focal length: normalised, undistorted coordinates.

    `keyframe_point` says of which point each keyframe observation is; `world_from_keyframe` its pose.
    Sigmas are standard deviations in the same units as what they belong to.
    """

    points: FloatArray  # [m, 3] world, first guess
    query_xy: FloatArray  # [m, 2]
    query_sigma: FloatArray  # [m]
    query_depth: FloatArray  # [m] metres, NaN where there is none
    keyframe_point: IntArray  # [k]
    keyframe_xy: FloatArray  # [k, 2]
    keyframe_sigma: FloatArray  # [k]
    keyframe_depth: FloatArray  # [k] metres, NaN where there is none
    keyframe_rotation: FloatArray  # [k, 3, 3] keyframe_from_world
    keyframe_translation: FloatArray  # [k, 3]


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """`covariance` is of translation (m, world) and rotation (rad, left perturbation in the world)."""

    camera_from_world: FloatArray  # [4, 4]
    points: FloatArray  # [m, 3]
    covariance: FloatArray  # [6, 6]
    query_chi2: FloatArray  # [m] squared pixel residual in the query over its variance
    iterations: int


@dataclass(slots=True)
class _Blocks:
    """Normal equations: pose, points, and what couples them; `cost` is the robust cost."""

    pose: FloatArray  # [6, 6]
    pose_gradient: FloatArray  # [6]
    coupling: FloatArray  # [m, 6, 3]
    points: FloatArray  # [m, 3, 3]
    points_gradient: FloatArray  # [m, 3]
    query_chi2: FloatArray  # [m]
    cost: float = 0.0


def _linearise(problem: BundleProblem, pose: FloatArray, points: FloatArray) -> _Blocks:
    from semdb.localization.bundle_kernels import normal_equations

    count = len(points)
    blocks = _Blocks(
        np.empty((6, 6)), np.empty(6), np.empty((count, 6, 3)), np.empty((count, 3, 3)), np.empty((count, 3)),
        np.empty(count),
    )  # fmt: skip
    query = np.column_stack([problem.query_xy, problem.query_sigma, problem.query_depth])
    keyframe = np.column_stack([problem.keyframe_xy, problem.keyframe_sigma, problem.keyframe_depth])
    blocks.cost = normal_equations(
        pose, points, query, problem.keyframe_point, keyframe, problem.keyframe_rotation, problem.keyframe_translation,
        CAUCHY_SQUARED, blocks.pose, blocks.pose_gradient, blocks.coupling, blocks.points, blocks.points_gradient,
        blocks.query_chi2,
    )  # fmt: skip
    return blocks


def _reduced(blocks: _Blocks, damping: float) -> tuple[FloatArray, FloatArray]:
    """Equations ``[6, 6]`` and gradient ``[6]`` of the pose with the points eliminated."""
    from semdb.localization.bundle_kernels import reduce_to_pose

    reduced, gradient = blocks.pose * (1 + damping * np.eye(6)), blocks.pose_gradient.copy()
    reduce_to_pose(blocks.coupling, blocks.points, blocks.points_gradient, damping, reduced, gradient)
    return reduced, gradient


def _move(pose: FloatArray, step: FloatArray) -> FloatArray:
    rotation = so3_exp(step[3:])
    moved = np.eye(4)
    moved[:3, :3] = rotation @ pose[:3, :3]
    moved[:3, 3] = rotation @ pose[:3, 3] + step[:3]
    return moved


def adjust(problem: BundleProblem, camera_from_world: FloatArray, max_iterations: int = 15) -> BundleResult:
    """Minimises equation (5) from `camera_from_world` ``[4, 4]``.

    Raises numpy.linalg.LinAlgError when the points do not determine the pose (fewer than three, or in a row).
    """
    from semdb.localization.bundle_kernels import move_points

    pose, points, damping = camera_from_world, problem.points, 1e-4
    blocks = _linearise(problem, pose, points)
    iteration = 0
    for iteration in range(1, max_iterations + 1):  # noqa: B007
        reduced, gradient = _reduced(blocks, damping)
        pose_step = np.asarray(-np.linalg.solve(reduced, gradient), np.float64)
        new_pose = _move(pose, pose_step)
        new_points = move_points(points, blocks.coupling, blocks.points, blocks.points_gradient, damping, pose_step)
        proposed = _linearise(problem, new_pose, new_points)
        if proposed.cost < blocks.cost:
            gain = blocks.cost - proposed.cost
            pose, points, blocks = new_pose, new_points, proposed
            damping = max(damping / 10, 1e-9)
            if gain < 1e-5 * blocks.cost or np.abs(pose_step).max() < 1e-7:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return BundleResult(pose, points, _covariance(blocks, pose), blocks.query_chi2, iteration)


def _covariance(blocks: _Blocks, camera_from_world: FloatArray) -> FloatArray:
    """Covariance of the pose in the world, with the points marginalised out.

    A step (t, w) of the camera moves its centre by -R t and turns it by -R w, R being world_from_camera.
    """
    reduced, _ = _reduced(blocks, 0.0)
    in_camera = np.linalg.inv(reduced)
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = -camera_from_world[:3, :3].T
    covariance: FloatArray = turn @ in_camera @ turn.T
    return (covariance + covariance.T) / 2


def pixel_sigma(size: Float32Array, focal: float, base_px: float = 1.0) -> FloatArray:
    """Standard deviation, in normalised coordinates, of a keypoint of diameter `size` pixels.

    The finest keypoints (about 20 pixels wide) are good to `base_px`; coarser ones in proportion to their scale.
    """
    return np.asarray(base_px * np.maximum(size.astype(np.float64) / 20.0, 1.0) / focal)
