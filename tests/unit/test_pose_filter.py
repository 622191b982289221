"""The filter of tracking: what it says of its errors is true, and smoothing is the answer of all frames together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.geometry import invert_pose, pose_error, pose_from, pose_offset, so3_exp
from semdb.tracking.options import MotionOptions
from semdb.tracking.pose_filter import (
    FilterState,
    Step,
    begin,
    measured,
    moved,
    shifted,
    surprise,
    transition_of,
)
from semdb.tracking.smoothing import FixedLag, Passage, smoothed
from semdb.tracking.tracker import odometry_step, predicted_step
from semdb.types import FloatArray

OPTIONS = MotionOptions(lasting=0.3)
SIGMA = np.array([0.006] * 3 + [0.004] * 3)
STEP_SIGMA = np.array([0.002] * 3 + [0.001] * 3)


def walk(
    rng: np.random.Generator, frames: int, lasting: float
) -> tuple[list[FloatArray], list[FloatArray], list[Step]]:
    """True poses, measurements that share a part of their errors, and steps with noise."""
    poses, seen, steps = [pose_from(so3_exp(rng.normal(0, 1, 3)), rng.normal(0, 1, 3))], [], []
    shared = rng.normal(0, 1, 6) * SIGMA * np.sqrt(lasting)
    for number in range(frames):
        if number:
            motion = pose_from(so3_exp(rng.normal(0, 0.05, 3)), rng.normal(0, 0.03, 3))
            poses.append(poses[-1] @ motion)
            off = rng.normal(0, 1, 6) * STEP_SIGMA
            noisy = pose_from(so3_exp(off[3:]) @ motion[:3, :3], motion[:3, 3] + off[:3])
            steps.append(Step(noisy, np.diag(STEP_SIGMA**2)))
            kept = np.exp(-(np.linalg.norm(motion[:3, 3]) / 0.3))
            shared = kept * shared + rng.normal(0, 1, 6) * SIGMA * np.sqrt(lasting * (1 - kept**2))
        own = rng.normal(0, 1, 6) * SIGMA * np.sqrt(1 - lasting)
        seen.append(shifted(poses[-1], shared + own))
    return poses, seen, steps


def run(seen: list[FloatArray], steps: list[Step], options: MotionOptions) -> list[Passage]:
    noise = np.diag(SIGMA**2)
    state = begin(seen[0], noise, options)
    passages = [Passage(None, None, state)]
    for pose, step in zip(seen[1:], steps, strict=True):
        transition = transition_of(state, step, options)
        predicted = moved(state, step, options)
        state = measured(predicted, pose, noise, options)
        passages.append(Passage(predicted, transition, state))
    return passages


def off(state: FilterState, truth: FloatArray) -> float:
    error = pose_offset(truth, state.pose)
    return float(error @ np.linalg.solve(state.pose_covariance, error))


def test_covariances_are_true() -> None:
    rng = np.random.default_rng(0)
    nees, errors, single = [], [], []
    for _ in range(30):
        poses, seen, steps = walk(rng, 30, 0.3)
        passages = run(seen, steps, OPTIONS)
        nees += [off(p.after, truth) for p, truth in zip(passages[10:], poses[10:], strict=True) if p.after]
        errors += [
            pose_error(p.after.pose, truth)[0] for p, truth in zip(passages[10:], poses[10:], strict=True) if p.after
        ]
        single += [pose_error(a, b)[0] for a, b in zip(seen[10:], poses[10:], strict=True)]
    assert 5.0 < np.mean(nees) < 7.5  # six is expected
    assert np.median(errors) < 0.7 * np.median(single)


def test_a_camera_that_stands_still_does_not_get_surer_and_surer() -> None:
    noise, still = np.diag(SIGMA**2), Step(np.eye(4), np.diag((STEP_SIGMA / 100) ** 2))
    state = begin(np.eye(4), noise, OPTIONS)
    for _ in range(500):
        state = measured(moved(state, still, OPTIONS), np.eye(4), noise, OPTIONS)
    least = np.sqrt(np.diag(state.pose_covariance))
    assert (least > 0.9 * SIGMA * np.sqrt(OPTIONS.lasting)).all()


def test_smoothing_is_better_than_the_filter_and_says_so() -> None:
    rng = np.random.default_rng(1)
    forward, both, nees = [], [], []
    for _ in range(20):
        poses, seen, steps = walk(rng, 25, 0.3)
        passages = run(seen, steps, OPTIONS)
        for number in range(5, 15):
            after, (pose, covariance) = passages[number].after, smoothed(passages[number:])
            assert after is not None
            assert pose is not None
            assert covariance is not None
            forward.append(pose_error(after.pose, poses[number])[0])
            both.append(pose_error(pose, poses[number])[0])
            error = pose_offset(poses[number], pose)
            nees.append(float(error @ np.linalg.solve(covariance, error)))
            assert np.trace(covariance) <= np.trace(after.pose_covariance) + 1e-12
    assert np.mean(both) < 0.93 * np.mean(forward)
    assert 4.5 < np.mean(nees) < 8.0


def test_smoothing_stops_where_the_camera_was_lost() -> None:
    _poses, seen, steps = walk(np.random.default_rng(2), 4, 0.3)
    passages = run(seen, steps, OPTIONS)
    alone, _ = smoothed([passages[1], Passage(None, None, passages[2].after)])
    after = passages[1].after
    assert after is not None
    assert alone is not None
    np.testing.assert_array_equal(alone, after.pose)
    assert smoothed([Passage(None, None, None), passages[1]]) == (None, None)


@given(st.integers(0, 30), st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_a_lag_gives_back_all_in_their_order(items: int, lag: int) -> None:
    smoother: FixedLag[int] = FixedLag(lag)
    state = begin(np.eye(4), np.diag(SIGMA**2), OPTIONS)
    given_back = [n for item in range(items) for n, _, _ in smoother.push(item, Passage(None, None, state))]
    assert given_back == list(range(max(0, items - lag)))
    assert [*given_back, *(n for n, _, _ in smoother.flush())] == list(range(items))


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6), st.integers(0, 1000))
@settings(max_examples=50, deadline=None)
def test_difference_and_shifted_are_inverse(error: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = pose_from(so3_exp(rng.normal(0, 1, 3)), rng.normal(0, 3, 3))
    wanted = np.array(error) * [1, 1, 1, 0.5, 0.5, 0.5]
    np.testing.assert_allclose(pose_offset(shifted(pose, wanted), pose), wanted, atol=1e-9)


def test_surprise_counts_standard_deviations() -> None:
    noise = np.diag(SIGMA**2)
    state = begin(np.eye(4), noise, OPTIONS)
    assert surprise(state, np.eye(4), noise) == pytest.approx(0.0, abs=1e-12)
    one = shifted(np.eye(4), np.array([SIGMA[0] * np.sqrt(2) * 3, 0, 0, 0, 0, 0]))
    assert surprise(state, one, noise) == pytest.approx(9.0)


def test_a_camera_that_is_not_seen_comes_to_rest_and_gets_unsure() -> None:
    options = MotionOptions()
    speed = np.array([0.4, 0, 0, 0, 0.5, 0])
    whole, variance, unseen = np.eye(4), np.zeros((6, 6)), 0.0
    for _ in range(90):
        step = predicted_step(speed, 1 / 30, unseen, options)
        whole, unseen = whole @ step.before_from_after, unseen + 1 / 30
        variance = variance + step.covariance
    way = np.linalg.norm(so3_way(whole))
    assert way < 0.5 * options.slows_s + 1e-6  # and not 0.5 rad/s for three seconds
    assert np.sqrt(variance[0, 0]) == pytest.approx(options.astray_m_s * 3, rel=0.02)


def so3_way(pose: FloatArray) -> FloatArray:
    return pose_offset(pose, np.eye(4))[3:]


def test_odometry_is_as_unsure_as_its_way_is_long() -> None:
    before = pose_from(so3_exp([0, 0, 0.3]), [1, 2, 0])
    near, far = (before @ pose_from(np.eye(3), [x, 0, 0]) for x in (0.0, 1.0))
    options = MotionOptions()
    np.testing.assert_allclose(odometry_step(before, far, options).before_from_after, invert_pose(before) @ far)
    assert np.sqrt(odometry_step(before, near, options).covariance[0, 0]) == pytest.approx(options.odometry_m)
    assert np.sqrt(odometry_step(before, far, options).covariance[0, 0]) == pytest.approx(0.032)
