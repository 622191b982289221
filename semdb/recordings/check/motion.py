"""How well poses explain matches: keypoints of one frame, moved by the poses and seen in the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semdb.geometry import invert_pose
from semdb.recordings.check.pairs import MIN_MATCHES, Pair
from semdb.types import FloatArray

SAME_DIRECTION = 0.7  # cosine between two translations that count as of one direction
WORST_PX = 200.0  # errors beyond it count as so much: a point behind the camera has none at all


@dataclass(frozen=True, slots=True)
class Change:
    """What is changed of depth and intrinsics: factors on depth and on the focal length."""

    depth: float = 1.0
    focal: float = 1.0


AS_READ = Change()


def errors(pairs: Sequence[Pair], poses: FloatArray, change: Change = AS_READ) -> FloatArray:
    """Median distance ``[pairs]`` in pixels between matches and where poses and depth say that they should be.

    `poses` ``[n, 4, 4]`` are ``world_from_camera`` of all frames. NaN where a pair has too little depth.
    """
    return np.array([_error(pair, poses[pair.first], poses[pair.second], change) for pair in pairs])


def _error(pair: Pair, first: FloatArray, second: FloatArray, change: Change) -> float:
    forward = invert_pose(second) @ first
    n = len(pair.xy_first)
    there, here, depth = pair.both_ways()
    there, here, depth = there / change.focal, here / change.focal, depth * change.depth
    known = np.isfinite(depth)
    if known.sum() < MIN_MATCHES:
        return float("nan")
    points = np.column_stack([there * depth[:, None], depth])
    backward = invert_pose(forward)
    moved = np.concatenate(
        [points[:n] @ forward[:3, :3].T + forward[:3, 3], points[n:] @ backward[:3, :3].T + backward[:3, 3]]
    )[known]
    with np.errstate(divide="ignore", invalid="ignore"):
        off = (moved[:, :2] / moved[:, 2:] - here[known]) * (pair.focal * change.focal)
        length = np.hypot(off[:, 0], off[:, 1])
    length = np.where((moved[:, 2] > 0) & np.isfinite(length), np.minimum(length, WORST_PX), WORST_PX)
    return float(np.median(length))


def free_motion(pair: Pair) -> tuple[FloatArray, float] | None:
    """second_from_first ``[4, 4]`` as the matches and the depth of the first say alone, and its median error in pixels.

    Its translation is in the units of depth, right or wrong. None where there is too little depth.
    """
    known = np.isfinite(pair.depth_first)
    if known.sum() < MIN_MATCHES:
        return None
    xy, depth = pair.xy_first[known], pair.depth_first[known]
    points = np.column_stack([xy * depth[:, None], depth])
    seen = pair.xy_second[known]
    unit, off = np.eye(3), 4.0 / pair.focal
    try:
        done, turn, shift, inliers = cv2.solvePnPRansac(
            points, seen, unit, None, reprojectionError=off, iterationsCount=300, flags=cv2.SOLVEPNP_EPNP
        )
        if not done or inliers is None or len(inliers) < MIN_MATCHES // 2:
            return None
        chosen = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(points[chosen], seen[chosen], unit, None, turn, shift)
    except cv2.error:  # degenerate points
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    moved = points @ pose[:3, :3].T + pose[:3, 3]
    error = (moved[:, :2] / moved[:, 2:] - seen) * pair.focal
    return pose, float(np.median(np.hypot(error[:, 0], error[:, 1])))


def translation_ratios(pairs: Sequence[Pair], poses: FloatArray) -> FloatArray:
    """How much longer the images and depth say that the camera moved than the poses do, ``[pairs]``.

    NaN where there is no motion to speak of, or where the two disagree on its direction.
    """
    found = np.full(len(pairs), np.nan)
    for number, pair in enumerate(pairs):
        free = free_motion(pair)
        told = (invert_pose(poses[pair.second]) @ poses[pair.first])[:3, 3]
        length = float(np.linalg.norm(told))
        if free is None or length == 0:
            continue
        seen = free[0][:3, 3]
        if seen @ told > SAME_DIRECTION * length * np.linalg.norm(seen):
            found[number] = np.linalg.norm(seen) / length
    return found
