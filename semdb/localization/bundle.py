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


def depth_sigma(depth: FloatArray) -> FloatArray:
    """Standard deviation in metres of a structured-light depth of `depth` metres.

    The axial noise that Nguyen, Izadi and Lovell measured (3DIMPVT 2012): 0.0012 + 0.0019 (z - 0.4)^2.
    """
    return np.asarray(0.0012 + 0.0019 * (depth - 0.4) ** 2)


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
    cost: float
    query_chi2: FloatArray  # [m]


def _observe(
    points: FloatArray, xy: FloatArray, sigma: FloatArray, depth: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Residuals ``[n, 3]`` (x, y, depth; in sigmas, robustly weighted), Jacobian by the camera-frame point
    ``[n, 3, 3]``, chi2 of the pixel ``[n]`` and the robust cost.
    """
    z = np.maximum(points[:, 2], 1e-3)
    residual = np.zeros((len(points), 3))
    jacobian = np.zeros((len(points), 3, 3))
    inverse = 1 / (z * sigma)
    residual[:, 0] = (points[:, 0] / z - xy[:, 0]) / sigma
    residual[:, 1] = (points[:, 1] / z - xy[:, 1]) / sigma
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = inverse
    jacobian[:, 0, 2] = -points[:, 0] / z * inverse
    jacobian[:, 1, 2] = -points[:, 1] / z * inverse
    measured = np.isfinite(depth)
    spread = depth_sigma(np.where(measured, depth, 1.0))
    residual[:, 2] = np.where(measured, (points[:, 2] - np.where(measured, depth, 0.0)) / spread, 0.0)
    jacobian[:, 2, 2] = np.where(measured, 1 / spread, 0.0)
    chi2 = residual[:, 0] ** 2 + residual[:, 1] ** 2
    depth_chi2 = residual[:, 2] ** 2
    weights = np.empty((len(points), 3))
    weights[:, :2] = (1 / np.sqrt(1 + chi2 / CAUCHY_SQUARED))[:, None]
    weights[:, 2] = 1 / np.sqrt(1 + depth_chi2 / CAUCHY_SQUARED)
    cost = CAUCHY_SQUARED * float(np.log1p(chi2 / CAUCHY_SQUARED).sum() + np.log1p(depth_chi2 / CAUCHY_SQUARED).sum())
    return residual * weights, jacobian * weights[:, :, None], chi2, cost


def _linearise(problem: BundleProblem, pose: FloatArray, points: FloatArray) -> _Blocks:
    rotation = pose[:3, :3]
    in_query = points @ rotation.T + pose[:3, 3]
    residual, by_camera, chi2, cost = _observe(in_query, problem.query_xy, problem.query_sigma, problem.query_depth)
    by_pose = np.concatenate([by_camera, _times_minus_skew(by_camera, in_query)], axis=2)  # [m, 3, 6]
    by_point = by_camera @ rotation
    blocks = _Blocks(
        pose=np.einsum("nri,nrj->ij", by_pose, by_pose),
        pose_gradient=np.einsum("nri,nr->i", by_pose, residual),
        coupling=np.swapaxes(by_pose, 1, 2) @ by_point,
        points=np.swapaxes(by_point, 1, 2) @ by_point,
        points_gradient=np.einsum("nri,nr->ni", by_point, residual),
        cost=cost,
        query_chi2=chi2,
    )
    _add_keyframes(problem, points, blocks)
    return blocks


def _add_keyframes(problem: BundleProblem, points: FloatArray, blocks: _Blocks) -> None:
    index = problem.keyframe_point
    in_keyframe = np.einsum("kij,kj->ki", problem.keyframe_rotation, points[index]) + problem.keyframe_translation
    residual, by_camera, _, cost = _observe(
        in_keyframe, problem.keyframe_xy, problem.keyframe_sigma, problem.keyframe_depth
    )
    by_point = by_camera @ problem.keyframe_rotation
    np.add.at(blocks.points, index, np.swapaxes(by_point, 1, 2) @ by_point)
    np.add.at(blocks.points_gradient, index, np.einsum("kri,kr->ki", by_point, residual))
    blocks.cost += cost


def _times_minus_skew(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """``matrices[n] @ -skew(vectors[n])``: each row r becomes cross(v, r)."""
    return np.cross(vectors[:, None, :], matrices)


def _solve(blocks: _Blocks, damping: float) -> tuple[FloatArray, FloatArray]:
    """Steps of pose ``[6]`` and points ``[m, 3]`` from the damped normal equations by the Schur complement."""
    damped_points = blocks.points * (1 + damping * np.eye(3)) + 1e-12 * np.eye(3)
    inverse = np.linalg.inv(damped_points)
    carried = blocks.coupling @ inverse  # [m, 6, 3]
    reduced = blocks.pose * (1 + damping * np.eye(6)) - np.einsum("nij,nkj->ik", carried, blocks.coupling)
    gradient = blocks.pose_gradient - np.einsum("nij,nj->i", carried, blocks.points_gradient)
    pose_step = -np.linalg.solve(reduced, gradient)
    rest = blocks.points_gradient + np.einsum("nij,i->nj", blocks.coupling, pose_step)
    return pose_step, -np.einsum("nij,nj->ni", inverse, rest)


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
    pose, points, damping = camera_from_world, problem.points, 1e-4
    blocks = _linearise(problem, pose, points)
    iteration = 0
    for iteration in range(1, max_iterations + 1):  # noqa: B007
        pose_step, point_steps = _solve(blocks, damping)
        new_pose, new_points = _move(pose, pose_step), points + point_steps
        proposed = _linearise(problem, new_pose, new_points)
        if proposed.cost < blocks.cost:
            gain = blocks.cost - proposed.cost
            pose, points, blocks = new_pose, new_points, proposed
            damping = max(damping / 10, 1e-9)
            if gain < 1e-6 * blocks.cost or np.abs(pose_step).max() < 1e-8:
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
    inverse = np.linalg.inv(blocks.points + 1e-12 * np.eye(3))
    reduced = blocks.pose - np.einsum("nij,njk,nlk->il", blocks.coupling, inverse, blocks.coupling)
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
