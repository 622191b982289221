"""SE(3): poses, rotations, quaternions and pose errors. Arrays in, arrays out; float64 unless said otherwise."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.types import FloatArray

FARTHEST_POSE_M = 1e8  # of a pose from the origin of its map: projections of the Earth have at most a fifth of it
POSE_UNIT_M, POSE_UNIT_DEG = 0.3, 15.0  # so far apart two poses are at `pose_distances` of 1


def project_to_so3(matrix: npt.ArrayLike) -> FloatArray:
    """The rotation nearest to `matrix` ``[3, 3]`` in the Frobenius norm (polar decomposition by SVD).

    Raises ValueError when `matrix` is not finite or is nearer to a reflection than to a rotation.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape != (3, 3) or not np.isfinite(m).all():
        raise ValueError("not a finite 3x3 matrix")
    if np.linalg.det(m) <= 0:
        raise ValueError("not a rotation: its determinant is not positive")
    u, _, vt = np.linalg.svd(m)
    rotation: FloatArray = u @ vt
    return rotation


def pose_from(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> FloatArray:
    """A 4x4 pose of `rotation` ``[3, 3]`` and `translation` ``[3]`` metres."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def invert_pose(pose: FloatArray) -> FloatArray:
    """The inverse of a rigid ``[4, 4]`` pose, exactly rigid again."""
    rotation = pose[:3, :3].T
    return pose_from(rotation, -rotation @ pose[:3, 3])


def transform_points(pose: FloatArray, points: npt.ArrayLike) -> FloatArray:
    """`points` ``[..., 3]`` moved by `pose` ``[4, 4]``."""
    moved: FloatArray = np.asarray(points, dtype=np.float64) @ pose[:3, :3].T + pose[:3, 3]
    return moved


def quat_wxyz_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternion ``[4]`` (w, x, y, z), w >= 0, of a rotation ``[3, 3]`` (Shepperd's method)."""
    m = rotation
    trace = float(np.trace(m))
    candidates = np.array([trace, m[0, 0], m[1, 1], m[2, 2]])
    largest = int(np.argmax(candidates))
    if largest == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = m[k, j] - m[j, k]
        q[1 + i] = 1 + m[i, i] - m[j, j] - m[k, k]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + k] = m[k, i] + m[i, k]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def rotation_from_quat_wxyz(quat_wxyz: npt.ArrayLike) -> FloatArray:
    """Rotation ``[3, 3]`` of a quaternion ``[4]`` (w, x, y, z) of any length but zero. Raises ValueError."""
    q = np.asarray(quat_wxyz, dtype=np.float64)
    if q.shape != (4,):
        raise ValueError("not a quaternion: four finite numbers, not all zero, are needed")
    rotation: FloatArray = rotations_from_quats_wxyz(q[np.newaxis])[0]
    return rotation


def rotations_from_quats_wxyz(quats_wxyz: FloatArray) -> FloatArray:
    """Rotations ``[n, 3, 3]`` of quaternions ``[n, 4]`` (w, x, y, z) of any length but zero. Raises ValueError."""
    norm = np.sqrt((quats_wxyz * quats_wxyz).sum(axis=1, keepdims=True))
    if not np.isfinite(norm).all() or (norm < 1e-12).any():
        raise ValueError("not a quaternion: four finite numbers, not all zero, are needed")
    w, x, y, z = (quats_wxyz / norm).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def slerp_wxyz(first: FloatArray, second: FloatArray, fraction: float) -> FloatArray:
    """Spherical interpolation between two unit quaternions ``[4]``, the short way round."""
    dot = float(first @ second)
    if dot < 0:
        second, dot = -second, -dot
    angle = float(np.arctan2(np.linalg.norm(second - dot * first), dot))
    if angle < 1e-9:
        mixed = (1 - fraction) * first + fraction * second
    else:
        mixed = (np.sin((1 - fraction) * angle) * first + np.sin(fraction * angle) * second) / np.sin(angle)
    result: FloatArray = mixed / np.linalg.norm(mixed)
    return result


def skew(v: FloatArray) -> FloatArray:
    """``skew(v) @ u == cross(v, u)``."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def so3_exp(omega: npt.ArrayLike) -> FloatArray:
    """Rotation ``[3, 3]`` of a rotation vector ``[3]`` in radians (Rodrigues)."""
    w = np.asarray(omega, dtype=np.float64)
    angle = float(np.linalg.norm(w))
    k = skew(w)
    if angle < 1e-8:
        return np.asarray(np.eye(3) + k + 0.5 * k @ k)
    a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / (angle * angle)
    return np.asarray(np.eye(3) + a * k + b * k @ k)


def so3_log(rotation: FloatArray) -> FloatArray:
    """Rotation vector ``[3]`` in radians, at most pi long, of a rotation ``[3, 3]``: the inverse of `so3_exp`."""
    q = quat_wxyz_from_rotation(rotation)
    q = q if q[0] >= 0 else -q
    sine = float(np.linalg.norm(q[1:]))
    return np.asarray(q[1:] * (2 * np.arctan2(sine, q[0]) / sine if sine > 1e-12 else 2.0))


def rotation_angle_deg(rotation: FloatArray) -> float:
    """Angle of a rotation in degrees by atan2, exact near 0 and near 180."""
    q = quat_wxyz_from_rotation(rotation)
    return float(np.degrees(2 * np.arctan2(np.linalg.norm(q[1:]), q[0])))


def pose_error(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two ``[4, 4]`` poses."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    return distance, rotation_angle_deg(estimate[:3, :3].T @ truth[:3, :3])


def pose_offset(pose: FloatArray, other: FloatArray) -> FloatArray:
    """What moves `other` to `pose`, both ``[4, 4]``: ``[6]``, metres in the world, then a rotation vector (rad)."""
    return np.concatenate([pose[:3, 3] - other[:3, 3], so3_log(pose[:3, :3] @ other[:3, :3].T)])


def pose_distances(pose: FloatArray, poses: FloatArray) -> FloatArray:
    """How far `poses` ``[n, 4, 4]`` are from `pose` ``[4, 4]``, ``[n]``: metres / 0.3 plus degrees / 15, no unit."""
    metres = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
    relative = pose[:3, :3].T @ poses[:, :3, :3]
    # atan2 of the sine (from the skew part) and the cosine (from the trace): exact near 0, safe near 180 degrees
    skew_part = np.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        axis=1,
    )
    angles = np.degrees(np.arctan2(np.linalg.norm(skew_part, axis=1), np.trace(relative, axis1=1, axis2=2) - 1))
    return np.asarray(metres / POSE_UNIT_M + angles / POSE_UNIT_DEG)
