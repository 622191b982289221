"""Bundle adjustment over keyframes, on points whose truth is known and images that turn while they are read out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from semdb.geometry import pose_from, so3_exp
from semdb.geometry.sensor import depth_noise
from semdb.geometry.stacks import invert_poses, perturbed
from semdb.trajectory.adjustment import SharedPoints, adjust_keyframes
from semdb.trajectory.adjustment_kernels import solve_positive
from semdb.trajectory.options import AdjustmentOptions
from semdb.types import BoolArray, FloatArray

FOCAL, HALF_WIDTH, HALF_HEIGHT = 525.0, 0.6, 0.45  # normalised
READOUT_S = 0.025
OPTIONS = AdjustmentOptions()


@dataclass(frozen=True, eq=False)
class Scene:
    true: FloatArray  # [c, 4, 4]
    start: FloatArray  # [c, 4, 4] where adjustment begins
    rates: FloatArray  # [c, 3]
    shared: SharedPoints
    held: BoolArray


def scene(
    readout_s: float = 0.0, noise_px: float = 0.3, depth_times: float = 1.0, seed: int = 0, count: int = 12
) -> Scene:
    """A camera that swings before a wall of points with depth, two to four metres away."""
    rng = np.random.default_rng(seed)
    rates = rng.normal(size=(count, 3)) * [0.3, 0.8, 0.2]
    true = np.stack(
        [
            pose_from(
                so3_exp([0.05 * np.sin(n), 0.25 * np.sin(0.7 * n), 0.05 * np.cos(n)]),
                [0.08 * n - 0.5, 0.05 * np.sin(n), 0],
            )
            for n in range(count)
        ]
    )
    points = np.column_stack([rng.uniform(-2, 2, 500), rng.uniform(-1.3, 1.3, 500), rng.uniform(2, 4, 500)])
    rows = []
    for image, pose in enumerate(invert_poses(true)):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        row = np.zeros(len(local))
        for _ in range(5):  # the row that sees a point depends on where it is seen
            turned = local + np.cross(-readout_s * rates[image] * row[:, None], local)
            xy = turned[:, :2] / turned[:, 2:]
            row = xy[:, 1] / (2 * HALF_HEIGHT)
        seen = (np.abs(xy[:, 0]) < HALF_WIDTH) & (np.abs(xy[:, 1]) < HALF_HEIGHT)
        for point in np.flatnonzero(seen):
            noisy = xy[point] + rng.normal(size=2) * noise_px / FOCAL
            z = turned[point, 2]
            depth = z + rng.normal() * depth_times * float(depth_noise(np.array([z]))[0])
            rows.append((point, image, *noisy, depth, row[point]))
    table = np.array(sorted(rows))
    ids, point = np.unique(table[:, 0].astype(int), return_inverse=True)
    counted = np.bincount(point)[point] > 1
    table = table[counted]
    ids, point = np.unique(table[:, 0].astype(int), return_inverse=True)
    shared = SharedPoints(
        points=points[ids] + 0.02 * rng.normal(size=(len(ids), 3)),
        point=point.astype(np.int32),
        image=table[:, 1].astype(np.int32),
        keypoint=np.arange(len(table), dtype=np.int32),
        xy=table[:, 2:4],
        sigma=np.full(len(table), 1.0 / FOCAL),
        aligned=np.ones(len(table), np.bool_),
        depth=table[:, 4],
        row=table[:, 5],
    )
    steps = rng.normal(size=(count, 6)) * np.repeat([0.02, 0.01], 3)
    steps[0] = 0
    held = np.arange(count) == 0
    return Scene(true, perturbed(true, steps), rates, shared, held)


def worst_m(poses: FloatArray, true: FloatArray) -> float:
    return float(np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1).max())


def test_poses_are_found_to_a_millimetre() -> None:
    made = scene()
    found = adjust_keyframes(made.shared, made.start, made.held, made.rates, OPTIONS)
    assert worst_m(made.start, made.true) > 0.03
    assert worst_m(found.poses, made.true) < 0.002
    assert found.readout_s < 0.002
    assert found.residual_turn_rad < 0.001
    np.testing.assert_allclose(found.poses[0], made.true[0], atol=1e-7)


def test_the_readout_time_is_found() -> None:
    made = scene(READOUT_S)
    found = adjust_keyframes(made.shared, made.start, made.held, made.rates, OPTIONS)
    assert found.readout_s == pytest.approx(READOUT_S, rel=0.1)
    assert worst_m(found.poses, made.true) < 0.003
    still = adjust_keyframes(made.shared, made.start, made.held, np.zeros_like(made.rates), OPTIONS)
    assert still.readout_s == 0.0  # no rate, no readout: each image keeps a turn of its own
    assert worst_m(still.poses, made.true) < 0.01


@pytest.mark.parametrize("noise_px", [0.3, 2.0])
def test_noise_is_what_the_residuals_show(noise_px: float) -> None:
    made = scene(noise_px=noise_px)
    found = adjust_keyframes(made.shared, made.start, made.held, made.rates, OPTIONS)
    assert found.noise_px[0] == pytest.approx(noise_px, rel=0.25)


def test_depth_that_disagrees_counts_less() -> None:
    made = scene(depth_times=4.0)
    found = adjust_keyframes(made.shared, made.start, made.held, made.rates, OPTIONS)
    assert np.median(found.depth_noise) > 4
    assert worst_m(found.poses, made.true) < 0.01


def test_wrong_pairs_do_not_bend_it() -> None:
    made = scene()
    rng = np.random.default_rng(5)
    xy = made.shared.xy.copy()
    wrong = rng.random(len(xy)) < 0.05
    xy[wrong] += rng.normal(size=(int(wrong.sum()), 2)) * 30 / FOCAL
    shared = replace(made.shared, xy=xy)
    found = adjust_keyframes(shared, made.start, made.held, made.rates, OPTIONS)
    assert worst_m(found.poses, made.true) < 0.003
    assert np.median(found.chi2[wrong]) > 50


def test_what_is_held_does_not_move() -> None:
    made = scene()
    held = made.held.copy()
    held[5] = True
    found = adjust_keyframes(made.shared, made.start, held, made.rates, OPTIONS)
    np.testing.assert_allclose(found.poses[5], made.start[5], atol=1e-7)


def test_sparse_and_dense_equations_have_the_same_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    from semdb.trajectory import adjustment

    made = scene()
    dense = adjust_keyframes(made.shared, made.start, made.held, made.rates, OPTIONS)
    monkeypatch.setattr(adjustment, "DENSE_SHARE", 2.0)
    sparse = adjust_keyframes(made.shared, made.start, made.held, made.rates, OPTIONS)
    np.testing.assert_allclose(sparse.poses, dense.poses, atol=1e-6)


def test_positive_equations_are_solved_and_others_are_refused() -> None:
    rng = np.random.default_rng(3)
    half = rng.normal(size=(45, 60))
    matrix, right = half @ half.T, rng.normal(size=45)
    found = right.copy()
    assert solve_positive(np.triu(matrix), found)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-10)
    matrix[20, 20] = -1.0
    assert not solve_positive(matrix, right.copy())
