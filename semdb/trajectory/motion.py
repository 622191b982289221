"""Where the camera should be by now: it goes on as it went."""

from __future__ import annotations

import numpy as np

from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp, so3_log
from semdb.geometry.stacks import so3_logs
from semdb.types import FloatArray, IntArray

STEADY_M, STEADY_DEG = 0.08, 2.5  # what moves a point two metres away by about twenty pixels
LONGEST_STEP_S = 0.6  # between frames that tell how the camera turned between them


class Motion:
    """Constant velocity, in the camera's own frame, from the last two poses of one piece."""

    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s
        self._poses: list[tuple[float, FloatArray]] = []
        self.steady = True  # the last pose was about where it was predicted: worth to be tried again

    def seen(self, time_s: float, pose: FloatArray) -> None:
        """The camera was at `pose` ``[4, 4]``."""
        predicted = self.predict(time_s) if len(self._poses) > 1 else None
        if predicted is not None:
            metres, degrees = pose_error(predicted, pose)
            self.steady = metres < STEADY_M and degrees < STEADY_DEG
        self._poses = [*self._poses[-1:], (time_s, pose)]

    def forget(self) -> None:
        self._poses = []

    @property
    def last(self) -> FloatArray | None:
        return self._poses[-1][1] if self._poses else None

    def gap_s(self, time_s: float) -> float:
        """How long ago the last pose was; infinite without one."""
        return time_s - self._poses[-1][0] if self._poses else np.inf

    def predict(self, time_s: float, longest_s: float | None = None) -> FloatArray | None:
        """The pose ``[4, 4]`` at `time_s`; None where nothing is known, or for more than `longest_s`, or the usual."""
        longest_s = self._longest_s if longest_s is None else longest_s
        if self.gap_s(time_s) > longest_s:
            return None
        now, pose = self._poses[-1]
        if len(self._poses) < 2:
            return pose
        before, older = self._poses[0]
        if not 0 < now - before <= longest_s:
            return pose
        share = (time_s - now) / (now - before)
        step = invert_pose(older) @ pose
        return pose @ pose_from(so3_exp(share * so3_log(step[:3, :3])), share * step[:3, 3])


def turn_rates(rotations: FloatArray, times_s: FloatArray, worlds: IntArray) -> FloatArray:
    """How a camera turns at each of its rotations ``[n, 3, 3]``, ``[n, 3]`` rad/s in its own frame.

    The mean of the steps before and after, each weighed by how short it is; steps between different `worlds` ``[n]``,
    or of more than 0.6 s, do not count. Zero where there is none.
    """
    rates, weights = np.zeros((len(rotations), 3)), np.zeros(len(rotations))
    if len(rotations) < 2:
        return rates
    passed = np.diff(times_s)
    counts = (passed > 0) & (passed <= LONGEST_STEP_S) & (worlds[1:] == worlds[:-1])
    steps = so3_logs(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    safe = np.where(counts, passed, 1.0)
    rate, weight = steps / safe[:, None], np.where(counts, 1 / safe, 0.0)
    for rows in (slice(0, -1), slice(1, None)):
        rates[rows] += rate * weight[:, None]
        weights[rows] += weight
    return rates / np.maximum(weights, 1e-12)[:, None]
