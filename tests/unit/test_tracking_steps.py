"""The motion between two images by what they both show."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.geometry import pose_error, pose_from, so3_exp, transform_points
from semdb.tracking.options import MotionOptions
from semdb.tracking.pose_filter import Step, begin, faded, measured
from semdb.tracking.step_kernels import largest_difference, solve_step
from semdb.tracking.tracker import exact_noise

LOOSE, TIGHT = np.full(3, 1 / 0.002**2), np.full(3, 1e12)


def seen(motion: np.ndarray, turn: np.ndarray, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points ``[n, 3]`` in the camera before, and what the one after `motion` sees of them, read out row by row."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-1.5, -1.1, 1.5], [1.5, 1.1, 4.0], (200, 3))
    moved = transform_points(motion, points)
    row = np.zeros(len(points))
    for _ in range(5):  # the row that sees a point depends on where it is seen
        local = moved + np.cross(turn * row[:, None], moved)
        xy = local[:, :2] / local[:, 2:]
        row = xy[:, 1]
    xy += rng.normal(0, noise, xy.shape) if noise else 0.0
    return points, np.column_stack([xy, np.full(len(xy), 0.0003), row])


def solved(points: np.ndarray, observed: np.ndarray, prior: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    pose, turn = np.eye(4), np.zeros(3)
    equations, gradient, chi2 = np.empty((9, 9)), np.empty(9), np.empty(len(points))
    good = solve_step(points, observed, prior, np.zeros(3), 12, 1e-9, pose, turn, equations, gradient, chi2)
    return good, pose, turn


def test_a_step_and_the_turn_during_the_readout_are_found() -> None:
    motion, turn = pose_from(so3_exp([0.02, -0.03, 0.01]), [0.03, -0.01, 0.02]), np.array([0.004, -0.006, 0.002])
    good, pose, found = solved(*seen(motion, turn), LOOSE)
    assert good
    assert pose_error(pose, motion) == pytest.approx((0, 0), abs=1e-3)
    np.testing.assert_allclose(found, turn, atol=5e-5)  # the prior pulls it a little


def test_outliers_do_not_move_a_step() -> None:
    motion = pose_from(so3_exp([0.0, 0.02, 0.0]), [0.02, 0.0, 0.01])
    points, observed = seen(motion, np.zeros(3), 0.0002)
    observed[:20, 0] += 0.02
    good, pose, turn = solved(points, observed, TIGHT)
    assert good
    metres, degrees = pose_error(pose, motion)
    assert metres < 5e-4
    assert degrees < 0.02
    assert np.abs(turn).max() < 1e-6


def test_points_that_do_not_determine_a_step_give_none() -> None:
    points, observed = seen(np.eye(4), np.zeros(3))
    good, _, _ = solved(points[:1], observed[:1], TIGHT)
    assert not good


def test_what_lies_behind_an_edge_is_seen_by_neighbours() -> None:
    at = np.array([[10.0, 10], [14, 10], [100, 100]])
    found = np.zeros(3)
    largest_difference(at, np.array([0.5, 0.3, 0.1]), np.arange(3), np.arange(3, dtype=np.int32), 6.0, found)
    np.testing.assert_allclose(found, [0.2, 0.2, 0.0])


def test_images_that_turned_while_read_out_make_a_step_less_sure() -> None:
    step, options = Step(np.eye(4), np.eye(6) * 1e-8), MotionOptions()
    still, turning = (exact_noise(step, turned, options, 1.0) for turned in (0.0, 0.03))
    assert (np.diag(turning) > 10 * np.diag(still)).all()


def test_a_state_that_is_contradicted_follows_what_is_measured() -> None:
    options, sure = MotionOptions(), np.eye(6) * 1e-6
    state, there = begin(np.eye(4), sure, options), pose_from(np.eye(3), [0.05, 0, 0])
    assert measured(state, there, sure, options).pose[0, 3] < 0.04
    assert measured(faded(state, 100.0), there, sure, options).pose[0, 3] > 0.045
