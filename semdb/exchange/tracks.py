"""Points that several keyframes see, from their keypoints with 3D points: guided matches, joined, triangulated.

Keypoints of one keyframe are projected into those nearest to it; the keypoint there whose descriptor is most alike is
the same point of the scene, if both say so. What is joined is triangulated again from all its pixels, and pixels that
do not fit are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from semdb.geometry import invert_pose, pixels_to_normalized, pose_distances, project, transform_points
from semdb.types import Camera, Float32Array, FloatArray, Int64Array

NEIGHBOURS = 6  # keyframes that each is compared with
REACH_PX = 12.0  # of an image of 640
LIKE = 0.45  # distance of unit descriptors below which two may be one point
FIT_PX = 2.5  # of an image of 640: farther observations are left out
LEAST = 2  # observations of a point
ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Keypoints of a keyframe: pixels ``[n, 2]``, unit descriptors ``[n, d]``, world points ``[n, 3]`` (NaN none)."""

    camera: Camera
    world_from_camera: FloatArray
    xy: FloatArray
    descriptors: Float32Array
    points: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Points ``[t, 3]`` of the world; observation k is of point `point` ``[m]`` in view `view` at keypoint `keypoint`.

    `error` ``[t]`` is the mean distance in pixels from its observations. Observations are sorted by point.
    """

    points: FloatArray
    error: FloatArray
    point: Int64Array
    view: Int64Array
    keypoint: Int64Array


def find_tracks(
    poses: FloatArray, counts: Sequence[int], view_of: Callable[[int], View], tell: Callable[[int], None]
) -> Tracks:
    """Tracks over all views. `poses` ``[n, 4, 4]``, `counts` are keypoints of each view; `view_of` loads one."""
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    root = np.arange(starts[-1], dtype=np.int64)
    for i in range(len(poses)):
        nearest = np.argsort(pose_distances(poses[i], poses), kind="stable")
        first = view_of(i)
        for j in [int(other) for other in nearest if other > i][:NEIGHBOURS]:
            here, there = matches(first, view_of(j))
            for a, b in zip((starts[i] + here).tolist(), (starts[j] + there).tolist(), strict=True):
                _join(root, a, b)
        tell(i + 1)
    owner = np.searchsorted(starts, np.arange(starts[-1]), side="right") - 1
    roots = _flat(root)
    return _triangulate(roots, owner, starts, view_of)


def matches(first: View, second: View) -> tuple[Int64Array, Int64Array]:
    """Keypoints of two views that are the same point of the scene, by place and descriptor, each way."""
    forth, back = _guided(first, second), _guided(second, first)
    here = np.flatnonzero(forth >= 0)
    there = forth[here]
    agreed = (back[there] == here) | (back[there] < 0)
    return here[agreed].astype(np.int64), there[agreed]


def _guided(first: View, second: View) -> Int64Array:
    """For each keypoint of `first` that of `second` which is most alike near where it should be; -1 for none."""
    found = np.full(len(first.xy), -1, np.int64)
    known = np.flatnonzero(np.isfinite(first.points).all(axis=1))
    if not len(known) or not len(second.xy):
        return found
    moved = transform_points(invert_pose(second.world_from_camera), first.points[known])
    places = project(second.camera, moved)
    size = (second.camera.width, second.camera.height)
    inside = np.isfinite(places).all(axis=1) & (places >= -10).all(axis=1) & (places <= np.array(size) + 10).all(axis=1)
    known, places = known[inside], places[inside]
    if not len(known):
        return found
    reach = REACH_PX * second.camera.width / 640
    nearby: list[list[int]] = list(cKDTree(second.xy).query_ball_point(places, reach))  # type: ignore[arg-type]
    for i, near in zip(known.tolist(), nearby, strict=True):
        if near:
            distance: FloatArray = np.linalg.norm(second.descriptors[near] - first.descriptors[i], axis=1)
            best = int(np.argmin(distance))
            if float(distance[best]) < LIKE:
                found[i] = near[best]
    return found


def _find(root: Int64Array, node: int) -> int:
    while root[node] != node:
        root[node] = root[root[node]]
        node = int(root[node])
    return node


def _join(root: Int64Array, a: int, b: int) -> None:
    first, second = _find(root, a), _find(root, b)
    if first != second:
        root[max(first, second)] = min(first, second)


def _flat(root: Int64Array) -> Int64Array:
    while True:
        above = root[root]
        if np.array_equal(above, root):
            return root
        root = above


def _triangulate(roots: Int64Array, owner: Int64Array, starts: Int64Array, view_of: Callable[[int], View]) -> Tracks:
    """Points of all tracks in some rounds of Gauss and Newton, view by view; what does not fit is left out."""
    sizes = np.bincount(roots, minlength=len(roots))
    nodes = np.flatnonzero(sizes[roots] >= LEAST)
    # of two keypoints of one view in a track the first stays
    _, first = np.unique(np.column_stack([roots[nodes], owner[nodes]]), axis=0, return_index=True)
    nodes = nodes[np.sort(first)]
    names, point = np.unique(roots[nodes], return_inverse=True)
    view, keypoint = owner[nodes], nodes - starts[owner[nodes]]
    points = np.zeros((len(names), 3))
    weight = np.zeros(len(names))
    observed = np.empty((len(nodes), 2))
    by_view = [(int(v), np.flatnonzero(view == v)) for v in np.unique(view)]
    for v, rows in by_view:
        loaded = view_of(v)
        observed[rows] = loaded.xy[keypoint[rows]]
        own = loaded.points[keypoint[rows]]
        good = np.isfinite(own).all(axis=1)
        np.add.at(points, point[rows[good]], own[good])
        np.add.at(weight, point[rows[good]], 1.0)
    with np.errstate(invalid="ignore"):
        points /= weight[:, None]
    used = np.asarray(np.isfinite(points).all(axis=1))[point]
    error = np.full(len(nodes), np.inf)
    for round_ in range(ROUNDS):
        points = _step(points, point, used, observed, by_view, view_of)
        error = _errors(points, point, observed, by_view, view_of)
        limit = FIT_PX * (4.0 if round_ == 0 else 1.0)
        used = error < limit
    count = np.bincount(point[used], minlength=len(names))
    used &= (count >= LEAST)[point]
    kept, renumbered = np.unique(point[used], return_inverse=True)
    order = np.lexsort((view[used], renumbered))
    mean = np.bincount(renumbered, error[used]) / np.maximum(np.bincount(renumbered), 1)
    return Tracks(points[kept], mean, renumbered[order], view[used][order], keypoint[used][order])


def _step(points, point, used, observed, by_view, view_of) -> FloatArray:  # type: ignore[no-untyped-def]
    """One step of Gauss and Newton of all points at once, undistorted normalised coordinates as measurements."""
    normal = np.zeros((len(points), 3, 3)) + np.eye(3) * 1e-9
    right = np.zeros((len(points), 3))
    for v, seen in by_view:
        rows = seen[used[seen]]
        if not len(rows):
            continue
        loaded = view_of(v)
        pose = invert_pose(loaded.world_from_camera)
        p = transform_points(pose, points[point[rows]])
        xy = pixels_to_normalized(loaded.camera, observed[rows])
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y, w = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2], 1 / p[:, 2]
        zero = np.zeros_like(x)
        jacobian = np.stack([np.stack([w, zero, -x * w], 1), np.stack([zero, w, -y * w], 1)], 1) @ pose[:3, :3]
        residual = np.column_stack([x, y]) - xy
        good = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(residual).all(axis=1) & (p[:, 2] > 0.01)
        jacobian, residual, own = jacobian[good], residual[good], point[rows[good]]
        np.add.at(normal, own, jacobian.transpose(0, 2, 1) @ jacobian)
        np.add.at(right, own, (jacobian.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0])
    # a point stays near where depth says it is along rays that say little of it
    scale = np.trace(normal, axis1=1, axis2=2) / 3
    normal += np.eye(3) * (1e-3 * scale)[:, None, None]
    with np.errstate(invalid="ignore"):
        shift = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    return np.asarray(np.where(np.isfinite(shift), points - np.clip(shift, -0.3, 0.3), points))


def _errors(points, point, observed, by_view, view_of) -> FloatArray:  # type: ignore[no-untyped-def]
    """Distance ``[m]`` in pixels of an image of 640 of each observation from its point."""
    error = np.full(len(point), np.inf)
    for v, rows in by_view:
        loaded = view_of(v)
        places = project(loaded.camera, transform_points(invert_pose(loaded.world_from_camera), points[point[rows]]))
        found = np.hypot(*(places - observed[rows]).T) * 640 / loaded.camera.width
        error[rows] = np.where(np.isfinite(found), found, np.inf)
    return error
