"""What cleaning masks and merging duplicates does to object matches and retrieval, on recordings.

``python -m bench.detections RECORDING... [--detector SPEC] [--keyframes N] [--localize] [--json FILE]``

The same outputs of a detector raw and by `MaskRules`. Every frame that is no keyframe is a query; pixels and objects of
its two nearest keyframes, seen in the query by depth and true poses, are what is counted. With ``--localize``
``semdb evaluate`` runs with both, methods ``paper`` and ``semdb``. Nothing here is a time.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from semdb.class_score import class_query
from semdb.cli.options import load_settings
from semdb.cli.output import print_table
from semdb.cli.progress import Progress
from semdb.evaluation.runner import EvaluateOptions, evaluate
from semdb.geometry import back_project, invert_pose, pose_distances, project, transform_points
from semdb.ingestion.keyframes import select_keyframes
from semdb.perception import describe
from semdb.perception.detections import DetectionRules
from semdb.perception.detectors import load_detector
from semdb.perception.objects import assign_to_objects
from semdb.recordings import Recording, open_recordings
from semdb.settings import Settings
from semdb.types import BoolArray, Camera, Detection, Float32Array, FloatArray

RULES = {"raw": DetectionRules(masks=None), "rules": DetectionRules()}
STEP, VISIBLE, LEAST, SHARE = (
    8,
    0.05,
    8,
    0.5,
)  # pixels; share of the depth; grid points of an object; of them found again
Figures = dict[str, float]


@dataclass(frozen=True)
class Shot:
    """A frame without its pixels; `found` is what the detector gave, masks packed into bits."""

    camera: Camera
    pose: FloatArray
    depth: Float32Array
    found: tuple[tuple[Detection, np.ndarray], ...]

    def objects(self, rules: DetectionRules) -> tuple[Detection, ...]:
        shape = self.camera.height, self.camera.width
        return rules.apply([_with_mask(detection, bits, shape) for detection, bits in self.found])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--detector")
    parser.add_argument("--keyframes", type=int, default=25)
    parser.add_argument("--localize", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    given = {} if arguments.detector is None else {"detector": arguments.detector}
    settings = load_settings(**given)
    if not settings.detector.startswith(("onnx:", "torchvision:")):
        print("bench.detections needs a network: --detector onnx:FILE or torchvision:NAME; nothing is run")
        return
    results: dict[str, dict[str, Figures]] = {}
    for path in arguments.recordings:
        for recording in open_recordings(path):
            results[recording.name] = figures(recording, settings, arguments.keyframes)
        if arguments.localize:
            for name, rules in RULES.items():
                localize(path, settings, arguments.keyframes, name, rules, results)
    show(results)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def figures(recording: Recording, settings: Settings, keyframes: int) -> dict[str, Figures]:
    """What is counted, by name of the rules."""
    chosen = {entry.index for entry in select_keyframes(recording, count=keyframes)}
    shots: dict[int, Shot] = {}
    detector = load_detector(settings.detector, settings)
    with Progress(f"detecting {recording.name}") as progress:
        for done, entry in enumerate(recording.entries, start=1):
            frame = recording.read(entry)
            if frame.world_from_camera is not None and frame.depth is not None:
                found = [d for d in detector.detect(frame.image, None) if not d.weak]
                packed = tuple((d, np.packbits(d.mask)) for d in found)
                shots[entry.index] = Shot(frame.camera, frame.world_from_camera, frame.depth, packed)
            progress.update(done, len(recording.entries))
    kept = [shots[k] for k in sorted(chosen & shots.keys())]
    queries = [shots[k] for k in sorted(shots.keys() - chosen)]
    return {name: count(kept, queries, rules) for name, rules in RULES.items()}


def count(keyframes: Sequence[Shot], queries: Sequence[Shot], rules: DetectionRules) -> Figures:
    """The figures of one set of rules; shares in percent."""
    things = [shot.objects(rules) for shot in keyframes]
    counts = [Counter(d.category for d in found) for found in things]
    frequency = Counter(name for one in counts for name in one)
    poses = np.array([shot.pose for shot in keyframes])
    total: Counter[str] = Counter(objects=sum(map(len, things)))
    for query in queries:
        seen = query.objects(rules)
        total["objects"] += len(seen)
        near = np.argsort(pose_distances(query.pose, poses))[:2]
        asked = class_query(Counter(d.category for d in seen), len(keyframes), frequency)
        shared = sum(min(term.full, term.per_object * counts[near[0]][term.category]) for term in asked.terms)
        total["passed"] += asked.points(shared, 0) >= asked.least(0.5)
        for k in near:
            total.update(overlap(keyframes[k], things[k], query, seen))
    pixels = total["same"] + total["other"] + total["one"]
    return {
        "objects per image": total["objects"] / (len(keyframes) + len(queries)),
        "pixels on the same class in both, %": 100 * total["same"] / max(1, pixels),
        "pixels on another class, %": 100 * total["other"] / max(1, pixels),
        "objects found again, %": 100 * total["again"] / max(1, total["shown"]),
        "nearest keyframe passes the paper's class filter, %": 100 * total["passed"] / len(queries),
    }


def overlap(keyframe: Shot, things: Sequence[Detection], query: Shot, seen: Sequence[Detection]) -> dict[str, int]:
    """Grid pixels of a keyframe visible in a query by what lies there, and its objects shown and found again."""
    camera = keyframe.camera
    v, u = (grid.ravel() for grid in np.mgrid[STEP // 2 : camera.height : STEP, STEP // 2 : camera.width : STEP])
    z = keyframe.depth[v, u]
    known = np.isfinite(z) & (z > 0)
    xy = np.column_stack([u, v])[known].astype(np.float64)
    points = transform_points(invert_pose(query.pose) @ keyframe.pose, back_project(camera, xy, z[known]))
    with np.errstate(divide="ignore", invalid="ignore"):
        there = project(query.camera, points)
    visible = _visible(there, points[:, 2], query)
    left = assign_to_objects(xy[visible].astype(np.float32), [d.mask for d in things])
    right = assign_to_objects(there[visible].astype(np.float32), [d.mask for d in seen])
    names = np.array([d.category for d in things] + [""]), np.array([d.category for d in seen] + [""])
    one, other = names[0][left], names[1][right]
    both = (left >= 0) & (right >= 0)
    shown = again = 0
    for k in range(len(things)):
        mine = left == k
        if mine.sum() >= LEAST:
            shown += 1
            hits = Counter(right[mine & both & (one == other)].tolist()).most_common(1)
            again += bool(hits) and hits[0][1] >= SHARE * mine.sum()
    return {
        "same": int((both & (one == other)).sum()),
        "other": int((both & (one != other)).sum()),
        "one": int(((left >= 0) != (right >= 0)).sum()),
        "shown": shown,
        "again": again,
    }


def _visible(xy: FloatArray, z: FloatArray, query: Shot) -> BoolArray:
    """Whether points at pixels `xy` and depth `z` of a query are seen there: its own depth says so."""
    height, width = query.depth.shape
    position = np.rint(np.nan_to_num(xy, nan=-9, posinf=-9, neginf=-9)).astype(np.intp)
    inside = (z > 0.1) & (position >= 0).all(axis=1) & (position[:, 0] < width) & (position[:, 1] < height)
    measured = query.depth[np.clip(position[:, 1], 0, height - 1), np.clip(position[:, 0], 0, width - 1)]
    with np.errstate(invalid="ignore"):
        seen: BoolArray = inside & (np.abs(measured - z) < VISIBLE * z)
    return seen


def _with_mask(detection: Detection, bits: np.ndarray, shape: tuple[int, int]) -> Detection:
    mask = np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape).view(np.bool_)
    return Detection(detection.category, detection.score, detection.box, mask, detection.weak)


def localize(
    path: Path,
    settings: Settings,
    keyframes: int,
    name: str,
    rules: DetectionRules,
    results: dict[str, dict[str, Figures]],
) -> None:
    """Adds what `paper` and `semdb` localize of a recording when objects are made by `rules`."""
    options = EvaluateOptions(methods=("paper", "semdb"), keyframes=(keyframes,))
    with mock.patch.object(describe, "rules_of", return_value=rules):
        for result in evaluate([path], settings, options):
            to = results.setdefault(result.recording, {}).setdefault(name, {})
            to[f"{result.method}: localized"] = result.localized
            to[f"{result.method}: of them false"] = result.false_localizations
            to[f"{result.method}: answered by the filtered stage"] = result.stages.get("filtered", 0)
            to[f"{result.method}: queries"] = result.queries


def show(results: dict[str, dict[str, Figures]]) -> None:
    for recording, found in results.items():
        print(f"\n{recording}")
        print_table(("", *RULES), [(row, *(f"{found[name][row]:.1f}" for name in RULES)) for row in found["raw"]])
    sys.stdout.flush()


if __name__ == "__main__":
    main()
