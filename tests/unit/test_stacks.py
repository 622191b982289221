"""Many poses at once, against the same one by one and against differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.geometry import invert_pose, pose_from, so3_exp, so3_log
from semdb.geometry.stacks import (
    adjoints,
    differences,
    inverse_right_jacobians,
    invert_poses,
    perturbed,
    so3_exps,
    so3_logs,
)
from semdb.types import FloatArray

ANGLES = st.floats(0.0, np.pi - 1e-3)


def random_poses(count: int, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.stack([pose_from(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(count)])


@given(seed=st.integers(0, 1000), angle=ANGLES)
def test_exponential_and_logarithm_are_those_of_one(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    omega = angle * axis / np.linalg.norm(axis)
    rotation = so3_exps(omega[None])[0]
    np.testing.assert_allclose(rotation, so3_exp(omega), atol=1e-12)
    np.testing.assert_allclose(so3_logs(rotation[None])[0], so3_log(rotation), atol=1e-9)
    np.testing.assert_allclose(so3_logs(rotation[None])[0], omega, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-3])
def test_small_rotations_lose_no_digits(angle: float) -> None:
    omega = np.array([[angle, -2 * angle, angle / 2]])
    np.testing.assert_allclose(so3_logs(so3_exps(omega)), omega, rtol=1e-6, atol=1e-15)


def test_inverses() -> None:
    poses = random_poses(5)
    np.testing.assert_allclose(invert_poses(poses), np.stack([invert_pose(pose) for pose in poses]), atol=1e-12)


def test_differences_undo_perturbations() -> None:
    rng = np.random.default_rng(3)
    poses, steps = random_poses(20, 1), 0.5 * rng.normal(size=(20, 6))
    np.testing.assert_allclose(differences(poses, perturbed(poses, steps)), steps, atol=1e-9)


def test_the_inverse_jacobian_is_the_slope_of_the_logarithm() -> None:
    rng = np.random.default_rng(4)
    omegas = np.concatenate([rng.uniform(-1.7, 1.7, (6, 3)), 1e-6 * rng.normal(size=(2, 3))])
    growth = inverse_right_jacobians(omegas)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        moved = so3_logs(so3_exps(omegas) @ so3_exp(step))
        np.testing.assert_allclose((moved - so3_logs(so3_exps(omegas))) / 1e-6, growth[:, :, axis], atol=1e-5)


def test_the_adjoint_moves_a_perturbation_through_a_pose() -> None:
    pose = random_poses(1, 5)
    step = 1e-6 * np.random.default_rng(6).normal(size=6)
    right = perturbed(pose, step[None])[0]  # pose exp(step)
    moved = adjoints(pose)[0] @ step
    left = pose_from(so3_exp(moved[3:]), moved[:3]) @ pose[0]  # exp(Ad step) pose
    np.testing.assert_allclose(right, left, atol=1e-11)
