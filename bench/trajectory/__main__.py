"""Trajectories from images and depth against the true ones, beside RGB-D odometry of OpenCV and Open3D, in one run.

``python -m bench.trajectory RECORDING... [--every N] [--refined DIR] [--json FILE]``. Absolute trajectory error after
rigid alignment (RMSE and median) and relative pose error over a second, of all frames with a pose; milliseconds per
frame, decoding included for semdb and left out for the peers; and processor time, of all threads, as many times as SURF
alone takes, which other work on the machine changes little. Compiled kernels are loaded before. Closures are checked
against the truth, and wrong ones are injected.

The truth is what the recording says; ``--refined DIR`` compares with poses that pycolmap refined (some minutes for each
recording; kept in DIR and found again there). Open3D is measured where it is installed (``semdb[bench]``).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.trajectory.closures import closure_figures
from bench.trajectory.peers import Step, open3d_step, opencv_step, track
from semdb.evaluation.refined_truth import refine_poses
from semdb.evaluation.rolling_shutter import rates_between
from semdb.evaluation.trajectory_errors import trajectory_errors
from semdb.perception.features.surf_features import SurfFeatures
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.recording import find_recorded, times_of
from semdb.types import FloatArray

SURF_FRAMES = 40
WARMING_FRAMES = 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=1, help="every N-th frame only")
    parser.add_argument("--refined", type=Path, metavar="DIR", help="compare with refined poses, which are kept there")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    results = []
    for recording in [found for path in given.recordings for found in open_recordings(path)]:
        results.append(measure(recording, given.every, given.refined, peers=not given.no_peers))
        show(results[-1])
    if given.json is not None:
        given.json.write_text(json.dumps(results, indent=2) + "\n")


def measure(recording: Recording, every: int, refined: Path | None, *, peers: bool) -> dict[str, Any]:
    """All methods on one recording."""
    warm_up(recording)
    started, began = time.perf_counter(), time.process_time()
    found = find_recorded(recording, every=every)
    cpu = (time.process_time() - began) / len(found.entries)
    spent = (time.perf_counter() - started) / len(found.entries)
    entries, (times_s, _) = found.entries, times_of(found.entries)
    true, known = truth_of(recording, entries, times_s, refined)
    surf = surf_seconds(recording, entries)
    trajectory = found.trajectory
    ours = [frame.world_from_camera if frame.piece == 0 else None for frame in trajectory.frames]
    before = [frame.before_closing if frame.piece == 0 else None for frame in trajectory.frames]
    rows = {
        "semdb": row(ours, true, known, times_s, (spent, cpu), surf),
        "semdb, odometry alone": row(before, true, known, times_s, None, surf),
    }
    steps: dict[str, Step | None] = {"opencv": opencv_step(), "open3d": open3d_step()} if peers else {}
    for name, step in steps.items():
        if step is not None:
            poses, *seconds = track(recording, entries, step)
            rows[name] = row(poses, true, known, times_s, seconds, surf)
    return {
        "recording": recording.name,
        "truth": "given" if refined is None else "refined",
        "frames": len(entries),
        "keyframes": len(trajectory.keyframes),
        "surf_ms": 1000 * surf,
        "methods": rows,
        "closures": asdict(closure_figures(trajectory, recording, entries, true, times_s)) if known.all() else None,
    }


def warm_up(recording: Recording) -> None:
    """Loads compiled kernels, or compiles them, which is no time of a frame: a few frames from all of the way."""
    find_recorded(recording, every=max(1, len(recording.entries) // WARMING_FRAMES))


def row(
    poses: Sequence[FloatArray | None],
    true: FloatArray,
    known: np.ndarray,
    times_s: FloatArray,
    seconds: Sequence[float] | None,
    surf: float,
) -> dict[str, Any]:
    """Figures of one method, which took `seconds` of wall and of processor time for a frame."""
    rows = [n for n, pose in enumerate(poses) if pose is not None and known[n]]
    time_spent = {} if seconds is None else {"ms": 1000 * seconds[0], "times_surf": seconds[1] / surf}
    if len(rows) < 3:
        return {"placed": len(rows), **time_spent}
    estimated = np.stack([pose for n in rows if (pose := poses[n]) is not None])
    errors = trajectory_errors(estimated, true[rows], times_s[rows])
    placed = sum(pose is not None for pose in poses)
    return {"placed": placed, **asdict(errors), **time_spent}


def truth_of(
    recording: Recording, entries: Sequence[FrameEntry], times_s: FloatArray, refined: Path | None
) -> tuple[FloatArray, np.ndarray]:
    """True poses ``[n, 4, 4]`` and which are known ``[n]``."""
    known = np.array([entry.world_from_camera is not None for entry in entries])
    if not known.any():
        raise SystemExit(f"{recording.path}: has no poses to compare with")
    given = np.stack([np.eye(4) if e.world_from_camera is None else e.world_from_camera for e in entries])
    if refined is None:
        return given, known
    refined.mkdir(parents=True, exist_ok=True)
    kept = refined / f"{recording.name}-{len(entries)}.npz"
    if not kept.exists():
        rows = np.flatnonzero(known)
        rates = rates_between(given[rows], times_s[rows])

        def frame(n: int) -> tuple[Any, Any]:
            entry = entries[rows[n]]
            return recording.read_image(entry), recording.read_depth(entry)

        cameras = [recording.camera_of(entries[n]) for n in rows]
        better = refine_poses(cameras, frame, given[rows], rates, name=recording.name)
        poses, good = given.copy(), known.copy()
        poses[rows], good[rows] = better.world_from_camera, better.refined
        np.savez(kept, poses=poses, known=good)
    with np.load(kept) as data:
        return data["poses"], data["known"]


def surf_seconds(recording: Recording, entries: Sequence[FrameEntry]) -> float:
    """Seconds of processor time that SURF alone takes for an image, as tracking uses it."""
    features = SurfFeatures(max_keypoints=TrajectoryOptions().max_keypoints)
    chosen = [entries[n] for n in np.unique(np.linspace(0, len(entries) - 1, SURF_FRAMES).astype(int))]
    greys = [np.asarray(cv2.cvtColor(recording.read_image(e), cv2.COLOR_RGB2GRAY), np.uint8) for e in chosen]
    features.extract(greys[0])
    began = time.process_time()
    for grey in greys:
        features.extract(grey)
    return (time.process_time() - began) / len(greys)


def show(result: dict[str, Any]) -> None:
    """The table of one recording."""
    print(f"{result['recording']}: {result['frames']} frames, {result['keyframes']} keyframes, truth {result['truth']}")
    print(f"{'method':24}{'placed':>8}{'RMSE m':>10}{'median m':>10}{'m/s':>10}{'deg/s':>8}{'ms':>8}{'x SURF':>8}")
    for name, figures in result["methods"].items():
        if "rmse_m" not in figures:
            print(f"{name:24}{figures['placed']:8d}")
            continue
        relative = [figures["relative_rmse_m"], figures["relative_rmse_deg"]]
        texts = ["-" if value is None else f"{value:.4f}" for value in relative]
        spent = f"{figures['ms']:8.1f}{figures['times_surf']:8.1f}" if "ms" in figures else ""
        print(
            f"{name:24}{figures['placed']:8d}{figures['rmse_m']:10.4f}{figures['median_m']:10.4f}"
            f"{texts[0]:>10}{texts[1][:6]:>8}{spent}"
        )
    closures = result["closures"]
    if closures is not None:
        print(
            f"closures: {closures['right']} of {closures['accepted']} right (worst {closures['worst_m']:.3f} m, "
            f"{closures['worst_deg']:.2f} deg); {closures['tied']} of {closures['tieable']} keyframes that could "
            f"be are tied; of {closures['injected']} wrong ones {closures['survived']} counted, "
            f"{closures['lost']} right lost"
        )


if __name__ == "__main__":
    main()
