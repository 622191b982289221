"""A pose over time: an error-state Kalman filter on SE(3) whose measurements have errors in common.

State are the error of the pose (translation in the world, left rotation) and an error that measurements in the map
share: keyframes' poses and depth are wrong by the same as long as the same ones are seen. It is a Gauss-Markov process
over the way that the camera goes (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 8.2), so that a camera that stands still does not get surer and surer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.geometry import POSE_UNIT_DEG, POSE_UNIT_M, pose_from, pose_offset, project_to_so3, skew, so3_exp, so3_log
from semdb.tracking.options import MotionOptions
from semdb.types import FloatArray

POSE, SHARED = slice(0, 6), slice(6, 12)


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """`pose` ``[4, 4]`` world from camera; `covariance` ``[12, 12]`` of it and of the shared error `bias` ``[6]``."""

    pose: FloatArray
    bias: FloatArray
    covariance: FloatArray

    @property
    def pose_covariance(self) -> FloatArray:
        """``[6, 6]``"""
        return self.covariance[POSE, POSE]


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A motion ``[4, 4]`` in the camera's own frame, and its covariance ``[6, 6]`` there (m, then rad)."""

    before_from_after: FloatArray
    covariance: FloatArray


def begin(pose: FloatArray, covariance: FloatArray, options: MotionOptions) -> FilterState:
    """The state after a first measurement in the map."""
    whole = np.zeros((12, 12))
    shared = options.lasting * covariance
    whole[POSE, POSE] = covariance
    whole[SHARED, SHARED] = shared
    whole[POSE, SHARED] = whole[SHARED, POSE] = -shared  # the pose is off by what is measured too much
    return FilterState(pose, np.zeros(6), whole)


def moved(state: FilterState, step: Step, options: MotionOptions) -> FilterState:
    """The state after a motion of the camera."""
    rotation, transition = state.pose[:3, :3], transition_of(state, step, options)
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = rotation
    kept = transition[6, 6]
    noise = np.zeros((12, 12))
    noise[POSE, POSE] = turn @ step.covariance @ turn.T
    noise[SHARED, SHARED] = (1 - kept**2) * state.covariance[SHARED, SHARED]
    covariance = transition @ state.covariance @ transition.T + noise
    pose = state.pose @ step.before_from_after
    pose[:3, :3] = project_to_so3(pose[:3, :3])
    return FilterState(pose, kept * state.bias, _symmetric(covariance))


def transition_of(state: FilterState, step: Step, options: MotionOptions) -> FloatArray:
    """What a motion makes of the errors before it ``[12, 12]``."""
    transition = np.eye(12)
    transition[:3, 3:6] = -skew(state.pose[:3, :3] @ step.before_from_after[:3, 3])
    transition[SHARED, SHARED] *= np.exp(-way(step.before_from_after) / options.forgotten)
    return transition


def way(motion: FloatArray) -> float:
    """How far a motion ``[4, 4]`` goes, in units of `pose_distances`."""
    turn = np.degrees(np.linalg.norm(so3_log(motion[:3, :3])))
    return float(np.linalg.norm(motion[:3, 3]) / POSE_UNIT_M + turn / POSE_UNIT_DEG)


def shifted(pose: FloatArray, error: FloatArray) -> FloatArray:
    """`pose` moved by ``[6]``, the inverse of `pose_offset`."""
    return pose_from(project_to_so3(so3_exp(error[3:]) @ pose[:3, :3]), pose[:3, 3] + error[:3])


def surprise(state: FilterState, pose: FloatArray, covariance: FloatArray) -> float:
    """Squared distance, in standard deviations, of a measured pose from where it is expected: chi-square of six."""
    innovation = pose_offset(pose, state.pose)
    expected = state.pose_covariance + covariance
    return float(innovation @ np.linalg.solve(expected, innovation))


def faded(state: FilterState, times: float) -> FilterState:
    """A state that a convincing measurement contradicts: its variance grows, so that it is not defended.

    A fading memory, as in Fagin, Recursive linear regression theory (1964), at the one frame where it is needed.
    """
    return FilterState(state.pose, state.bias, state.covariance * times)


def measured(state: FilterState, pose: FloatArray, covariance: FloatArray, options: MotionOptions) -> FilterState:
    """The state after a measurement in the map, `pose` with `covariance` ``[6, 6]``."""
    shared, own = options.lasting * covariance, (1 - options.lasting) * covariance
    before = _with_shared(state.covariance, shared)
    seen = np.concatenate([np.eye(6), np.eye(6)], axis=1)
    innovation = pose_offset(pose, state.pose) - state.bias
    total = seen @ before @ seen.T + own
    gain = np.linalg.solve(total, seen @ before).T
    change = gain @ innovation
    rest = np.eye(12) - gain @ seen
    after = _symmetric(rest @ before @ rest.T + gain @ own @ gain.T)
    return FilterState(shifted(state.pose, change[POSE]), state.bias + change[SHARED], after)


def _with_shared(covariance: FloatArray, shared: FloatArray) -> FloatArray:
    """The covariance with a shared error that is at least as uncertain as that of the measurement at hand."""
    grown = covariance.copy()
    missing = np.diag(shared) - np.diag(covariance[SHARED, SHARED])
    grown[SHARED, SHARED] += np.diag(np.maximum(missing, 0.0))
    return grown


def _symmetric(matrix: FloatArray) -> FloatArray:
    half: FloatArray = (matrix + matrix.T) / 2
    return half
