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
    first: np.ndarray
    last: np.ndarray


@dataclass(frozen=True)
class Query:
    """Objects per class, and the unit vector float32 ``[SIZE]``, of an image that is no keyframe."""

    counts: dict[str, float]
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
        return Trajectory(walk.astype(np.float32), category, np.clip(first, 0, LENGTH), np.clip(last, 0, LENGTH))

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

    def objects(self, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
        """Keyframe (0 to LENGTH - 1, ascending) and category of every object that every keyframe sees."""
        seen = trajectory.last - trajectory.first
        start = np.repeat(trajectory.first, seen)
        offset = np.arange(seen.sum()) - np.repeat(np.cumsum(seen) - seen, seen)
        keyframe, category = start + offset, np.repeat(trajectory.category, seen)
        order = np.lexsort((category, keyframe))
        return keyframe[order], category[order]

    def queries(self, recordings: int, number: int) -> list[Query]:
        """Looks from between two keyframes, with a detector that misses every eighth object and invents some."""
        rng = np.random.default_rng([self.seed, 4, recordings])
        queries = []
        while len(queries) < number:
            trajectory = self.trajectory(int(rng.integers(recordings)))
            at = int(rng.integers(LENGTH - 1))
            seen = trajectory.category[(trajectory.first <= at) & (at < trajectory.last)]
            seen = seen[rng.random(len(seen)) > 0.125]
            seen = np.concatenate([seen, rng.choice(len(CATEGORIES), rng.poisson(0.3), p=self.zipf)])
            if not len(seen):
                continue  # nothing to filter by
            middle = trajectory.latent[at : at + 2].mean(axis=0, keepdims=True)
            middle += rng.normal(0, STEP / np.sqrt(LATENT), LATENT).astype(np.float32)
            names, counts = np.unique(seen, return_counts=True)
            found = {CATEGORIES[k]: float(count) for k, count in zip(names, counts, strict=True)}
            queries.append(Query(found, self.vectors(middle, rng)[0]))
        return queries
