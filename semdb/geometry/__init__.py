"""SE(3), projection, back-projection and pose errors. Arrays in, arrays out; float64 unless said otherwise."""

from semdb.geometry.projection import (
    back_project,
    normalized_to_pixels,
    pixels_to_normalized,
    project,
)
from semdb.geometry.se3 import (
    POSE_UNIT_DEG,
    POSE_UNIT_M,
    invert_pose,
    pose_distances,
    pose_error,
    pose_from,
    project_to_so3,
    quat_wxyz_from_rotation,
    rotation_angle_deg,
    rotation_from_quat_wxyz,
    rotations_from_quats_wxyz,
    skew,
    slerp_wxyz,
    so3_exp,
    so3_log,
    transform_points,
)

__all__ = [
    "POSE_UNIT_DEG",
    "POSE_UNIT_M",
    "back_project",
    "invert_pose",
    "normalized_to_pixels",
    "pixels_to_normalized",
    "pose_distances",
    "pose_error",
    "pose_from",
    "project",
    "project_to_so3",
    "quat_wxyz_from_rotation",
    "rotation_angle_deg",
    "rotation_from_quat_wxyz",
    "rotations_from_quats_wxyz",
    "skew",
    "slerp_wxyz",
    "so3_exp",
    "so3_log",
    "transform_points",
]
