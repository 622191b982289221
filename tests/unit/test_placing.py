"""An image placed by images that stand still: what the compiled solver gives, and how sure it is; and by surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from semdb.geometry import pose_error, pose_from, so3_exp, transform_points
from semdb.perception.features.surf_features import SurfFeatures
from semdb.recordings.synthetic import SyntheticOptions
from semdb.recordings.synthetic.writer import SyntheticSequence
from semdb.trajectory.frames import SeenFrame, see
from semdb.trajectory.keyframes import Keyframe, Keyframes, sample_of, with_points_only
from semdb.trajectory.laying import lay
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.placing_kernels import equations, minimise, solve_small
from semdb.types import FloatArray
from tests.rooms import SMALL

CAUCHY = 4.0


@dataclass(frozen=True, eq=False)
class Problem:
    """Points that an image and one of two keyframes see, exactly; `poses` ``[3, 4, 4]`` are camera_from_world."""

    points: FloatArray
    slot: np.ndarray
    poses: FloatArray
    turn: FloatArray
    own: FloatArray
    theirs: FloatArray


def problem(seed: int, noise: float = 0.0, count: int = 120) -> Problem:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(2, 4, count)])
    poses = np.stack([pose_from(so3_exp(rng.normal(0, 0.05, 3)), rng.normal(0, 0.1, 3)) for _ in range(3)])
    turn = rng.normal(0, 0.01, (3, 3))
    slot = rng.integers(1, 3, count).astype(np.int32)

    def seen(image: np.ndarray) -> FloatArray:
        local = np.stack([transform_points(poses[c], p[None])[0] for c, p in zip(image, points, strict=True)])
        rows = rng.uniform(-0.5, 0.5, count)
        turned = local + np.cross(turn[image] * rows[:, None], local)
        xy = turned[:, :2] / turned[:, 2:] + noise * rng.normal(0, 1, (count, 2))
        return np.column_stack([xy, np.full(count, max(noise, 1e-3)), turned[:, 2], rows, np.ones(count)])

    return Problem(points, slot, poses, turn, seen(np.zeros(count, np.int32)), seen(slot))


def solve(given: Problem, start: FloatArray, most: int = 20) -> tuple[bool, FloatArray, FloatArray, FloatArray]:
    poses, turn, points = given.poses.copy(), given.turn.copy(), given.points.copy()
    expected = turn[0].copy()
    poses[0], turn[0] = start, 0.0
    matrix, pulls = np.zeros((9, 9)), np.zeros((len(points), 9))
    good = minimise(
        points, given.slot, poses, turn, given.own, given.theirs, CAUCHY, expected, 1 / 0.02**2, most, 1e-9, 1e-9,
        matrix, pulls,
    )  # fmt: skip
    return good, poses[0], turn[0], matrix


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_pose_and_the_turn_of_an_exact_image_are_found(seed: int) -> None:
    given = problem(seed)
    start = pose_from(so3_exp(np.array([0.02, -0.03, 0.01])), np.array([0.05, -0.04, 0.03])) @ given.poses[0]
    good, pose, turn, _ = solve(given, start)
    assert good
    metres, degrees = pose_error(pose, given.poses[0])
    assert metres < 1e-6
    assert degrees < 1e-4
    assert np.abs(turn - given.turn[0]).max() < 1e-5


def test_errors_are_as_large_as_the_equations_say() -> None:
    squares = []
    for seed in range(40):
        given = problem(seed, noise=0.002)
        good, pose, _, matrix = solve(given, given.poses[0])
        assert good
        turned = pose[:3, 3] - given.poses[0][:3, 3]
        assert np.linalg.norm(turned) < 0.02
        spread = np.linalg.inv(matrix)[:3, :3]
        squares.append(float(turned @ np.linalg.inv(spread) @ turned))
    assert 1.0 < np.mean(squares) < 5.0  # three numbers; a turn of the image comes with its translation


def test_the_gradient_is_that_of_the_cost_with_points_that_follow() -> None:
    given = problem(5, noise=0.004)
    rotation, translation = given.poses[:, :3, :3].copy(), given.poses[:, :3, 3].copy()
    count = len(given.points)
    matrix, gradient, pulls = np.zeros((9, 9)), np.zeros(9), np.zeros((count, 9))
    carried, back = np.zeros((count, 3, 9)), np.zeros((count, 3))

    def cost(axis: int, shift: float) -> float:
        moved, points, found = translation.copy(), given.points.copy(), 0.0
        moved[0, axis] += shift
        for _ in range(40):  # points alone, until they stand still
            found = equations(
                points, given.slot, rotation, moved, given.turn, given.own, given.theirs, CAUCHY, 0.0,
                matrix, gradient, carried, back, pulls,
            )  # fmt: skip
            points = points - back
        return float(found)

    for axis in range(3):
        numeric = (cost(axis, 1e-5) - cost(axis, -1e-5)) / 4e-5  # of half the cost
        cost(axis, 0.0)
        assert gradient[axis] == pytest.approx(numeric, rel=1e-3, abs=1e-2)
        assert np.allclose(pulls.sum(axis=0), gradient)


def test_what_is_not_positive_is_not_solved() -> None:
    found = np.zeros(2)
    assert solve_small(np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([1.0, 0.0]), 0.0, found)
    assert np.allclose(np.array([[2.0, 0.5], [0.5, 1.0]]) @ found, [1.0, 0.0])
    assert not solve_small(np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([1.0, 0.0]), 0.0, found)
    assert not solve_small(np.zeros((2, 2)), np.array([1.0, 0.0]), 0.0, found)


# surfaces


def seen_frames(options: SyntheticOptions, indexes: Sequence[int]) -> tuple[list[SeenFrame], FloatArray]:
    sequence = SyntheticSequence(options)
    found = []
    for index in indexes:
        one = sequence.render(index)
        depth = np.where(one.depth > 0, one.depth, np.nan).astype(np.float32)
        features = SurfFeatures(max_keypoints=400)
        frame = see(index, index / 30, one.rgb, depth, sequence.camera, features, TrajectoryOptions().frames)
        assert isinstance(frame, SeenFrame)
        found.append(frame)
    return found, sequence.poses[list(indexes)]


def test_a_frame_is_laid_on_surfaces_and_never_on_those_of_another_room() -> None:
    (*frames, frame), true = seen_frames(SMALL, [0, 2, 5, 3])
    known, options = Keyframes(), TrajectoryOptions(threads=1)
    for n, seen in enumerate(frames):
        view, vector, surface = with_points_only(seen.view), np.zeros(4, np.float32), seen.surface_view()
        known.add(Keyframe(n, n, seen.time_s, 0, view, vector, sample_of(view), seen.depth, surface), true[n])
    placed = lay(frame, known, [1, 0, 2], [true[1]], options)  # 8 cm and 6 degrees away
    assert placed is not None
    assert placed.laid
    metres, degrees = pose_error(placed.pose, true[3])
    assert metres < 0.005
    assert degrees < 0.2
    assert placed.estimate.covariance is not None
    assert np.sqrt(np.diag(placed.estimate.covariance)).max() < 0.02
    [other], _ = seen_frames(SyntheticOptions(frames=4, width=320, height=240, lap_frames=80, room_seed=9, seed=4), [3])
    assert lay(other, known, [1, 0, 2], [true[0], true[1]], options) is None
    bare = replace(frame, whole_depth=None)
    assert lay(bare, known, [1, 0, 2], [true[1]], options) is None
