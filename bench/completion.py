"""The class filter with what landmarks say that keyframes should have seen, and without.

``python -m bench.completion [RECORDING...] [--room SEED]... [--keyframes N]... [--missed .3] [--json FILE]``, with
SEMDB_DETECTOR for recordings; rooms are rendered (96 frames, 320 pixels wide), with that share of the objects missed in
every frame. Printed is the share of queries for which the best keyframe (90 % of the greatest common view that any has)
is among the 15 % of the best class scores, but at least 4. Frames that are no keyframes are queries, those of which a
keyframe sees 0.3.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from semdb.class_score import Part, strength_query, strengths
from semdb.cli.options import load_settings
from semdb.ingestion.keyframes import farthest_views
from semdb.ingestion.view_overlap import ViewStack, view_grid
from semdb.landmarks.build import SeenKeyframe, find_landmarks
from semdb.landmarks.completion import completed
from semdb.landmarks.lift import SeenObject, lift_keyframe
from semdb.landmarks.sizes import sizes_of
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.detectors.recorded import RecordedDetector
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features import load_features
from semdb.recordings import open_recordings
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.settings import Settings
from semdb.types import Camera, Description, Float32Array, FloatArray, InstanceMasks

BEST, SHARE, FEWEST, SEEN = 0.9, 0.15, 4, 0.3
Shown = Mapping[str, tuple[int, int]]


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A frame and what a detector saw in it, weakly too."""

    depth: Float32Array
    camera: Camera
    pose: FloatArray
    found: Description

    @property
    def objects(self) -> list[tuple[str, float, float]]:
        """Class, score and height of each object."""
        return [
            (s.category, s.score, s.height) for s in (d.sighting(self.camera.height) for d in self.found.detections)
        ]


@dataclass(frozen=True, slots=True)
class Row:
    """Shares of queries whose best keyframe is found."""

    place: str
    keyframes: int
    queries: int
    seen: float
    completed: float


def of_recording(path: Path) -> list[Seen]:
    """The frames of a recording with depth and pose."""
    settings = load_settings()
    describer, found = describer_from_specs(str(settings.detector), "gist", "orb", settings), []
    for recording in open_recordings(path):
        for entry in recording.entries:
            frame = recording.read(entry)
            if entry.world_from_camera is not None and frame.depth is not None:
                made = describer.describe(frame.image, frame.depth, frame.camera, frame.instances)
                found.append(Seen(frame.depth, frame.camera, entry.world_from_camera, made))
    return found


def of_room(seed: int, missed: float) -> list[Seen]:
    """Two laps of a rendered room."""
    size = {"frames": 96, "lap_frames": 48, "width": 320, "height": 240}
    sequence = SyntheticSequence(SyntheticOptions(room_seed=seed, seed=seed, noise=True, missed=missed, **size))
    describer = Describer(RecordedDetector(), GistEncoder(), load_features("orb", Settings()))
    found = []
    for index in range(size["frames"]):
        frame = sequence.render(index)
        depth = frame.known_depth
        masks = InstanceMasks(frame.labels, sequence.classes)
        made = describer.describe(frame.rgb, depth, sequence.camera, masks)
        found.append(Seen(depth, sequence.camera, frame.world_from_camera, made))
    return found


def compare(place: str, frames: Sequence[Seen], count: int) -> Row:
    """One map of `count` keyframes."""
    poses = [frame.pose for frame in frames]
    stack = ViewStack([view_grid(frame.camera, frame.depth) for frame in frames], poses)
    chosen = sorted(farthest_views(stack.overlap_with, np.stack(poses), count=count).tolist())
    keyframes = [frames[k] for k in chosen]
    names = sorted({one.category for frame in keyframes for one in frame.found.detections})
    seen = []
    for frame in keyframes:
        things = [SeenObject(names.index(one.category), one.score, one.mask) for one in frame.found.detections]
        lifted = lift_keyframe(frame.camera, frame.pose, frame.depth, things)
        category = np.array([thing.category for thing in things], np.int64)
        seen.append(SeenKeyframe(lifted, category, np.array([thing.score for thing in things], np.float64), 0))
    found = find_landmarks(seen, len(names), sizes=sizes_of(names)).landmarks
    more = completed([frame.objects for frame in keyframes], found, names)
    before = [strengths(frame.found.evidence) for frame in keyframes]
    after = [with_more(own, added) for own, added in zip(before, more, strict=True)]
    frequency: dict[str, int] = {}
    for frame in keyframes:
        for name in {one.category for one in frame.found.detections}:
            frequency[name] = frequency.get(name, 0) + 1
    hits, queries = [0, 0], 0
    for number in sorted(set(range(len(frames))) - set(chosen)):
        common = stack.overlap_with(number)[chosen]
        if common.max() < SEEN:
            continue
        queries += 1
        for k, shown in enumerate((before, after)):
            hits[k] += is_found(frames[number], shown, common >= BEST * common.max(), frequency)
    return Row(place, count, queries, hits[0] / max(queries, 1), hits[1] / max(queries, 1))


def with_more(own: Shown, added: Shown) -> dict[str, tuple[int, int]]:
    """The greater of both, class by class."""
    zero = (0, 0)
    pairs = {name: (own.get(name, zero), added.get(name, zero)) for name in {*own, *added}}
    return {name: (max(a[0], b[0]), max(a[1], b[1])) for name, (a, b) in pairs.items()}


def is_found(query: Seen, shown: Sequence[Shown], best: np.ndarray, frequency: Mapping[str, int]) -> bool:
    """Whether a keyframe of the `best` is among the first by class score."""
    asked = strength_query(strengths(query.found.evidence), len(shown), frequency)
    if not asked.terms:
        return False
    shared = np.zeros(len(shown), np.int64)
    for term in asked.terms:
        half = 0 if term.part is Part.UPPER else 1
        values = np.array([one.get(term.category, (0, 0))[half] for one in shown], np.int64)
        shared += np.minimum(term.full, term.per_object * values)
    scores = asked.points(shared, np.array([sum(map(sum, one.values())) for one in shown], np.int64))
    order = np.lexsort((np.arange(len(shown)), -scores))[: max(FEWEST, int(np.ceil(SHARE * len(shown))))]
    return bool((best[order] & (scores[order] > 0)).any())


def places(recordings: Sequence[Path], rooms: Sequence[int], missed: float) -> Iterator[tuple[str, list[Seen]]]:
    for path in recordings:
        yield path.name, of_recording(path)
    for seed in rooms:
        yield f"room {seed}", of_room(seed, missed)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--room", type=int, action="append", default=[])
    parser.add_argument("--keyframes", type=int, action="append", default=[])
    parser.add_argument("--missed", type=float, default=0.3)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    for name, frames in places(given.recordings, given.room, given.missed):
        for count in given.keyframes or (12, 24, 48):
            rows.append(compare(name, frames, count))
            row = rows[-1]
            print(f"{name:32}{count:4} keyframes{row.queries:5} queries{row.seen:8.3f}{row.completed:8.3f}", flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")


if __name__ == "__main__":
    main()
