"""The pose graph: Jacobians, what it finds, how sure it is of it, and what wrong edges do to it."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.geometry.stacks import differences, invert_poses, perturbed
from semdb.trajectory.edges import Edge, EdgeKind, stack_edges
from semdb.trajectory.pose_graph import edge_chi2, marginal_covariances, optimise
from semdb.types import BoolArray, FloatArray
from tests.unit.graph_samples import closures, walk, wrong_closures


def held_first(count: int) -> BoolArray:
    held = np.zeros(count, np.bool_)
    held[0] = True
    return held


def position_rmse(poses: FloatArray, true: FloatArray) -> float:
    """With the first pose laid on the first."""
    moved = true[0] @ invert_poses(poses[:1])[0] @ poses
    return float(np.sqrt(((moved[:, :3, 3] - true[:, :3, 3]) ** 2).sum(axis=1).mean()))


def test_exact_edges_give_exact_poses() -> None:
    sample = walk(30)
    true = sample.true[0] @ np.eye(4)
    relative = invert_poses(sample.true[:-1]) @ sample.true[1:]
    edges = [Edge(n, n + 1, EdgeKind.ODOMETRY, motion, np.eye(6), 1) for n, motion in enumerate(relative)]
    edges.append(Edge(3, 25, EdgeKind.LOOP, invert_poses(sample.true[3:4])[0] @ sample.true[25], np.eye(6), 1))
    rng = np.random.default_rng(7)
    start = perturbed(sample.true, 0.1 * rng.normal(size=(30, 6)))
    start[0] = true
    found = optimise(start, stack_edges(edges), held_first(30))
    np.testing.assert_allclose(found.poses, sample.true, atol=1e-6)
    assert found.cost < 1e-10


def test_closures_take_the_drift_away() -> None:
    sample = walk()
    edges = stack_edges([*sample.edges, *closures(sample, 30)])
    found = optimise(sample.odometry, edges, held_first(120))
    before, after = position_rmse(sample.odometry, sample.true), position_rmse(found.poses, sample.true)
    assert before > 0.1
    assert after < 0.1
    assert after < 0.5 * before


def test_the_equations_are_the_slope_of_the_cost() -> None:
    """A step along any axis of a free pose changes the cost as the gradient says: at the minimum, not at all."""
    sample = walk(20)
    edges = stack_edges([*sample.edges, *closures(sample, 4)])
    found = optimise(sample.odometry, edges, held_first(20))
    for pose in (3, 11, 19):
        for axis in range(6):
            step = np.zeros((20, 6))
            step[pose, axis] = 1e-4
            ahead = _cost(perturbed(found.poses, step), edges)
            behind = _cost(perturbed(found.poses, -step), edges)
            assert ahead > found.cost
            assert behind > found.cost
            assert abs(ahead - behind) < 0.05 * (ahead + behind - 2 * found.cost)


def _cost(poses: FloatArray, edges: object) -> float:
    from semdb.trajectory.pose_graph import CAUCHY_SQUARED

    chi2 = edge_chi2(poses, edges)  # type: ignore[arg-type]
    robust = CAUCHY_SQUARED * np.log1p(chi2 / CAUCHY_SQUARED)
    return float(np.where(edges.robust, robust, chi2).sum())  # type: ignore[attr-defined]


def test_marginal_covariances_are_honest() -> None:
    """Squared errors over their covariances have a mean of six, of many walks."""
    ratios = []
    for seed in range(12):
        sample = walk(60, seed)
        edges = stack_edges([*sample.edges, *closures(sample, 10, seed)])
        found = optimise(sample.odometry, edges, held_first(60))
        spread = marginal_covariances(found.poses, edges, held_first(60))
        true = invert_poses(sample.true[:1])[0] @ sample.true
        error = differences(found.poses, true)[1:]
        ratios.append(np.mean([e @ np.linalg.solve(c, e) for e, c in zip(error, spread[1:], strict=True)]))
        assert (spread[0] == 0).all()
    assert 4.0 < np.mean(ratios) < 9.0


def test_a_pose_that_no_edge_reaches_has_no_covariance() -> None:
    sample = walk(10)
    edges = stack_edges([edge for edge in sample.edges if edge.second < 6])
    spread = marginal_covariances(sample.odometry, edges, held_first(10))
    assert np.isfinite(spread[:6]).all()
    assert np.isnan(spread[6:]).all()
    found = optimise(sample.odometry, edges, held_first(10))
    np.testing.assert_allclose(found.poses[6:], sample.odometry[6:])


def test_a_wrong_edge_counts_little() -> None:
    sample = walk()
    right = closures(sample, 30)
    alone = optimise(sample.odometry, stack_edges([*sample.edges, *right]), held_first(120))
    mixed = stack_edges([*sample.edges, *right, *wrong_closures(sample, 3)])
    found = optimise(sample.odometry, mixed, held_first(120))
    assert found.weights[-3:].max() < 0.02
    assert position_rmse(found.poses, sample.true) < 2 * position_rmse(alone.poses, sample.true) + 0.02


def test_nothing_held_is_an_error() -> None:
    sample = walk(5)
    with pytest.raises(ValueError, match="held"):
        optimise(sample.odometry, stack_edges(sample.edges), np.zeros(5, np.bool_))
