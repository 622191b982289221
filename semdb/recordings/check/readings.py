"""What the numbers of poses may mean: every way in which they could have been written, and what they are then."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry import invert_pose, pose_from, quat_wxyz_from_rotation, rotation_from_quat_wxyz
from semdb.recordings.options import AXES, CAMERA_FROM_WORLD, WORLD_FROM_CAMERA
from semdb.types import FloatArray


@dataclass(frozen=True, slots=True)
class Reading:
    """How poses are read: direction, axes of the camera (``arkit`` is ``opengl``), order of quaternions."""

    poses_are: str = WORLD_FROM_CAMERA
    axes: str = "opencv"
    quaternion: str = "xyzw"

    def differences(self, other: Reading) -> dict[str, str]:
        """The options of `other` that are not as here."""
        names = ("poses_are", "axes", "quaternion")
        return {name: getattr(other, name) for name in names if getattr(other, name) != getattr(self, name)}


AS_USUAL = Reading()


def readings(current: Reading, *, quaternions: bool) -> Iterator[Reading]:
    """All readings, the current one first, then by how much they change."""
    others = []
    for poses_are in (WORLD_FROM_CAMERA, CAMERA_FROM_WORLD):
        for axes in ("opencv", "opengl", "ros"):
            for quaternion in ("xyzw", "wxyz") if quaternions else (current.quaternion,):
                others.append(Reading(poses_are, axes, quaternion))
    usual = replace(current, axes="opengl" if current.axes == "arkit" else current.axes)
    yield from sorted(others, key=lambda other: len(usual.differences(other)))


def reread(poses: FloatArray, current: Reading, other: Reading) -> FloatArray:
    """``world_from_camera`` ``[n, 4, 4]`` if the numbers, now read as `current` says, are read as `other` says."""
    return np.stack([_reread(pose, current, other) for pose in poses])


def _reread(pose: FloatArray, current: Reading, other: Reading) -> FloatArray:
    raw = pose @ invert_pose(AXES[current.axes])
    raw = invert_pose(raw) if current.poses_are == CAMERA_FROM_WORLD else raw
    if current.quaternion != other.quaternion:
        w, x, y, z = quat_wxyz_from_rotation(raw[:3, :3])
        numbers = (x, y, z, w) if current.quaternion == "xyzw" else (w, x, y, z)
        quat_wxyz = numbers if other.quaternion == "wxyz" else (numbers[3], *numbers[:3])
        raw = pose_from(rotation_from_quat_wxyz(quat_wxyz), raw[:3, 3])
    raw = invert_pose(raw) if other.poses_are == CAMERA_FROM_WORLD else raw
    return np.asarray(raw @ AXES[other.axes])
