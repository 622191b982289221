"""Which keyframe near a pose joins the one that gave it: one on the other side."""

from __future__ import annotations

import numpy as np

from semdb.geometry import POSE_UNIT_DEG, POSE_UNIT_M, so3_log
from semdb.types import FloatArray

SIDE_WEIGHT = 0.7  # 0: the nearest; 1: at a right angle counts, right opposite costs nothing


def motions(pose: FloatArray, poses: FloatArray) -> FloatArray:
    """From `pose` ``[4, 4]`` to `poses` ``[n, 4, 4]``: shifts and turns ``[n, 6]`` in its frame.

    The units are those of `semdb.geometry.pose_distances`, which adds the lengths of the two halves.
    """
    rotation = pose[:3, :3]
    shifts = (poses[:, :3, 3] - pose[:3, 3]) @ rotation / POSE_UNIT_M
    turns = [np.degrees(so3_log(rotation.T @ other[:3, :3])) / POSE_UNIT_DEG for other in poses]
    return np.concatenate([shifts, np.reshape(turns, (-1, 3))], axis=1)


def by_side(pose: FloatArray, matched: FloatArray, poses: FloatArray) -> list[int]:
    """Order of `poses` ``[n, 4, 4]``: near `pose` first, and rather on the other side of it than `matched` ``[4, 4]``.

    The errors of recorded poses drift from keyframe to keyframe. Those of two keyframes with the query between them
    cancel better than those of two on one side, and points are seen from a wider base.
    """
    there, back = motions(pose, poses), motions(pose, matched[None])[0]
    length = np.linalg.norm(there, axis=1)
    cosine = there @ back / np.maximum(length * np.linalg.norm(back), 1e-9)
    return [int(n) for n in np.argsort(length * (1 + SIDE_WEIGHT * cosine), kind="stable")]
