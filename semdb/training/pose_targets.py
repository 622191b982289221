"""Poses as what a network learns: six numbers around the mean of those that it is trained on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.geometry import pose_from, project_to_so3
from semdb.geometry.stacks import so3_exps, so3_logs
from semdb.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PoseScale:
    """`origin` ``[4, 4]`` is the mean pose; `spread` ``[6]`` how far positions (m) and rotations go from it."""

    origin: FloatArray
    spread: FloatArray

    @classmethod
    def of(cls, poses: FloatArray) -> PoseScale:
        """Of poses ``[n, 4, 4]``: mean position, chordal mean of rotations; one spread for all axes of each."""
        origin = mean_pose(poses)
        offsets = _offsets(poses, origin)
        position, rotation = (max(float(np.sqrt((part**2).mean())), 1e-3) for part in (offsets[:, :3], offsets[:, 3:]))
        return cls(origin, np.array([position] * 3 + [rotation] * 3))

    def targets(self, poses: FloatArray) -> FloatArray:
        """Poses ``[n, 4, 4]`` as ``[n, 6]``: metres, then the logarithm of the quaternion (half of the angle)."""
        return _offsets(poses, self.origin)

    def poses(self, targets: FloatArray) -> FloatArray:
        """The way back; the half angle is doubled here."""
        poses = np.tile(np.eye(4), (len(targets), 1, 1))
        poses[:, :3, 3] = self.origin[:3, 3] + targets[:, :3]
        poses[:, :3, :3] = self.origin[:3, :3] @ so3_exps(2.0 * targets[:, 3:])
        return poses


def mean_pose(poses: FloatArray) -> FloatArray:
    """The mean position and the chordal mean rotation of poses ``[n, 4, 4]``."""
    return pose_from(project_to_so3(poses[:, :3, :3].mean(axis=0)), poses[:, :3, 3].mean(axis=0))


def _offsets(poses: FloatArray, origin: FloatArray) -> FloatArray:
    turned = origin[:3, :3].T @ poses[:, :3, :3]
    return np.concatenate([poses[:, :3, 3] - origin[:3, 3], 0.5 * so3_logs(turned)], axis=1)
