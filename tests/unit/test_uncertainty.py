"""Figures of how true covariances are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semdb.evaluation.uncertainty import (
    POSITION,
    ROTATION,
    held_shares,
    nees_figures,
    normalised_error,
)
from semdb.geometry import pose_from, pose_offset


def test_true_covariances_have_the_figures_of_chi_square() -> None:
    rng = np.random.default_rng(4)
    root = np.linalg.cholesky(np.diag([1e-4, 4e-4, 1e-4, 1e-6, 1e-6, 4e-6]) + 2e-7)
    covariance = root @ root.T
    errors = []
    for _ in range(4000):
        offset = root @ rng.standard_normal(6)
        errors.append((normalised_error(offset, covariance, POSITION), normalised_error(offset, covariance, ROTATION)))
    found = nees_figures(errors)
    assert found is not None
    assert found.position == pytest.approx(2.366, abs=0.12)
    assert found.rotation == pytest.approx(2.366, abs=0.12)
    assert found.inside_50 == pytest.approx(0.5, abs=0.03)
    assert found.inside_95 == pytest.approx(0.95, abs=0.015)
    assert held_shares(errors, np.array([0.5, 0.95])) == pytest.approx(np.array([[0.5] * 2, [0.95] * 2]), abs=0.03)
    halved = nees_figures([(4 * one, two) for one, two in errors])  # sigmas of position half as large as they should be
    assert halved is not None
    assert halved.position == pytest.approx(9.46, abs=0.5)
    assert halved.inside_95 < 0.7
    assert nees_figures([]) is None


def test_an_offset_is_in_the_world() -> None:
    truth = pose_from(Rotation.from_rotvec(np.array([0.3, -0.2, 1.0])).as_matrix(), np.array([1.0, 2.0, 3.0]))
    turned = Rotation.from_rotvec(np.array([0.01, 0.02, -0.03])).as_matrix() @ truth[:3, :3]
    estimate = pose_from(turned, np.array([1.1, 1.9, 3.2]))
    assert pose_offset(estimate, truth) == pytest.approx(np.array([0.1, -0.1, 0.2, 0.01, 0.02, -0.03]))
