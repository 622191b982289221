"""Poses weighed against what frames after them showed: fixed-lag smoothing of the filter's answers.

Rauch, Tung, Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965, on the errors of
the poses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from semdb.geometry import pose_offset
from semdb.tracking.pose_filter import POSE, FilterState, shifted
from semdb.types import FloatArray

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """One frame of the filter: `predicted` from the frame before by `transition` ``[12, 12]``, and `after` its image.

    `predicted` is None where a frame has nothing to do with those before it, `after` where the camera is lost.
    """

    predicted: FilterState | None
    transition: FloatArray | None
    after: FilterState | None


class FixedLag(Generic[Item]):
    """Gives each item back when `lag` more have come, with the pose and covariance that all of them make likely."""

    def __init__(self, lag: int) -> None:
        self._lag = lag
        self._waiting: deque[tuple[Item, Passage]] = deque()

    def push(self, item: Item, passage: Passage) -> Iterator[tuple[Item, FloatArray | None, FloatArray | None]]:
        """Takes the next item; gives back the one that is `lag` before it, if there is one."""
        self._waiting.append((item, passage))
        if len(self._waiting) > self._lag:
            yield self._oldest()

    def flush(self) -> Iterator[tuple[Item, FloatArray | None, FloatArray | None]]:
        """Gives back the rest, in order."""
        while self._waiting:
            yield self._oldest()

    def _oldest(self) -> tuple[Item, FloatArray | None, FloatArray | None]:
        pose, covariance = smoothed([passage for _, passage in self._waiting])
        item, _ = self._waiting.popleft()
        return item, pose, covariance


def smoothed(passages: list[Passage]) -> tuple[FloatArray | None, FloatArray | None]:
    """Pose ``[4, 4]`` and covariance ``[6, 6]`` of the first of successive frames, by all that belong to it."""
    first = passages[0].after
    if first is None:
        return None, None
    count = 1
    while count < len(passages) and passages[count].predicted is not None and passages[count].after is not None:
        count += 1
    change, covariance = np.zeros(12), None
    for number in range(count - 1, 0, -1):
        change, covariance = _back(passages[number - 1], passages[number], change, covariance)
    if covariance is None:
        return first.pose, first.pose_covariance
    return shifted(first.pose, change[POSE]), covariance[POSE, POSE]


def _back(
    before: Passage, passage: Passage, change: FloatArray, covariance: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """The change ``[12]`` of the state `before`, and its covariance, if the one after `passage` has these."""
    start, predicted, after = before.after, passage.predicted, passage.after
    if start is None or predicted is None or after is None or passage.transition is None:
        raise AssertionError("a passage between states has both")
    later = after.covariance if covariance is None else covariance
    gain = np.linalg.solve(predicted.covariance, passage.transition @ start.covariance).T
    pose = shifted(after.pose, change[POSE])
    off = np.concatenate([pose_offset(pose, predicted.pose), after.bias + change[6:] - predicted.bias])
    kept = start.covariance + gain @ (later - predicted.covariance) @ gain.T
    return gain @ off, (kept + kept.T) / 2
