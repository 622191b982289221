"""A map of many rooms: what the class filter leaves to be ranked, and how often the first keyframe is a wrong one.

``python -m bench.rooms [--rooms N] [--frames N] [--json FILE]``. Rooms with different furniture are rendered; most
frames of each are keyframes of one map, every fourth is a query. Detections are the exact masks, and the masks with
objects missing and misnamed, in keyframes and queries alike; the encoder is gist, the features are ORB. `semdb` is
compared with `cnn`, which ranks all keyframes by cosine, and with `counts`, the class score of the paper in the same
cascade; `refined` is semdb after `semdb refine`. Needs no model file.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semdb.database.records import KeyframeRecord, RecordingPlan
from semdb.database.store import Store, open_store
from semdb.geometry import pose_distances, pose_error
from semdb.localization.coarse import CoarseOptions, Scoring
from semdb.localization.images import make_localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.perception.describe import Describer
from semdb.perception.detectors.recorded import RecordedDetector
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features import load_features
from semdb.recordings.synthetic import SyntheticFrame, SyntheticOptions, SyntheticSequence
from semdb.recordings.synthetic.mistakes import make_mistakes, with_misnamed
from semdb.recordings.synthetic.writer import building
from semdb.refinement.run import refine_map
from semdb.refinement.steps import FOR_LOCALIZATION
from semdb.settings import Settings
from semdb.types import Camera, Description, FloatArray, InstanceMasks, Verdict

EVERY = 4  # frames from one query to the next
IN_REACH = 2.0  # of `pose_distances`: 0.6 m, or 30 degrees, or some of both
DETECTORS = {"exact": (0.0, 0.0), "30 % missed, 15 % misnamed": (0.3, 0.15), "50 % missed, 25 % misnamed": (0.5, 0.25)}
METHODS = {
    "cnn": CoarseOptions(use_classes=False),
    "counts": CoarseOptions(scoring=Scoring.COUNTS),
    "semdb": CoarseOptions(confusion=0.0),
    "refined": CoarseOptions(),
}


@dataclass(frozen=True, slots=True, eq=False)
class RenderedRoom:
    """The frames of one room, with exact masks."""

    camera: Camera
    classes: dict[int, str]
    frames: list[SyntheticFrame]


@dataclass(frozen=True, slots=True)
class Row:
    """What one method does with one detector; the numbers of ranked and matched keyframes are medians."""

    detector: str
    method: str
    keyframes: int
    queries: int
    ranked: float
    matched: float
    first_wrong: float  # share of queries whose first candidate shows another place though some keyframe is in reach
    other_room: float  # share whose first candidate is in another room
    localized: float
    false: int  # localized, but off by more than 0.25 m or 5 degrees


def render(options: SyntheticOptions, rooms: int) -> list[RenderedRoom]:
    """Rooms of a building with their frames."""
    found = []
    for room in building(options, rooms):
        sequence = SyntheticSequence(room)
        frames = [sequence.render(index) for index in range(room.frames)]
        found.append(RenderedRoom(sequence.camera, sequence.classes, frames))
    return found


def compare(
    rooms: Sequence[RenderedRoom], detector: str, methods: Sequence[str] = tuple(METHODS), features: str = "orb"
) -> list[Row]:
    """One row per method, all on the same map and queries."""
    described = _describe(rooms, *DETECTORS[detector], features)
    with tempfile.TemporaryDirectory() as folder, open_store(f"sqlite:///{folder}/rooms.sqlite3", create=True) as store:
        _fill(store, described)
        refine_map(store, store.find_map("building"), kinds=FOR_LOCALIZATION)
        return [_ask(store, described, detector, method) for method in methods]


Described = list[list[tuple[Description, FloatArray]]]  # by room and frame, with the true pose


def _describe(rooms: Sequence[RenderedRoom], missed: float, confused: float, features: str) -> Described:
    describer = Describer(RecordedDetector(), GistEncoder(), load_features(features, Settings()))
    found: Described = []
    for number, room in enumerate(rooms):
        classes, made = with_misnamed(room.classes), []
        for index, frame in enumerate(room.frames):
            labels = make_mistakes(frame.labels, room.classes, missed, confused, number, index)
            described = describer.describe(frame.rgb, frame.known_depth, room.camera, InstanceMasks(labels, classes))
            made.append((described, frame.world_from_camera))
        found.append(made)
    return found


def _is_query(index: int) -> bool:
    return index % EVERY == EVERY // 2


def _fill(store: Store, described: Described) -> None:
    map_id = store.ensure_map("building")
    picture = cv2.imencode(".png", np.zeros((2, 2, 3), np.uint8))[1].tobytes()  # nobody looks at it
    for number, room in enumerate(described):
        indexes = tuple(index for index in range(len(room)) if not _is_query(index))
        plan = RecordingPlan(f"room-{number:03d}", "synthetic", "rendered", len(room), "rendered", indexes)
        recording = store.plan_recording(map_id, plan, room[0][0].models).recording_id
        for index in indexes:
            description, pose = room[index]
            record = KeyframeRecord(index, None, description.camera, pose, picture, None, None, "", description)
            store.write_keyframe(recording, record)


def _ask(store: Store, described: Described, detector: str, method: str) -> Row:
    localizer = make_localizer(store, store.find_map("building"), "sql", LocalizerOptions(coarse=METHODS[method]))
    ids, poses = localizer.cache.poses()
    queries = [pair for room in described for index, pair in enumerate(room) if _is_query(index)]
    ranked, matched, first_wrong, other_room, localized, false = [], [], 0, 0, 0, 0
    for description, pose in queries:
        distance = dict(zip(ids, pose_distances(pose, poses), strict=True))
        first = localizer.retrieve(description, 1)[0].keyframe_id
        first_wrong += bool(distance[first] > max(IN_REACH, min(distance.values())))
        other_room += bool(np.linalg.norm(poses[ids.index(first)][:3, 3] - pose[:3, 3]) > 10)
        answer = localizer.localize(description)
        ranked.append(answer.ranked_share * len(ids))
        matched.append(answer.keyframes_matched)
        if answer.verdict is Verdict.LOCALIZED and answer.world_from_camera is not None:
            localized += 1
            metres, degrees = pose_error(answer.world_from_camera, pose)
            false += bool(metres > 0.25 or degrees > 5)
    count = len(queries)
    return Row(
        *(detector, method, len(ids), count, float(np.median(ranked)), float(np.median(matched))),
        *(first_wrong / count, other_room / count, localized / count, false),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--frames", type=int, default=16, help="of each room, a turn by 360 degrees")
    parser.add_argument("--features", default="orb")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    options = SyntheticOptions(
        frames=given.frames, lap_frames=given.frames, width=320, height=240, room_seed=100, noise=True
    )
    rooms = render(options, given.rooms)
    rows = [row for detector in DETECTORS for row in compare(rooms, detector, features=given.features)]
    print(f"{rows[0].keyframes} keyframes in {given.rooms} rooms, {rows[0].queries} queries")
    print(
        f"{'detector':28}{'method':10}{'ranked':>8}{'matched':>8}{'first wrong':>13}{'other room':>12}{'localized':>11}"
    )
    for row in rows:
        shares = f"{row.first_wrong:13.3f}{row.other_room:12.3f}{row.localized:11.3f}{row.false:7d}"
        print(f"{row.detector:28}{row.method:10}{row.ranked:8.0f}{row.matched:8.0f}{shares}")
    if given.json is not None:
        values: list[dict[str, Any]] = [{name: getattr(row, name) for name in Row.__slots__} for row in rows]
        given.json.write_text(json.dumps(values, indent=2) + "\n")


if __name__ == "__main__":
    main()
