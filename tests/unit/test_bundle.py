"""Bundle adjustment: its derivatives, rolling shutters, and keyframes whose poses are off."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp, transform_points
from semdb.localization.bundle import BundleProblem, MotionPrior, _Solver, _State, adjust
from semdb.localization.bundle_kernels import move_images
from semdb.types import FloatArray

FOCAL = 520.0
STILL = MotionPrior(turn_rad=0.0, keyframe_m=0.0, keyframe_rad=0.0)


def problem_of(
    seed: int,
    *,
    count: int = 150,
    turns: FloatArray | None = None,
    keyframes: int = 1,
    keyframe_error: float = 0.0,
    pixel_noise: float = 0.0,
    apart: tuple[float, ...] | None = None,
) -> tuple[BundleProblem, FloatArray]:
    """A query and keyframes that see `count` points, images turning by `turns` ``[c, 3]``; the true query pose.

    Images are 0.1 m and 0.08 rad per axis from the middle, or as many times that as `apart` says of each; keyframes'
    recorded positions are off by `keyframe_error` m times the root of that.
    """
    random = np.random.default_rng(seed)
    apart = apart or (1.0,) * (keyframes + 1)
    truth = [pose_from(so3_exp(random.normal(size=3) * 0.08 * far), random.normal(size=3) * 0.1 * far) for far in apart]
    points = random.uniform([-1.2, -0.9, 1.5], [1.2, 0.9, 4], (count, 3))
    turns = np.zeros((keyframes + 1, 3)) if turns is None else turns
    owner, image, seen = [], [], []
    for n, (pose, turn) in enumerate(zip(truth, turns, strict=True)):
        local = transform_points(pose, points)
        row = np.zeros(count)
        for _ in range(20):  # the row that sees a point depends on where the turn puts it
            moved = local + np.cross(turn * row[:, None], local)
            row = moved[:, 1] / moved[:, 2] * FOCAL / 480
        xy = moved[:, :2] / moved[:, 2:] + random.normal(size=(count, 2)) * pixel_noise / FOCAL
        depth = np.full(count, np.nan) if n == 0 else moved[:, 2]
        seen.append(np.column_stack([xy, np.full(count, 1 / FOCAL), depth, row]))
        owner.append(np.arange(count))
        image.append(np.full(count, n))
    observed, point = np.concatenate(seen), np.concatenate(owner)
    order = np.argsort(point, kind="stable")
    recorded = [
        pose_from(pose[:3, :3], pose[:3, 3] + random.normal(size=3) * keyframe_error * np.sqrt(far))
        for pose, far in zip(truth[1:], apart[1:], strict=True)
    ]
    problem = BundleProblem(
        points=points + random.normal(size=points.shape) * 0.005,
        observed_point=point[order].astype(np.int32),
        observed_image=np.concatenate(image)[order].astype(np.int32),
        xy=observed[order, :2],
        sigma=observed[order, 2],
        depth=observed[order, 3],
        rows=observed[order, 4],
        keyframe_from_world=np.stack(recorded),
    )
    return problem, truth[0]


def moved_a_little(pose: FloatArray) -> FloatArray:
    return pose_from(so3_exp([0.01, -0.01, 0.005]) @ pose[:3, :3], pose[:3, 3] + [0.02, -0.01, 0.01])


def error_of(problem: BundleProblem, truth: FloatArray, prior: MotionPrior | None = None) -> tuple[float, float]:
    found = adjust(problem, moved_a_little(truth), prior)
    return pose_error(invert_pose(found.camera_from_world), invert_pose(truth))


@pytest.mark.parametrize("seed", range(4))
def test_gradient_is_that_of_the_cost(seed: int) -> None:
    """Analytic gradients against central differences of the robust cost (which is twice what is differentiated)."""
    random = np.random.default_rng(seed)
    problem, truth = problem_of(seed, count=8, keyframes=2, pixel_noise=0.5)
    solver = _Solver(problem)
    solver.information = np.full((3, 9), 1e4)
    poses = np.concatenate([truth[None], problem.keyframe_from_world])
    state = _State(poses, random.normal(size=(3, 3)) * 0.01, random.normal(size=(3, 6)) * 0.001, problem.points)
    blocks = solver.linearise(state)
    size = 1e-6

    def cost(image: int, axis: int, step: float) -> float:
        turn, shift, moved = state.turn.copy(), state.shift.copy(), poses.copy()
        if axis < 6:
            shift[image, axis] += step
            vector = np.eye(6)[axis] * step
            rotation = so3_exp(vector[3:])
            moved[image] = pose_from(rotation, vector[:3]) @ poses[image]
        else:
            turn[image, axis - 6] += step
        return solver.linearise(_State(moved, turn, shift, state.points)).cost

    for image in range(3):
        for axis in range(9):
            slope = (cost(image, axis, size) - cost(image, axis, -size)) / (4 * size)
            assert slope == pytest.approx(blocks.image_gradients[image, axis], rel=1e-3, abs=0.2)
    for axis in range(3):
        costs = []
        for step in (size, -size):
            points = problem.points.copy()
            points[3, axis] += step
            costs.append(solver.linearise(_State(poses, state.turn, state.shift, points)).cost)
        slope = (costs[0] - costs[1]) / (4 * size)
        assert slope == pytest.approx(blocks.point_gradients[3, axis], rel=1e-3, abs=0.2)


def test_exact_views_give_the_exact_pose() -> None:
    for seed in range(5):
        distance, angle = error_of(*problem_of(seed))
        assert distance < 1e-5
        assert angle < 1e-4


def test_a_camera_that_turns_while_it_is_read_out() -> None:
    """30 degrees a second over 30 ms: a pose alone is centimetres off, with the turn it is exact."""
    turns = np.array([[0.016, 0.004, -0.003], [-0.006, 0.008, 0.002]])
    errors = np.array([error_of(*problem_of(seed, turns=turns)) for seed in range(8)])
    still = np.array([error_of(*problem_of(seed, turns=turns), prior=STILL) for seed in range(8)])
    assert np.median(still[:, 0]) > 0.01
    assert np.median(errors[:, 0]) < 0.0015
    assert np.median(errors[:, 1]) < 0.06


def test_a_camera_that_does_not_turn_is_not_said_to() -> None:
    turns, errors, still = [], [], []
    for seed in range(10):
        problem, truth = problem_of(seed, pixel_noise=0.8)
        found = adjust(problem, moved_a_little(truth))
        turns.append(np.abs(found.turn).max())
        errors.append(pose_error(invert_pose(found.camera_from_world), invert_pose(truth))[0])
        still.append(error_of(problem, truth, STILL)[0])
    assert np.median(turns) < 0.0005
    assert np.mean(errors) < 1.3 * np.mean(still)


def test_a_keyframe_whose_pose_is_off_is_moved_to_the_others() -> None:
    errors, still = [], []
    for seed in range(10):
        problem, truth = problem_of(seed, keyframes=3, keyframe_error=0.004, pixel_noise=0.3)
        errors.append(error_of(problem, truth)[0])
        still.append(error_of(problem, truth, STILL)[0])
    assert np.mean(errors) < 0.95 * np.mean(still)


def test_a_keyframe_near_the_query_holds_it_more_than_one_far_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recorded poses drift apart: of two keyframes, one five times as far from the query, the near one is to count."""
    problems = [
        problem_of(seed, keyframes=2, keyframe_error=0.006, pixel_noise=0.3, apart=(0.0, 0.5, 2.5))
        for seed in range(30)
    ]
    errors = [error_of(problem, truth)[0] for problem, truth in problems]
    monkeypatch.setattr(_Solver, "drifting", lambda solver, pose: None)
    alike = [error_of(problem, truth)[0] for problem, truth in problems]
    assert np.mean(errors) < 0.9 * np.mean(alike)


def test_a_keyframe_whose_pose_is_known_to_be_off_counts_less() -> None:
    """Of two keyframes as far away the pose of one is off by 15 mm, and that is known."""
    errors, unknown = [], []
    for seed in range(30):
        problem, truth = problem_of(seed, keyframes=2, pixel_noise=0.3)
        random = np.random.default_rng(seed + 100)
        recorded = problem.keyframe_from_world.copy()
        recorded[1, :3, 3] += random.normal(size=3) * 0.015
        problem = replace(problem, keyframe_from_world=recorded)
        unknown.append(error_of(problem, truth)[0])
        known = replace(problem, keyframe_sigma=np.array([[0.002, 0.001], [0.015, np.nan]]))
        errors.append(error_of(known, truth)[0])
        usual = replace(problem, keyframe_sigma=np.full((2, 2), np.nan))
        assert error_of(usual, truth)[0] == unknown[-1]
    assert np.mean(errors) < 0.7 * np.mean(unknown)


def test_depth_that_disagrees_is_believed_less() -> None:
    """Depth of the query 2 cm too great everywhere, ten times the sensor's noise: it may not move the pose by that."""
    errors, without = [], []
    for seed in range(6):
        problem, truth = problem_of(seed, pixel_noise=0.5)
        query = problem.observed_image == 0
        local = transform_points(truth, problem.points)[:, 2]
        depth = np.where(query, local[problem.observed_point] + 0.02, problem.depth)
        errors.append(error_of(dataclasses.replace(problem, depth=depth), truth)[0])
        without.append(error_of(problem, truth)[0])
    assert np.median(without) < 0.002
    assert np.median(errors) < 0.008


def test_what_is_reported() -> None:
    problem, truth = problem_of(3, keyframes=2, pixel_noise=0.5)
    result = adjust(problem, moved_a_little(truth))
    assert result.chi2.shape == (450,)
    assert 0.02 < np.median(result.chi2[problem.observed_image == 0]) < 1.0
    assert result.image_from_world.shape == (3, 4, 4)
    assert np.array_equal(result.image_from_world[0], result.camera_from_world)
    assert np.linalg.eigvalsh(result.covariance)[0] > 0
    assert np.allclose(
        result.image_from_world[:, :3, :3] @ result.image_from_world[:, :3, :3].swapaxes(1, 2), np.eye(3)
    )


def test_a_rough_solution_is_a_start() -> None:
    turns = np.array([[0.012, -0.01, 0.004], [0.0, 0.008, -0.006]])
    problem, truth = problem_of(3, turns=turns, pixel_noise=0.3)
    rough = adjust(problem, moved_a_little(truth), rough=True)
    assert rough.covariance is None
    assert np.abs(rough.shift[0]).max() > 0.005  # the query had been moved
    warm = adjust(problem, moved_a_little(truth), start=rough)
    cold = adjust(problem, moved_a_little(truth))
    np.testing.assert_allclose(warm.camera_from_world, cold.camera_from_world, atol=1e-4)
    np.testing.assert_allclose(warm.turn, cold.turn, atol=2e-4)
    assert warm.iterations < cold.iterations
    assert warm.covariance is not None
    assert cold.covariance is not None
    assert np.trace(warm.covariance) == pytest.approx(np.trace(cold.covariance), rel=0.05)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 0.3, 2.0])
def test_images_move_by_the_exponential(size: float) -> None:
    random = np.random.default_rng(4)
    pose = pose_from(so3_exp([0.3, -0.2, 0.5]), [1.0, 2.0, 3.0])
    step = np.zeros((1, 9))
    step[0, :6] = random.normal(size=6) * size
    expected = pose_from(so3_exp(step[0, 3:6]), step[0, :3]) @ pose
    np.testing.assert_allclose(move_images(pose[None], step)[0], expected, atol=1e-12)


def test_how_far_recorded_poses_are_off_is_read_off_the_keyframes() -> None:
    def shown(error: float) -> list[float]:
        found = []
        for seed in range(6):
            problem, truth = problem_of(seed, keyframes=6, keyframe_error=error, pixel_noise=0.4)
            shown = adjust(problem, moved_a_little(truth)).evident
            assert shown is not None
            found.append(shown.position_m)
        return found

    exact, off, far_off = shown(0.0), shown(0.012), shown(0.036)
    assert max(exact) < 0.0005
    assert 0.002 < np.median(off) < 0.02  # beyond the 6 mm that the adjustment itself believes
    assert 2 < np.median(far_off) / np.median(off) < 4
