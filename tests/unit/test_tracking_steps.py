"""The motion between two images by what they both show."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from semdb.geometry import pose_error, pose_from, so3_exp, transform_points
from semdb.localization.views import View
from semdb.tracking.options import MotionOptions
from semdb.tracking.pose_filter import Step, begin, faded, measured, transition_of
from semdb.tracking.smoothing import Passage, smoothed
from semdb.tracking.states import TrackSource, TrackState
from semdb.tracking.step_kernels import largest_difference, solve_step
from semdb.tracking.steps import FrameBefore
from semdb.tracking.tracker import Tracker, exact_noise
from semdb.types import Camera

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


def no_keypoints() -> View:
    nothing = np.zeros(0, np.float32)
    return View(
        camera=Camera(640, 480, 525.0, 525.0, 320.0, 240.0), seen_xy=nothing.reshape(0, 2),
        xy=np.zeros((0, 2)), size=nothing, descriptors=nothing.reshape(0, 64), classes=np.zeros(0, np.int32),
        signs=np.zeros(0, np.int8), points=nothing.reshape(0, 3), source=np.zeros(0, np.int32),
    )  # fmt: skip


def tracker_at(pose: np.ndarray, sigma: float) -> Tracker:
    found = Tracker(Mock())
    found._state = begin(pose, np.eye(6) * sigma**2, found.options.motion)
    return found


def placed_at(pose: np.ndarray, sigma: float, turn: np.ndarray | None = None) -> Mock:
    estimate = Mock(turn=turn, inliers=100, recorded=None)
    return Mock(pose=pose, covariance=np.eye(6) * sigma**2, estimate=estimate, keyframes=())


def test_what_a_contradicted_state_forgot_is_not_smoothed_into_the_frames_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("semdb.tracking.tracker.convinces", lambda *_: True)
    tracker = tracker_at(np.eye(4), 0.001)
    before, still = tracker._state, Step(np.eye(4), np.eye(6) * 1e-8)
    tracker._expect(before, still)
    assert before is not None
    assert tracker._accept(no_keypoints(), placed_at(pose_from(np.eye(3), [0.05, 0, 0]), 0.001), 1.0)
    passage = Passage(tracker._expected, transition_of(before, still, tracker.options.motion), tracker._state)
    pose, _ = smoothed([Passage(None, None, before), passage])
    assert pose is not None
    assert np.abs(pose[:3, 3]).max() < 0.005


def test_a_step_solved_with_a_pose_that_does_not_hold_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = tracker_at(np.eye(4), 0.001)
    tracker._time_s = tracker._seen_s = 0.0
    rough, wrong = (Step(pose_from(np.eye(3), [x, 0, 0]), np.eye(6) * 1e-6) for x in (0.02, 0.08))
    monkeypatch.setattr(tracker, "_motion", lambda *_: (rough, TrackSource.ODOMETRY, Mock()))
    monkeypatch.setattr(tracker, "_exactly", lambda *_: wrong)
    monkeypatch.setattr(tracker, "_by_keyframes", lambda _: placed_at(pose_from(np.eye(3), [5.0, 0, 0]), 0.001))
    found = tracker.update(no_keypoints(), 0.1, Mock())
    assert found.state is TrackState.COASTING
    assert found.world_from_camera is not None
    assert found.world_from_camera[0, 3] == pytest.approx(0.02)


def test_a_step_from_an_image_whose_turn_is_not_known_is_not_solved_exactly() -> None:
    tracker = tracker_at(np.eye(4), 0.001)
    tracker._before = FrameBefore(Mock(), None)
    assert tracker._exactly(no_keypoints(), Mock(), placed_at(np.eye(4), 0.001, np.zeros(3))) is None
