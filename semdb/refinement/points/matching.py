"""Matching two keyframes whose poses are known: what the other one sees lies on a known line, or at a known place.

Poses of recordings are off by centimetres. So the whole images are matched first, and what lies near its projection
lays the two keyframes on each other. At that pose a keypoint with depth is looked for around its projection, one
without along its epipolar line; nearest neighbours must be mutual and stand out (ratio test), objects of different
classes more.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.byte_descriptors import from_bytes
from semdb.compiled import kernel
from semdb.geometry import invert_pose, transform_points
from semdb.localization.adjustment import in_front
from semdb.localization.matching import BACKGROUND, match_keypoints
from semdb.localization.views import View
from semdb.refinement.points.options import GateOptions
from semdb.types import Float32Array, FloatArray, IntArray

NEAREST_M, FARTHEST_M = 0.3, 20.0  # a point without depth is between
DEPTH_SHARE = 0.05  # how far a measured depth may be off, with what the poses are off by


def comparable(descriptors: npt.NDArray[np.generic]) -> Float32Array:
    """Unit vectors ``[n, d]`` whose squared distances order as those of `descriptors`: packed bits become signs."""
    if descriptors.dtype == np.int8:
        return np.ascontiguousarray(from_bytes(np.asarray(descriptors, np.int8)))
    if descriptors.dtype != np.uint8:
        return np.ascontiguousarray(descriptors, np.float32)
    bits = np.unpackbits(np.asarray(descriptors, np.uint8), axis=1).astype(np.float32)
    return (2 * bits - 1) / np.float32(np.sqrt(bits.shape[1]))


def match_whole_images(
    first: View, second: View, second_from_first: FloatArray, options: GateOptions
) -> tuple[IntArray, IntArray]:
    """Keypoints that stand out in the whole of both images and lie within `first_px` of where a depth puts them.

    Without a depth it is their distance from the epipolar line that counts.
    """
    found = match_keypoints(
        first.descriptors, second.descriptors, first.classes, second.classes,
        query_signs=first.signs, keyframe_signs=second.signs,
    )  # fmt: skip
    one, two = found.query, found.keyframe
    forth = _miss(first.points[one], second_from_first, second.xy[two])
    back = _miss(second.points[two], invert_pose(second_from_first), first.xy[one])
    miss = np.fmin(forth, back)
    unknown = np.isnan(miss)
    miss[unknown] = _off_line(first.xy[one[unknown]], second.xy[two[unknown]], second_from_first)
    keep = miss < options.first_px / second.focal
    return one[keep], two[keep]


def _off_line(one: FloatArray, two: FloatArray, pose: FloatArray) -> FloatArray:
    """Distance ``[n]`` of `two` from the epipolar lines of `one`, normalised."""
    line = np.cross(pose[:3, 3], np.column_stack([one, np.ones(len(one))]) @ pose[:3, :3].T)
    length = np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-9)
    return np.asarray(np.abs(line[:, 0] * two[:, 0] + line[:, 1] * two[:, 1] + line[:, 2]) / length)


def _miss(points: Float32Array, pose: FloatArray, seen: FloatArray) -> FloatArray:
    """Distance ``[n]`` of where `points` are seen from their projections, normalised; NaN without depth."""
    offset = in_front(transform_points(pose, points)) - seen
    return np.asarray(np.hypot(offset[:, 0], offset[:, 1]))


def match_known_poses(
    first: View, second: View, second_from_first: FloatArray, gate: float, options: GateOptions
) -> tuple[IntArray, IntArray, Float32Array]:
    """Keypoints of two views that are the same point: indexes ``[m]`` in each, squared descriptor distances ``[m]``.

    `second_from_first` ``[4, 4]`` moves points from one camera's frame to the other's; `gate` is in normalised
    coordinates of the second.
    """
    order = np.argsort(second.xy[:, 0], kind="stable")
    # squared distances of bits as signs are in proportion to Hamming distances, whose ratio is not squared
    power = 1 if first.descriptors.dtype == np.uint8 else 2
    ratios = options.ratio**power, options.contradiction_ratio**power
    best, nearest = np.full(len(first), np.inf, np.float32), np.full(len(first), -1, np.int32)
    next_best, best_back = np.full(len(first), np.inf, np.float32), np.full(len(second), np.inf, np.float32)
    _scan(
        first.xy, first.points[:, 2].astype(np.float64), first.signs, comparable(first.descriptors),
        second.xy, second.points[:, 2].astype(np.float64), second.signs, comparable(second.descriptors), order,
        np.ascontiguousarray(second_from_first[:3, :3]), np.ascontiguousarray(second_from_first[:3, 3]),
        gate, nearest, best, next_best, best_back,
    )  # fmt: skip
    i = np.flatnonzero(nearest >= 0)
    j = nearest[i]
    one, two = first.classes[i], second.classes[j]
    contradicts = (one != two) & (one != BACKGROUND) & (two != BACKGROUND)
    ratio = np.where(contradicts, ratios[1], ratios[0])
    keep = (best[i] <= best_back[j]) & (best[i] < options.ceiling) & (best[i] < ratio * next_best[i])
    return i[keep].astype(np.int32), j[keep], best[i][keep]


@kernel
def _project(ray: Any, depth: float, rotation: Any, translation: Any, out: Any) -> float:
    """Where the other camera sees the point `depth` along `ray` (x, y, 1): normalised in `out`; returns its depth."""
    x, y, z = ray[0] * depth, ray[1] * depth, depth
    px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
    py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
    pz: float = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    if pz > 1e-3:
        out[0], out[1] = px / pz, py / pz
    return pz


@kernel
def _off_segment(x: float, y: float, a: Any, b: Any) -> float:
    """Squared distance of (x, y) from the segment between `a` and `b`."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = dx * dx + dy * dy
    share = 0.0
    if length > 0:
        share = min(1.0, max(0.0, ((x - a[0]) * dx + (y - a[1]) * dy) / length))
    ex, ey = x - a[0] - share * dx, y - a[1] - share * dy
    squared: float = ex * ex + ey * ey
    return squared


@kernel
def _ends(xy: Any, depth: float, rotation: Any, translation: Any, near: Any, far: Any) -> bool:
    """The segment on which the other camera may see a keypoint; False where it is behind it."""
    low, high = depth * (1 - DEPTH_SHARE), depth * (1 + DEPTH_SHARE)
    if np.isnan(depth):
        low, high = NEAREST_M, FARTHEST_M
    for _ in range(8):  # the near end may be behind the other camera
        if _project(xy, low, rotation, translation, near) > 0.05:
            break
        low = min(1.5 * low, high)
    else:
        return False
    return _project(xy, high, rotation, translation, far) > 0.05


@kernel
def _scan(
    xy: Any, depth: Any, signs: Any, descriptors: Any,
    to_xy: Any, to_depth: Any, to_signs: Any, to_descriptors: Any, order: Any,
    rotation: Any, translation: Any, gate: float, nearest: Any, best: Any, next_best: Any, best_back: Any,
) -> None:  # fmt: skip
    """Nearest and second nearest of each keypoint among those of the other view that the geometry allows."""
    back = np.ascontiguousarray(rotation.T)
    origin = np.empty(3)
    for i in range(3):
        origin[i] = -(back[i, 0] * translation[0] + back[i, 1] * translation[1] + back[i, 2] * translation[2])
    count = len(to_xy)
    other_near, other_far = np.empty((count, 2)), np.empty((count, 2))
    usable = np.zeros(count, np.bool_)
    for j in range(count):
        usable[j] = _ends(to_xy[j], to_depth[j], back, origin, other_near[j], other_far[j])
    near, far = np.empty(2), np.empty(2)
    for i in range(len(xy)):
        if not _ends(xy[i], depth[i], rotation, translation, near, far):
            continue
        low, high = 0, count
        least, most = min(near[0], far[0]) - gate, max(near[0], far[0]) + gate
        while low < high:
            middle = (low + high) // 2
            if to_xy[order[middle], 0] < least:
                low = middle + 1
            else:
                high = middle
        while low < count and to_xy[order[low], 0] <= most:
            j = order[low]
            low += 1
            if signs[i] != to_signs[j] or not usable[j]:
                continue
            if _off_segment(to_xy[j, 0], to_xy[j, 1], near, far) > gate * gate:
                continue
            if _off_segment(xy[i, 0], xy[i, 1], other_near[j], other_far[j]) > gate * gate:
                continue
            product = np.float32(0)
            for d in range(descriptors.shape[1]):
                product += descriptors[i, d] * to_descriptors[j, d]
            value = max(np.float32(2) - np.float32(2) * product, np.float32(0))
            best_back[j] = min(best_back[j], value)
            if value < best[i]:
                next_best[i], best[i], nearest[i] = best[i], value, j
            elif value < next_best[i]:
                next_best[i] = value
