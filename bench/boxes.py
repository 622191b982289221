"""What a mask brings against a box: objects, their places in 3D, landmarks, matches and poses.

    python -m bench.boxes [RECORDING...] [--rooms N] [--keyframes 16] [--queries 40] [--landmarks] [--json FILE]

Three ways to know an object: its mask, its box filled by depth where there is depth (queries have none), its whole
box. In rendered rooms the masks are exact and the boxes theirs, and landmarks are scored against the things that are
there; recordings have SEMDB_DETECTOR, a network with masks, and its boxes. Both are localized in by methods of `semdb
evaluate`: `semdb` (keypoints everywhere, classes as evidence), `semdb-objects` (keypoints on objects only) and `paper`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from bench.landmarks.rooms import (
    BOX,
    BY_DEPTH,
    MASK,
    SMALLEST,
    Mistakes,
    RenderedRoom,
    class_numbers,
    render_room,
    seen_keyframes,
    shaped,
    true_things,
)
from bench.landmarks.scores import HEADER, Score, score, summed
from semdb.cli.options import load_settings
from semdb.evaluation.runner import EvaluateOptions, evaluate
from semdb.landmarks.build import find_landmarks
from semdb.landmarks.sizes import sizes_of
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording

SHAPES = {MASK: "", BY_DEPTH: "boxes:", BOX: "whole-boxes:"}
METHODS = ("semdb", "semdb-objects", "paper")
FIRST = 400  # seeds of rooms that nothing was chosen on
LAP = 64  # frames of a rendered recording, once around


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--rooms", type=int, default=0)
    parser.add_argument("--keyframes", type=int, default=16)
    parser.add_argument("--queries", type=int, default=40)
    parser.add_argument("--landmarks", action="store_true", help="of the rooms only what needs no localization")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    results: dict[str, Any] = {}
    if given.rooms:
        results["rooms"] = in_rooms(given.rooms, given.keyframes)
    places = list(given.recordings)
    with tempfile.TemporaryDirectory() as folder:
        if given.rooms and not given.landmarks:
            options = SyntheticOptions(frames=LAP, lap_frames=LAP, room_seed=FIRST, seed=FIRST, noise=True)
            places.append(Path(folder) / f"room{FIRST}")
            write_synthetic_recording(places[-1], options)
        for path in places:
            results[path.name] = localized(path, given.keyframes, given.queries)
    if given.json is not None:
        given.json.write_text(json.dumps(results, indent=1) + "\n")


def in_rooms(count: int, keyframes: int) -> dict[str, dict[str, float]]:
    """Objects and landmarks of rendered rooms, by what is known of the masks."""
    scores: dict[str, list[Score]] = {shape: [] for shape in SHAPES}
    objects: dict[str, list[tuple[float, float, float]]] = {shape: [] for shape in SHAPES}
    for seed in range(FIRST, FIRST + count):
        room = render_room(seed, keyframes, 320)
        numbers, things = class_numbers([room]), true_things(room)
        for shape in SHAPES:
            seen, labels = seen_keyframes(room, numbers, Mistakes(depth_noise=True, shape=shape))
            found = find_landmarks(seen, len(numbers), sizes=sizes_of(list(numbers)))
            scores[shape].append(score(found.landmarks, labels, things, list(numbers)))
            objects[shape] += of_objects(room, shape)
    figures = {}
    print(f"{'':16}{HEADER}{'IoU':>8}{'other px':>10}{'off m':>8}")
    for shape in SHAPES:
        iou, other, off = (float(value) for value in (*np.mean(objects[shape], axis=0)[:2], _median(objects[shape])))
        total = summed(scores[shape])
        print(f"{shape:16}{total.line}{iou:8.3f}{other:10.3f}{off:8.3f}", flush=True)
        figures[shape] = {
            "objects": len(objects[shape]), "iou": iou, "other_pixels": other, "centre_off_m": off,
            "f1_25": total.f1(0), "f1_50": total.f1(1), "centre_m": float(np.median(total.centres)),
        }  # fmt: skip
    return figures


def _median(objects: list[tuple[float, float, float]]) -> float:
    return float(np.nanmedian([off for *_, off in objects]))


def of_objects(room: RenderedRoom, shape: str) -> list[tuple[float, float, float]]:
    """Of each object in each keyframe: IoU with its mask, share of pixels that are not it, metres that it is off.

    Off is the median point of the pixels, with a sensor's depth, from that of the exact mask and depth.
    """
    camera, found = room.camera, []
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    for frame in room.frames:
        for label in np.unique(frame.labels[frame.labels > 0]).tolist():
            mask = frame.labels == label
            if np.count_nonzero(mask) < SMALLEST:
                continue
            seen = shaped(mask, frame.noisy, shape)
            both = np.count_nonzero(mask & seen)
            known = seen & (frame.noisy > 0)
            off = float("nan")
            if known.any():
                own = np.median(rays[known] * frame.noisy[known][:, None], axis=0)
                off = float(np.linalg.norm(own - np.median(rays[mask] * frame.depth[mask][:, None], axis=0)))
            found.append((both / np.count_nonzero(mask | seen), 1 - both / np.count_nonzero(seen), off))
    return found


def localized(path: Path, keyframes: int, queries: int) -> dict[str, dict[str, Any]]:
    """What the methods make of a recording, by what is known of the masks."""
    settings, found = load_settings(), {}
    own = "recorded" if path.name.startswith("room") else settings.detector
    options = EvaluateOptions(methods=METHODS, keyframes=(keyframes,), max_queries=queries)
    for shape, prefix in SHAPES.items():
        results = evaluate([path], settings.model_copy(update={"detector": prefix + own}), options)
        for result in results:
            inliers = float(np.median([query.inliers for query in result.per_query]))
            row = {
                "localized": result.localized, "queries": result.queries, "false": result.false_localizations,
                "median_m": result.median_translation_m, "median_deg": result.median_rotation_deg,
                "inliers": inliers, "ranked": result.ranked_share, "within": result.recall["5cm_5deg"],
            }  # fmt: skip
            found[f"{shape}: {result.method}"] = row
            print(f"{path.name} {keyframes} keyframes, {shape}, {result.method}: {row}")
            sys.stdout.flush()
    return found


if __name__ == "__main__":
    main()
