"""Local features against each other on recordings: time, repeatability, matches and the poses they give.

    python -m bench.feature_pairs RECORDING... [--pairs N] [--json FILE] [--plot FILE]

One thread, all features in the same run; time is processor time, so that other work on the machine matters little.
Pairs of frames at several gaps; the first frame of a pair has depth and stands for a keyframe, the second is the query.
Figures depend on the machine; the ratios at the end hardly do.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import poselib

from semdb.geometry import back_project, invert_pose, pixels_to_normalized, pose_error, project, transform_points
from semdb.perception.features.sift import SiftFeatures
from semdb.perception.features.surf import SURF
from semdb.perception.features.surf_features import SurfFeatures
from semdb.recordings import Recording, open_recordings
from semdb.types import Camera

GAPS = (1, 2, 4, 8, 16)  # frames of the recording
REPEAT_PX = 3.0
RIGHT_PX = 5.0  # of a match; the recorded poses alone are off by up to 3 pixels
VISIBLE_M = 0.05  # a point is visible in the other frame if depth there agrees to this and 5 %
RATIO = 0.8
SUCCESS = (0.05, 5.0)  # metres, degrees
REFERENCE, OURS = "sift 1000", "surf 100"

Extract = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # grey -> xy [n, 2], descriptors [n, d]


@dataclass
class View:
    """What one feature found in one frame, with the 3D points (world, NaN where there is no depth)."""

    xy: np.ndarray
    descriptors: np.ndarray
    points: np.ndarray


@dataclass
class Shot:
    """One frame without its pixels."""

    depth: np.ndarray
    pose: np.ndarray
    views: dict[str, View] = field(default_factory=dict)


@dataclass
class Tally:
    """Sums over frames and pairs of one feature."""

    milliseconds: list[float] = field(default_factory=list)
    keypoints: list[int] = field(default_factory=list)
    pairs: dict[int, list[dict[str, float]]] = field(default_factory=lambda: defaultdict(list))


def features() -> dict[str, Extract]:
    """The contestants. SIFT as RootSIFT, at its precise positions; pycolmap's only where it is installed."""

    def from_opencv(feature: Any) -> Extract:
        def extract(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            keypoints, descriptors = feature.detectAndCompute(grey, None)
            return np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2), descriptors

        return extract

    def from_semdb(feature: Any) -> Extract:
        def extract(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            found = feature.extract(grey)
            return found.xy, found.descriptors

        return extract

    contestants = {
        OURS: from_semdb(SurfFeatures(100, max_keypoints=0)),
        "surf 400": from_semdb(SurfFeatures(400, max_keypoints=0)),
        "surf 100, best 1000": from_semdb(SurfFeatures(100, max_keypoints=1000)),
        "surf 100 as OpenCV": from_semdb(SURF(100)),
        REFERENCE: from_semdb(SiftFeatures(1000)),
        "orb 1000": from_opencv(cv2.ORB.create(1000)),
        "akaze": from_opencv(_akaze()),
    }
    try:
        import pycolmap
    except ImportError:
        print("pycolmap is not installed: its SIFT is left out", file=sys.stderr)
        return contestants
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = 1000
    options.num_threads = 1
    pycolmap.logging.minloglevel = 2
    with warnings.catch_warnings(action="ignore"):  # its successor takes no arrays
        sift = pycolmap.Sift(options, pycolmap.Device.cpu)

    def extract_pycolmap(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        keypoints, descriptors = sift.extract(grey)
        return keypoints[:, :2] - np.float32(0.5), descriptors  # COLMAP's first pixel is centred at 0.5

    return contestants | {"sift 1000 (pycolmap)": extract_pycolmap}


def _akaze() -> Any:
    return cv2.AKAZE_create() if hasattr(cv2, "AKAZE_create") else cv2.xfeatures2d.AKAZE_create()


def describe(
    recording: Recording, contestants: dict[str, Extract], tallies: dict[str, Tally], limit: int
) -> list[Shot]:
    """Every feature on every frame, one after the other so that all see the machine in the same state."""
    entries = [entry for entry in recording.entries if entry.world_from_camera is not None][: limit or None]
    shots = []
    for number, entry in enumerate(entries):
        frame = recording.read(entry)
        if frame.depth is None or frame.world_from_camera is None:
            continue
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        shot = Shot(frame.depth, frame.world_from_camera)
        for name, extract in contestants.items():
            if number == 0:
                extract(grey)  # compiles, warms caches
            start = time.process_time()
            xy, descriptors = extract(grey)
            tallies[name].milliseconds.append((time.process_time() - start) * 1e3)
            tallies[name].keypoints.append(len(xy))
            z = look_up(frame.depth, xy)
            points = transform_points(shot.pose, back_project(recording.camera, xy, z))
            shot.views[name] = View(xy, descriptors, points)
        shots.append(shot)
        if sys.stderr.isatty():
            print(f"\r{recording.name}: described {number + 1}/{len(entries)}", end="", file=sys.stderr)
    return shots


def look_up(depth: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Depth at the nearest pixel, NaN outside."""
    column, row = np.rint(np.clip(np.nan_to_num(xy, nan=-1.0), -1, 1e6)).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    z = np.full(len(xy), np.nan)
    z[inside] = depth[row[inside], column[inside]]
    return z


def compare(first: Shot, second: Shot, name: str, camera: Camera) -> dict[str, float]:
    """Repeatability, matches, precision, and the error of the pose of `second` from the points of `first`."""
    a, b = first.views[name], second.views[name]
    if len(a.xy) < 2 or len(b.xy) < 2:
        nothing = dict.fromkeys(("precision", "consistent"), float("nan"))
        return {"repeatability": 0.0, "matches": 0, **nothing, "metres": np.inf, "degrees": np.inf}
    in_second = transform_points(invert_pose(second.pose), a.points)
    there = project(camera, in_second)
    z = look_up(second.depth, there)
    visible = np.abs(z - in_second[:, 2]) < np.maximum(VISIBLE_M, 0.05 * in_second[:, 2])
    distances = np.full(len(a.xy), np.inf)
    for k in np.flatnonzero(visible):
        distances[k] = np.hypot(*(b.xy - there[k]).T).min()
    norm = cv2.NORM_HAMMING if a.descriptors.dtype == np.uint8 else cv2.NORM_L2
    two = cv2.BFMatcher(norm).knnMatch(b.descriptors, a.descriptors, k=2)
    pairs = np.array([(m.queryIdx, m.trainIdx) for m, n in two if m.distance < RATIO * n.distance]).reshape(-1, 2)
    pairs = pairs[np.isfinite(a.points[pairs[:, 1], 0])]
    right = np.hypot(*(b.xy[pairs[:, 0]] - there[pairs[:, 1]]).T) < RIGHT_PX
    metres, degrees, consistent = pose_of(b.xy[pairs[:, 0]], a.points[pairs[:, 1]], camera, second.pose)
    return {
        "repeatability": float((distances[visible] < REPEAT_PX).mean()) if visible.any() else float("nan"),
        "matches": len(pairs),
        "precision": float(right.mean()) if len(pairs) else float("nan"),
        "consistent": consistent,
        "metres": metres,
        "degrees": degrees,
    }


def pose_of(xy: np.ndarray, points: np.ndarray, camera: Camera, truth: np.ndarray) -> tuple[float, float, float]:
    """Error (metres, degrees) of the pose by LO-RANSAC PnP, infinite with fewer than 12 inliers; share of inliers."""
    undistorted = pixels_to_normalized(camera, xy) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    fine = np.isfinite(undistorted).all(axis=1)
    if fine.sum() < 12:
        return np.inf, np.inf, float("nan")
    model = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    ransac = {"max_reproj_error": 6.0, "min_iterations": 200, "max_iterations": 5000, "seed": 0}
    pose, info = poselib.estimate_absolute_pose(undistorted[fine], points[fine], model, ransac)
    if info["num_inliers"] < 12:
        return np.inf, np.inf, info["num_inliers"] / len(xy)
    camera_from_world = np.eye(4)
    camera_from_world[:3] = pose.Rt
    return *pose_error(invert_pose(camera_from_world), truth), info["num_inliers"] / len(xy)


def summarise(tally: Tally) -> dict[str, Any]:
    """Medians over frames, means over pairs per gap; errors are medians over the successful pairs."""
    milliseconds, keypoints = float(np.median(tally.milliseconds)), float(np.mean(tally.keypoints))
    gaps = {}
    for gap, results in sorted(tally.pairs.items()):
        metres = np.array([r["metres"] for r in results])
        degrees = np.array([r["degrees"] for r in results])
        good = (metres < SUCCESS[0]) & (degrees < SUCCESS[1])
        gaps[str(gap)] = {
            "pairs": len(results),
            "repeatability": float(np.nanmean([r["repeatability"] for r in results])),
            "matches": float(np.mean([r["matches"] for r in results])),
            "precision": float(np.nanmean([r["precision"] for r in results])),
            "consistent": float(np.nanmean([r["consistent"] for r in results])),
            "success": float(good.mean()),
            "median_metres": float(np.median(metres[good])) if good.any() else None,
            "median_degrees": float(np.median(degrees[good])) if good.any() else None,
        }
    return {
        "frames": len(tally.milliseconds),
        "ms_per_frame": milliseconds,
        "keypoints": keypoints,
        "us_per_keypoint": 1e3 * float(np.mean(tally.milliseconds)) / max(keypoints, 1),
        "gaps": gaps,
    }


def ratios(results: dict[str, Any]) -> dict[str, Any]:
    """Ours against the reference: times as fast per frame, and the difference of success at every gap."""
    ours, theirs = results[OURS], results[REFERENCE]
    return {
        "times_as_fast": {
            name: result["ms_per_frame"] / ours["ms_per_frame"] for name, result in results.items() if name != OURS
        },
        "success_difference": {
            gap: ours["gaps"][gap]["success"] - theirs["gaps"][gap]["success"] for gap in ours["gaps"]
        },
    }


def show(results: dict[str, Any], compared: dict[str, Any]) -> None:
    print(f"{'':22s} {'ms/frame':>9s} {'keypoints':>9s} {'us/kp':>6s}")
    for name, result in results.items():
        print(f"{name:22s} {result['ms_per_frame']:9.1f} {result['keypoints']:9.0f} {result['us_per_keypoint']:6.1f}")
    for quantity in (
        "repeatability",
        "matches",
        "precision",
        "consistent",
        "success",
        "median_metres",
        "median_degrees",
    ):
        print(f"\n{quantity + ' at gap':22s} " + " ".join(f"{gap:>8s}" for gap in results[OURS]["gaps"]))
        for name, result in results.items():
            cells = (
                f"{'-' if v[quantity] is None else format(v[quantity], '.3f'):>8s}" for v in result["gaps"].values()
            )
            print(f"{name:22s} " + " ".join(cells))
    print(f"\n{OURS} takes one part in so many of the time per frame of:")
    for name, ratio in compared["times_as_fast"].items():
        print(f"  {name:22s} {ratio:.2f}")
    print(f"{OURS} minus {REFERENCE}, success at gap:", compared["success_difference"])


def plot(results: dict[str, Any], path: Path) -> None:
    """Time per frame, and the share of right poses over the gap."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    colors = [f"C{k}" for k in range(len(results))]
    left.barh(list(results), [result["ms_per_frame"] for result in results.values()], color=colors)
    left.invert_yaxis()
    left.set_xlabel("ms per 640x480 frame, one thread")
    for (name, result), color in zip(results.items(), colors, strict=True):
        gaps = result["gaps"]
        right.plot(range(len(gaps)), [100 * v["success"] for v in gaps.values()], "o-", ms=3, label=name, color=color)
    right.set_xticks(range(len(gaps)), list(gaps))
    right.set_xlabel("gap between the frames of a pair")
    right.set_ylabel("poses within 5 cm and 5°, %")
    right.legend(fontsize=7)
    figure.savefig(path, dpi=110)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.feature_pairs", description=__doc__.split("\n", 1)[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--pairs", type=int, default=60, help="pairs per gap and recording")
    parser.add_argument("--frames", type=int, default=0, help="look at so many frames of each recording only")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    parser.add_argument("--plot", type=Path, help="write a figure to this file")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    contestants = features()
    tallies = {name: Tally() for name in contestants}
    for recording in [r for path in options.recordings for r in open_recordings(path)]:
        shots = describe(recording, contestants, tallies, options.frames)
        for gap in GAPS:
            starts = np.unique(np.linspace(0, len(shots) - 1 - gap, options.pairs).astype(int))
            for start in starts[starts >= 0].tolist():
                for name, tally in tallies.items():
                    tally.pairs[gap].append(compare(shots[start], shots[start + gap], name, recording.camera))
    results = {name: summarise(tally) for name, tally in tallies.items()}
    compared = ratios(results)
    show(results, compared)
    if options.json:
        options.json.write_text(json.dumps({"features": results, "ratios": compared}, indent=1) + "\n")
    if options.plot:
        plot(results, options.plot)


if __name__ == "__main__":
    main()
