"""A made-up world for the benchmark of the coarse step: trajectories, what the camera sees, and place vectors.

Recordings are random walks through rooms of a low-dimensional space; a random ReLU network makes of each point a vector
as the average pooling of a CNN gives it (no negative entries, unit length), so that neighbours in time are neighbours
in the vectors, and rooms far apart can look alike. Objects stand along a trajectory, each in view for a while; their
classes follow Zipf's law, about six are in view. Everything follows from the seed and the number of the recording, so
any part can be made by itself, in any order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.class_score import strengths
from semdb.perception.detectors.coco import COCO_91, NO_OBJECT

LENGTH = 1000  # keyframes of a recording
LATENT, HIDDEN, SIZE = 24, 256, 2048
STEP = 0.06  # between keyframes
ROOMS = 0.6  # spread of the rooms along each axis
LOOK = 0.3  # what differs between two looks at the same place: light, people
OBJECTS_IN_VIEW = 6.0
FRAMES_IN_VIEW = 25.0
CATEGORIES = tuple(name for name in COCO_91 if name not in NO_OBJECT)  # 80


@dataclass(frozen=True)
class Trajectory:
    """`latent` float32 ``[n, LATENT]``; object k stands in view of the keyframes `first[k]` to ``last[k] - 1``."""

    latent: np.ndarray
    category: np.ndarray  # [k] position in CATEGORIES
    height: np.ndarray  # [k] of the centre in the image: -8 at a quarter of it, 8 at three quarters
    first: np.ndarray
    last: np.ndarray


@dataclass(frozen=True)
class Seen:
    """All that the keyframes of a recording show, by keyframe (0 to LENGTH - 1), then category; arrays ``[n]``."""

    keyframe: np.ndarray
    category: np.ndarray
    height: np.ndarray
    score: np.ndarray  # multiples of 1/64, so that sums are exact in any order


@dataclass(frozen=True)
class Query:
    """An image that is no keyframe: objects per class, their strengths, and a unit vector float32 ``[SIZE]``."""

    counts: dict[str, float]
    strengths: dict[str, tuple[int, int]]
    vector: np.ndarray


class World:
    """All that is drawn from one seed."""

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        rng = np.random.default_rng([seed, 1])
        self._in = rng.normal(0, 1, (LATENT, HIDDEN)).astype(np.float32)
        self._in_bias = rng.normal(0, 1, HIDDEN).astype(np.float32)
        self._out = rng.normal(0, 1 / np.sqrt(HIDDEN), (HIDDEN, SIZE)).astype(np.float32)
        self._out_bias = rng.normal(-0.5, 0.5, SIZE).astype(np.float32)
        zipf = 1 / np.arange(1, len(CATEGORIES) + 1)
        self.zipf = zipf / zipf.sum()

    def trajectory(self, number: int) -> Trajectory:
        """The recording `number`."""
        rng = np.random.default_rng([self.seed, 2, number])
        turns = rng.normal(0, 1, (LENGTH, LATENT))
        speed = np.zeros(LATENT)
        velocity = np.empty((LENGTH, LATENT))
        for i, turn in enumerate(turns):  # a camera keeps its direction for some keyframes
            speed = 0.9 * speed + 0.44 * turn
            velocity[i] = speed
        walk = rng.normal(0, ROOMS, LATENT) + STEP / np.sqrt(LATENT) * np.cumsum(velocity, axis=0)
        total = rng.poisson(LENGTH * OBJECTS_IN_VIEW / FRAMES_IN_VIEW)
        # Each room has its own furniture: some classes are common in it, others are missing.
        furniture = self.zipf * rng.gamma(0.7, 1, len(CATEGORIES))
        category = rng.choice(len(CATEGORIES), total, p=furniture / furniture.sum())
        first = rng.integers(-int(FRAMES_IN_VIEW), LENGTH, total)
        last = first + rng.geometric(1 / FRAMES_IN_VIEW, total)
        height = rng.integers(-8, 9, total)
        first, last = np.clip(first, 0, LENGTH), np.clip(last, 0, LENGTH)
        return Trajectory(walk.astype(np.float32), category, height, first, last)

    def vectors(self, latent: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Unit vectors float32 ``[n, SIZE]`` of points ``[n, LATENT]``; `rng` draws what differs between two looks."""
        hidden = np.maximum(latent @ self._in + self._in_bias, 0)
        hidden += rng.normal(0, LOOK, hidden.shape).astype(np.float32)
        out = np.maximum(hidden @ self._out + self._out_bias, 0)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        return np.asarray(out, dtype=np.float32)

    def recording_vectors(self, number: int) -> np.ndarray:
        """Vectors float32 ``[LENGTH, SIZE]`` of the keyframes of the recording `number`."""
        return self.vectors(self.trajectory(number).latent, np.random.default_rng([self.seed, 3, number]))

    def seen(self, number: int) -> Seen:
        """What the keyframes of the recording `number` show."""
        trajectory = self.trajectory(number)
        frames = trajectory.last - trajectory.first
        start = np.repeat(trajectory.first, frames)
        offset = np.arange(frames.sum()) - np.repeat(np.cumsum(frames) - frames, frames)
        keyframe = start + offset
        category, height = np.repeat(trajectory.category, frames), np.repeat(trajectory.height, frames)
        order = np.lexsort((category, keyframe))
        score = np.random.default_rng([self.seed, 6, number]).integers(32, 65, len(order)) / 64
        return Seen(keyframe[order], category[order], height[order], score)

    def queries(self, recordings: int, number: int) -> list[Query]:
        """Looks from between two keyframes, with a detector that misses every eighth object and invents some."""
        rng = np.random.default_rng([self.seed, 4, recordings])
        queries = []
        while len(queries) < number:
            trajectory = self.trajectory(int(rng.integers(recordings)))
            at = int(rng.integers(LENGTH - 1))
            there = np.flatnonzero((trajectory.first <= at) & (at < trajectory.last))
            there = there[rng.random(len(there)) > 0.125]
            invented = rng.choice(len(CATEGORIES), rng.poisson(0.3), p=self.zipf)
            category = np.concatenate([trajectory.category[there], invented])
            if not len(category):
                continue  # nothing to filter by
            middle = trajectory.latent[at : at + 2].mean(axis=0, keepdims=True)
            middle += rng.normal(0, STEP / np.sqrt(LATENT), LATENT).astype(np.float32)
            vector = self.vectors(middle, rng)[0]
            height = np.concatenate([trajectory.height[there], rng.integers(-8, 9, len(invented))])
            scores = rng.uniform(0.5, 1, len(category))
            names = [CATEGORIES[k] for k in category]
            found = strengths(zip(names, scores.tolist(), (0.5 + height / 32).tolist(), strict=True))
            queries.append(Query({name: float(names.count(name)) for name in sorted(names)}, found, vector))
        return queries
