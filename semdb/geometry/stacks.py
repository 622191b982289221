"""Many poses at once: SE(3) on stacks ``[n, 4, 4]``.

Tangent vectors are translation first: ``(v, w)`` ``[n, 6]``. A right perturbation turns a pose (R, t) into
(R exp(w), t + R v): `v` and `w` are in the frame of the pose itself.
"""

from __future__ import annotations

import numpy as np

from semdb.types import FloatArray


def invert_poses(poses: FloatArray) -> FloatArray:
    """Inverses of rigid poses ``[n, 4, 4]``, exactly rigid again."""
    inverse = np.zeros_like(poses)
    inverse[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    inverse[:, :3, 3] = -np.einsum("nij,nj->ni", inverse[:, :3, :3], poses[:, :3, 3])
    inverse[:, 3, 3] = 1.0
    return inverse


def skews(vectors: FloatArray) -> FloatArray:
    """``skews(v)[n] @ u == cross(v[n], u)``, ``[n, 3, 3]`` of ``[n, 3]``."""
    found = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    found[:, 0, 1], found[:, 0, 2] = -z, y
    found[:, 1, 0], found[:, 1, 2] = z, -x
    found[:, 2, 0], found[:, 2, 1] = -y, x
    return found


def so3_exps(omegas: FloatArray) -> FloatArray:
    """Rotations ``[n, 3, 3]`` of rotation vectors ``[n, 3]`` in radians."""
    square = (omegas * omegas).sum(axis=1)
    angle = np.sqrt(square)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    sine = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    half = np.where(small, 0.5 - square / 24, (1 - np.cos(safe)) / safe**2)
    cross = skews(omegas)
    return np.asarray(np.eye(3) + sine[:, None, None] * cross + half[:, None, None] * (cross @ cross))


def so3_logs(rotations: FloatArray) -> FloatArray:
    """Rotation vectors ``[n, 3]`` in radians, at most pi long, of rotations ``[n, 3, 3]``."""
    m = rotations
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    choice = np.argmax(np.stack([trace, m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]]), axis=0)
    quats = np.empty((len(m), 4))
    for case in range(4):  # Shepperd's method, as in `quat_wxyz_from_rotation`
        rows = np.flatnonzero(choice == case)
        r = m[rows]
        if case == 0:
            quats[rows] = np.stack(
                [1 + trace[rows], r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1
            )
            continue
        i = case - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        quats[rows, 0] = r[:, k, j] - r[:, j, k]
        quats[rows, 1 + i] = 1 + r[:, i, i] - r[:, j, j] - r[:, k, k]
        quats[rows, 1 + j] = r[:, j, i] + r[:, i, j]
        quats[rows, 1 + k] = r[:, k, i] + r[:, i, k]
    quats *= np.where(quats[:, :1] < 0, -1.0, 1.0) / np.linalg.norm(quats, axis=1, keepdims=True)
    sine = np.linalg.norm(quats[:, 1:], axis=1)
    safe = np.where(sine > 1e-12, sine, 1.0)
    factor = np.where(sine > 1e-12, 2 * np.arctan2(sine, quats[:, 0]) / safe, 2.0)
    return np.asarray(quats[:, 1:] * factor[:, None])


def inverse_right_jacobians(omegas: FloatArray) -> FloatArray:
    """How ``log(exp(omega) exp(w))`` grows with a small w: ``[n, 3, 3]`` of ``[n, 3]``.

    Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018, equation (144).
    """
    square = (omegas * omegas).sum(axis=1)
    angle = np.sqrt(square)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    outer = np.where(small, 1 / 12 + square / 720, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe)))
    cross = skews(omegas)
    return np.asarray(np.eye(3) + 0.5 * cross + outer[:, None, None] * (cross @ cross))


def adjoints(poses: FloatArray) -> FloatArray:
    """``[n, 6, 6]``: what moves a right perturbation of the identity through a pose, translation first."""
    found = np.zeros((len(poses), 6, 6))
    rotation = poses[:, :3, :3]
    found[:, :3, :3] = found[:, 3:, 3:] = rotation
    found[:, :3, 3:] = skews(poses[:, :3, 3]) @ rotation
    return found


def differences(reference: FloatArray, poses: FloatArray) -> FloatArray:
    """Right perturbations ``[n, 6]`` that turn each of `reference` ``[n, 4, 4]`` into its one of `poses`."""
    inverse = np.swapaxes(reference[:, :3, :3], 1, 2)
    shift = np.einsum("nij,nj->ni", inverse, poses[:, :3, 3] - reference[:, :3, 3])
    return np.concatenate([shift, so3_logs(inverse @ poses[:, :3, :3])], axis=1)


def perturbed(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """`poses` ``[n, 4, 4]`` after right perturbations `steps` ``[n, 6]``."""
    moved = poses.copy()
    moved[:, :3, 3] += np.einsum("nij,nj->ni", poses[:, :3, :3], steps[:, :3])
    moved[:, :3, :3] = poses[:, :3, :3] @ so3_exps(steps[:, 3:])
    return moved
