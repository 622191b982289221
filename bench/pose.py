"""The fine step against what one would write with OpenCV and SciPy, and against pycolmap: time and error, in one run.

``python -m bench.pose RECORDING... [--keyframes N] [--queries N] [--candidates N] [--whole] [--json FILE]``. Every
query is matched with the keyframes nearest in true pose, which stand for the coarse step's candidates; no network runs.
All start from the same SURF keypoints and 3D points:

- `semdb`: matching, LO-RANSAC, guided matching, equation (5) of the paper with turning images;
- `opencv`: `cv2.BFMatcher` both ways with the same ratio, `cv2.solvePnPRansac`, equation (5) by `scipy.optimize.
  least_squares` (sparse Jacobian, Cauchy loss);
- `opencv, pose only`: the same with the pose alone refined;
- `pycolmap`: `estimate_and_refine_absolute_pose` on semdb's first matches; its time is added to semdb's matching.

Times are medians on this machine, wall and CPU (of all threads); run it on an idle one. The ratios are what to compare.
`--whole` adds the whole query without its networks, by stage: these make the map and the descriptions, and are not
timed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.sparse import coo_array

from bench.pose_query import measure_query, show_query
from semdb.evaluation.baselines import nearest_in_pose
from semdb.evaluation.protocols import split_paper
from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp
from semdb.ingestion.keyframes import select_keyframes
from semdb.localization.bundle import pixel_sigma
from semdb.localization.pairs import join_pairs, world_points_of
from semdb.localization.pose import estimate_pose, match_views
from semdb.localization.pose_options import PoseOptions
from semdb.localization.views import ClassNumbers, KeyframeView, View, make_keyframe_view, make_view
from semdb.perception.features.surf_features import SurfFeatures
from semdb.perception.lifting import lift
from semdb.recordings import open_recordings
from semdb.recordings.base import Recording
from semdb.types import FloatArray, Frame, ImageArray, IntArray, Keypoints

OPTIONS = PoseOptions()
Clock = tuple[float, float]  # seconds, of the wall and of the CPU
Found = tuple[FloatArray | None, dict[str, float]]  # world_from_camera, milliseconds of "match", "pose" and "cpu"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--keyframes", type=int, default=25)
    parser.add_argument("--queries", type=int, default=40)
    parser.add_argument("--candidates", type=int, default=2)
    parser.add_argument("--whole", action="store_true", help="the whole query, without networks, as well")
    parser.add_argument("--coarse", choices=("sql", "index"), default="index")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    cv2.setNumThreads(2)
    results = []
    for recording in [found for path in arguments.recordings for found in open_recordings(path)]:
        results.append(measure(recording, arguments.keyframes, arguments.queries, arguments.candidates))
        show(results[-1])
        if arguments.whole:
            results[-1]["whole"] = measure_query(recording, arguments.keyframes, arguments.queries, arguments.coarse)
            show_query(results[-1]["whole"])
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def measure(recording: Recording, keyframes: int, queries: int, candidates: int) -> dict[str, Any]:
    features, numbers = SurfFeatures(), ClassNumbers()
    chosen = select_keyframes(recording, count=keyframes)
    views = []
    for entry in chosen:
        frame = recording.read(entry)
        assert frame.world_from_camera is not None
        points, pose = describe(frame, features, with_depth=True), frame.world_from_camera
        views.append(make_keyframe_view(entry.index, frame.camera, pose, points, (), numbers, grey_of(frame)))
    poses = np.stack([view.world_from_camera for view in views])
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in METHODS}
    for count, entry in enumerate(split_paper(recording.entries, chosen, queries)):
        frame = recording.read(entry)
        assert frame.world_from_camera is not None
        found = describe(frame, features, with_depth=False)
        query = make_view(frame.camera, found, (), numbers, grey=grey_of(frame))
        near = [views[i] for i in nearest_in_pose(frame.world_from_camera, poses, candidates)]
        for name, method in METHODS.items():
            if count == 0:
                method(query, near)  # kernels are compiled, or loaded
            pose, spent = method(query, near)
            error = (np.inf, np.inf) if pose is None else pose_error(pose, frame.world_from_camera)
            rows[name].append((spent["match"], spent["pose"], spent["cpu"], *error))
    return {
        "recording": recording.name,
        "keyframes": len(views),
        "candidates": candidates,
        "queries": len(next(iter(rows.values()))),
        "methods": {name: summary(np.array(found)) for name, found in rows.items()},
    }


def describe(frame: Frame, features: SurfFeatures, *, with_depth: bool) -> Keypoints:
    found = features.extract(grey_of(frame))
    depth = frame.depth if with_depth else None
    return Keypoints(found, np.full(len(found), -1, np.int32), lift(frame.camera, depth, found.xy))


def grey_of(frame: Frame) -> ImageArray:
    return np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), np.uint8)


def by_semdb(query: View, keyframes: Sequence[KeyframeView]) -> Found:
    started = clock()
    matches = match_views(query, keyframes, OPTIONS)
    matched = clock()
    estimate = estimate_pose(query, keyframes, matches, OPTIONS)
    return None if estimate is None else estimate.world_from_camera, spent_since(started, matched)


def by_pycolmap(query: View, keyframes: Sequence[KeyframeView]) -> Found:
    started = clock()
    matches = match_views(query, keyframes, OPTIONS)
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    matched = clock()
    width, height = query.camera.width, query.camera.height
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=width, height=height, params=[query.focal, 0, 0])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = OPTIONS.max_reprojection_px
    found = pycolmap.estimate_and_refine_absolute_pose(query.xy[pairs.query] * query.focal, points, camera, options)
    spent = spent_since(started, matched)
    if found is None:
        return None, spent
    camera_from_world = np.eye(4)
    camera_from_world[:3] = found["cam_from_world"].matrix()
    return invert_pose(camera_from_world), spent


def by_opencv(query: View, keyframes: Sequence[KeyframeView], *, with_points: bool) -> Found:
    started = clock()
    found = [brute_force(query.descriptors, keyframe.view.descriptors) for keyframe in keyframes]
    rows = np.concatenate([pair[0] for pair in found])
    slots = np.repeat(np.arange(len(found)), [len(pair[0]) for pair in found])
    columns = np.concatenate([pair[1] for pair in found])
    points = np.concatenate([k.world_points[pair[1]] for k, pair in zip(keyframes, found, strict=True)])
    matched = clock()
    if len(rows) < 6:
        return None, spent_since(started, matched)
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points, query.xy[rows], np.eye(3), None, iterationsCount=1000, confidence=0.999,
        reprojectionError=OPTIONS.max_reprojection_px / query.focal,
    )  # fmt: skip
    if not ok or inliers is None or len(inliers) < 6:
        return None, spent_since(started, matched)
    start = np.concatenate([rotation.ravel(), translation.ravel()])
    keep = inliers.ravel()
    refine = refine_all if with_points else refine_pose
    best = refine(query, keyframes, rows[keep], slots[keep], columns[keep], points[keep], start)
    pose = invert_pose(pose_from(so3_exp(best[:3]), best[3:6]))
    return pose, spent_since(started, matched)


def brute_force(query: Any, keyframe: Any) -> tuple[IntArray, IntArray]:
    """Mutual nearest neighbours that pass the ratio test."""
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forward = matcher.knnMatch(query, keyframe, k=2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(keyframe, query)}
    pairs = [
        (one.queryIdx, one.trainIdx)
        for one, two in forward
        if one.distance < OPTIONS.matching.ratio * two.distance and back[one.trainIdx] == one.queryIdx
    ]
    i, j = np.array(pairs, np.int32).reshape(-1, 2).T
    return i, j


def refine_pose(
    query: View,
    _keyframes: Sequence[KeyframeView],
    rows: IntArray,
    _slots: IntArray,
    _columns: IntArray,
    points: FloatArray,
    start: FloatArray,
) -> FloatArray:
    def residuals(x: FloatArray) -> FloatArray:
        local = points @ so3_exp(x[:3]).T + x[3:6]
        return np.asarray((local[:, :2] / local[:, 2:] - query.xy[rows]).ravel() * query.focal)

    return np.asarray(least_squares(residuals, start, loss="cauchy", f_scale=2.0).x)


def refine_all(
    query: View,
    keyframes: Sequence[KeyframeView],
    rows: IntArray,
    slots: IntArray,
    columns: IntArray,
    points: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Equation (5): pose and points; pixels in the query and the keyframe, and the depth measured there."""
    n = len(rows)
    poses = np.stack([keyframe.camera_from_world for keyframe in keyframes])[slots]
    seen = np.empty((n, 4))
    for slot, keyframe in enumerate(keyframes):
        own, view = slots == slot, keyframe.view
        sigma = pixel_sigma(view.size[columns[own]], view.focal)
        seen[own] = np.column_stack([view.xy[columns[own]], sigma, view.points[columns[own], 2]])
    sigma = pixel_sigma(query.size[rows], query.focal)[:, None]
    depth_sigma = 0.0012 + 0.0019 * (seen[:, 3:] - 0.4) ** 2

    def residuals(x: FloatArray) -> FloatArray:
        world = x[6:].reshape(n, 3)
        local = world @ so3_exp(x[:3]).T + x[3:6]
        there = np.einsum("nij,nj->ni", poses[:, :3, :3], world) + poses[:, :3, 3]
        blocks = (
            (local[:, :2] / local[:, 2:] - query.xy[rows]) / sigma,
            (there[:, :2] / there[:, 2:] - seen[:, :2]) / seen[:, 2:3],
            (there[:, 2:] - seen[:, 3:]) / depth_sigma,
        )
        return np.concatenate(blocks, axis=1).ravel()

    each = np.arange(5 * n)
    by_pose = np.flatnonzero(each % 5 < 2)
    i = np.concatenate([np.repeat(by_pose, 6), np.repeat(each, 3)])
    j = np.concatenate([np.tile(np.arange(6), len(by_pose)), (6 + 3 * (each // 5)[:, None] + np.arange(3)).ravel()])
    sparsity = coo_array((np.ones(len(i)), (i, j)), shape=(5 * n, 6 + 3 * n))
    first = np.concatenate([start, points.ravel()])
    found = least_squares(
        residuals, first, jac_sparsity=sparsity, loss="cauchy", f_scale=2.0, x_scale="jac", max_nfev=15
    )
    return np.asarray(found.x)


METHODS: dict[str, Callable[[View, Sequence[KeyframeView]], Found]] = {
    "semdb": by_semdb,
    "opencv": lambda query, keyframes: by_opencv(query, keyframes, with_points=True),
    "opencv, pose only": lambda query, keyframes: by_opencv(query, keyframes, with_points=False),
    "pycolmap": by_pycolmap,
}


def clock() -> Clock:
    return time.perf_counter(), time.process_time()


def spent_since(started: Clock, matched: Clock) -> dict[str, float]:
    now = clock()
    return {
        "match": 1000 * (matched[0] - started[0]),
        "pose": 1000 * (now[0] - matched[0]),
        "cpu": 1000 * (now[1] - started[1]),
    }


def summary(rows: FloatArray) -> dict[str, float]:
    whole = rows[:, 0] + rows[:, 1]
    error = rows[:, 3:]
    found = error[np.isfinite(error[:, 0])]
    return {
        "match_ms_p50": float(np.median(rows[:, 0])),
        "pose_ms_p50": float(np.median(rows[:, 1])),
        "total_ms_p50": float(np.median(whole)),
        "total_ms_p95": float(np.percentile(whole, 95)),
        "cpu_ms_p50": float(np.median(rows[:, 2])),
        "median_m": float(np.median(found[:, 0])),
        "median_deg": float(np.median(found[:, 1])),
        "within_5cm_5deg": float(((error[:, 0] <= 0.05) & (error[:, 1] <= 5)).mean()),
    }


def show(result: dict[str, Any]) -> None:
    print(
        f"{result['recording']}: {result['queries']} queries, {result['candidates']} of {result['keyframes']} "
        "keyframes, milliseconds p50"
    )
    print(
        "  method              match   pose   wall   p95    CPU | times semdb: wall   CPU | median m   deg   5 cm 5 deg"
    )
    ours = result["methods"]["semdb"]
    for name, row in result["methods"].items():
        print(
            f"  {name:18s} {row['match_ms_p50']:6.1f} {row['pose_ms_p50']:6.1f} {row['total_ms_p50']:6.1f} "
            f"{row['total_ms_p95']:6.1f} {row['cpu_ms_p50']:6.1f} |          "
            f"{row['total_ms_p50'] / ours['total_ms_p50']:8.1f} {row['cpu_ms_p50'] / ours['cpu_ms_p50']:5.1f} |   "
            f"{row['median_m']:.4f}  {row['median_deg']:.2f}    {100 * row['within_5cm_5deg']:5.1f} %"
        )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
