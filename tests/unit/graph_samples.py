"""Trajectories with odometry that drifts and closures that are known to be right or wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.geometry.stacks import invert_poses, perturbed
from semdb.trajectory.consistency import Chain, chain_of
from semdb.trajectory.edges import Edge, EdgeKind
from semdb.types import FloatArray

STEP = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005])  # noise of odometry between keyframes (m, rad)
CLOSURE = np.array([0.008, 0.008, 0.008, 0.004, 0.004, 0.004])


@dataclass(frozen=True, eq=False)
class Walk:
    true: FloatArray  # [n, 4, 4]
    odometry: FloatArray  # [n, 4, 4] what odometry makes of it
    steps: FloatArray  # [n, 6, 6]
    edges: list[Edge]  # of odometry

    @property
    def chain(self) -> Chain:
        return chain_of(self.odometry, [0] * len(self.true), self.steps)


def walk(count: int = 120, seed: int = 0) -> Walk:
    """Twice around a circle of 2 m radius, looking outwards."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 4 * np.pi, count)
    true = np.tile(np.eye(4), (count, 1, 1))
    forward = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    true[:, :3, :3] = np.stack([np.cross(down, forward), down, forward], axis=2)
    true[:, :3, 3] = 2 * forward + 0.1 * rng.normal(size=(count, 3)).cumsum(axis=0) * 0.05
    relative = invert_poses(true[:-1]) @ true[1:]
    noisy = perturbed(relative, rng.normal(size=(count - 1, 6)) * STEP)
    odometry = [np.eye(4)]
    for motion in noisy:
        odometry.append(odometry[-1] @ motion)
    information = np.diag(1 / STEP**2)
    edges = [Edge(n, n + 1, EdgeKind.ODOMETRY, motion, information, 100) for n, motion in enumerate(noisy)]
    steps = np.tile(np.diag(STEP**2), (count, 1, 1))
    return Walk(true, np.stack(odometry), steps, edges)


def closures(sample: Walk, count: int, seed: int = 1) -> list[Edge]:
    """Right ones: the second round against the first."""
    rng = np.random.default_rng(seed)
    half = len(sample.true) // 2
    found = []
    for second in np.sort(rng.choice(np.arange(half + 4, len(sample.true)), count, replace=False)).tolist():
        first = second - half + int(rng.integers(-2, 3))
        relative = invert_poses(sample.true[first : first + 1]) @ sample.true[second : second + 1]
        noisy = perturbed(relative, rng.normal(size=(1, 6)) * CLOSURE)[0]
        found.append(Edge(first, second, EdgeKind.LOOP, noisy, np.diag(1 / CLOSURE**2), 60))
    return found


def wrong_closures(sample: Walk, count: int, seed: int = 2) -> list[Edge]:
    """Closures between places that have nothing to do with each other."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        first, second = sorted(rng.choice(len(sample.true), 2, replace=False).tolist())
        if np.linalg.norm(sample.true[first, :3, 3] - sample.true[second, :3, 3]) < 1.0:
            continue
        relative = perturbed(np.eye(4)[None], rng.normal(size=(1, 6)) * 0.2)[0]
        found.append(Edge(first, second, EdgeKind.LOOP, relative, np.diag(1 / CLOSURE**2), 60))
    return found
