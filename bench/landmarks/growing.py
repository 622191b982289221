"""What it costs to compute landmarks of a large map, and to compute them again after keyframes were added.

``python -m bench.landmarks.growing [--rooms 20] [--keyframes 50] [--added 2] [--width 640] [--found 1] [--noise]
[--spread] [--rendered FOLDER] [--json FILE]``. A building of
rooms 25 m apart, of `--keyframes` each: two rooms are rendered, and stand there again and again. Landmarks are
computed of all rooms but the last `--added`, then of all with what is remembered, then of all from nothing, which has
to give the same to the last bit. Times are of the processor, and as multiples of reading all rows. `--spread` adds as
many keyframes to every room instead: then every room has changed. `--found` is the share of the objects that the
detector finds, `--rendered` keeps what was rendered for the next time. Needs no model file.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from sqlalchemy import text

from semdb.database import landmark_rows
from semdb.database.records import KeyframeRecord, RecordingPlan
from semdb.database.store import Store, open_store
from semdb.perception.describe import Describer
from semdb.perception.detectors.recorded import RecordedDetector
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features import load_features
from semdb.perception.objects import take_features
from semdb.recordings.images import encode_16bit
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.refinement.run import refine_map
from semdb.refinement.steps import LANDMARKS
from semdb.settings import Settings
from semdb.types import InstanceMasks, Keypoints

APART_M = 25.0
ROOMS = (302, 303)  # seeds


@dataclass(frozen=True, slots=True)
class Growth:
    """Seconds of the processor."""

    keyframes: int
    added: int
    objects: int
    landmarks: int
    cores: int
    memory_mib: int  # of the process, at most, beyond what it has of rendered rooms
    reading: float  # all rows
    before: float  # without what is added
    after: float  # with it, and with what is remembered
    whole: float  # from nothing
    seconds: dict[str, float]  # on the wall, of before, after and whole
    stored_bytes: int  # that are remembered
    same: bool  # contents, bit for bit


def room_records(seed: int, keyframes: int, width: int, *, noise: bool) -> list[KeyframeRecord]:
    """The keyframes of a room, with mistakes of a detector."""
    size = {"width": width, "height": width * 3 // 4}
    mistakes = {"missed": 0.3, "confused": 0.15} if noise else {}
    options = SyntheticOptions(
        frames=keyframes, lap_frames=keyframes, room_seed=seed, seed=seed, noise=noise, **size, **mistakes
    )
    sequence = SyntheticSequence(options)
    describer = Describer(RecordedDetector(), GistEncoder(), load_features("orb", Settings()))
    found = []
    for index in range(keyframes):
        frame = sequence.render(index)
        masks = InstanceMasks(frame.labels, sequence.classes)
        made = describer.describe(frame.rgb, frame.known_depth, sequence.camera, masks)
        image = cv2.imencode(".jpg", frame.rgb[..., ::-1])[1].tobytes()
        packed = encode_16bit(np.rint(frame.depth * 5000).astype(np.uint16))
        found.append(
            KeyframeRecord(index, None, sequence.camera, frame.world_from_camera, image, packed, 5000.0, "", made)
        )
    return found


def store_room(
    store: Store, map_id: int, number: int, records: Sequence[KeyframeRecord], chosen: Sequence[int]
) -> None:
    """Those of the records that are `chosen`, as a room of the building."""
    plan = RecordingPlan(
        f"room-{number:03d}", "synthetic", "rendered", len(records), "rendered", tuple(range(len(records)))
    )
    recording = store.plan_recording(map_id, plan, records[0].description.models).recording_id
    for index in chosen:
        pose = records[index].world_from_camera.copy()
        pose[0, 3] += APART_M * number
        store.write_keyframe(recording, replace(records[index], world_from_camera=pose))


def kept_records(seed: int, keyframes: int, width: int, folder: Path | None, *, noise: bool) -> list[KeyframeRecord]:
    """As `room_records`; rendered once where there is a `folder`."""
    if folder is None:
        return room_records(seed, keyframes, width, noise=noise)
    path = folder / f"room-{seed}-{keyframes}-{width}-{int(noise)}.pickle"
    if not path.exists():
        path.write_bytes(pickle.dumps(room_records(seed, keyframes, width, noise=noise)))
    found: list[KeyframeRecord] = pickle.loads(path.read_bytes())
    return found


def with_found(records: Sequence[KeyframeRecord], share: float) -> list[KeyframeRecord]:
    """The keyframes with so large a share of their objects."""
    thinned = []
    for record in records:
        made, rng = record.description, np.random.default_rng([record.frame_index, 23])
        kept = np.flatnonzero(rng.random(len(made.detections)) < share).tolist()
        detections, geometry = (tuple(part[k] for k in kept) for part in (made.detections, made.geometry))
        number = np.full(len(made.detections) + 1, -1, np.int32)  # the last: of the background
        number[kept] = np.arange(len(kept))
        index = number[made.keypoints.object_index]
        order = np.argsort(np.where(index < 0, len(kept), index), kind="stable")
        points = made.keypoints
        keypoints = Keypoints(take_features(points.features, order), index[order], points.points[order])
        found = replace(made, detections=detections, geometry=geometry, keypoints=keypoints, sightings=None)
        thinned.append(replace(record, description=found))
    return thinned


def spent(work: Callable[[], object], what: str, seconds: dict[str, float]) -> float:
    """Processor time of `work`, seconds; those on the wall are noted."""
    start, wall = time.process_time(), time.perf_counter()
    work()
    seconds[what] = time.perf_counter() - wall
    taken = time.process_time() - start
    print(f"{what}: {taken:.1f} s of the processor, {seconds[what]:.1f} s on the wall", flush=True)
    return taken


def contents(store: Store) -> list[tuple[object, ...]]:
    """What landmarks there are, ids apart."""
    columns = "category_id, probability, evidence, x, y, z, cov_xx, cov_xy, cov_yz, size_x, size_y, size_z, yaw, "
    columns += "sightings, keyframes, missed, seen_through, state, first_keyframe_id, last_keyframe_id"
    with store.engine.connect() as connection:
        rows = connection.execute(text(f"SELECT {columns} FROM landmarks"))
        return sorted((tuple(row) for row in rows), key=repr)


def measure(given: argparse.Namespace) -> Growth:
    """One building, on SQLite."""
    rooms, keyframes, added, spread = int(given.rooms), int(given.keyframes), int(given.added), bool(given.spread)
    records = [
        with_found(kept_records(seed, keyframes, given.width, given.rendered, noise=given.noise), given.found)
        for seed in ROOMS
    ]
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder, open_store(f"sqlite:///{folder}/m.sqlite3", create=True) as store:
        map_id = store.ensure_map("building")
        everything = list(range(keyframes))
        late = everything[:: max(1, rooms // max(added, 1))] if spread else []
        total = rooms if spread else rooms + added
        for number in range(rooms):
            store_room(store, map_id, number, records[number % 2], [k for k in everything if k not in late])
        info = store.find_map("building")
        refine_map(store, store.find_map("building"), kinds=["classes"])
        rendered = resident_mib()
        before = spent(lambda: refine_map(store, info, kinds=[LANDMARKS]), "before", seconds)
        for number in range(total):
            if number >= rooms or spread:
                store_room(store, map_id, number, records[number % 2], late if spread else everything)
        after = spent(lambda: refine_map(store, info, kinds=[LANDMARKS]), "after", seconds)
        found = contents(store)
        with store.engine.connect() as connection:
            stored = int(connection.execute(text("SELECT SUM(size) FROM landmark_parts")).scalar() or 0)
        whole = spent(lambda: refine_map(store, info, kinds=[LANDMARKS], force=True), "whole", seconds)
        reading = spent(lambda: _read(store, map_id), "reading", seconds)
        objects = sum(len(r.description.detections) for n in range(total) for r in records[n % 2])
        count = store.keyframe_count(map_id)
        new = count - rooms * (keyframes - len(late))
        same = contents(store) == found
        memory = max(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024 - rendered, 0)
        sizes = (count, new, objects, len(found), len(os.sched_getaffinity(0)), memory)
        return Growth(*sizes, reading, before, after, whole, seconds, stored, same)


def resident_mib() -> int:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 2**20


def _read(store: Store, map_id: int) -> None:
    for _ in landmark_rows.iter_keyframe_depths(store.engine, map_id):
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--keyframes", type=int, default=50)
    parser.add_argument("--added", type=int, default=2)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--noise", action="store_true", help="noisy depth, 30 %% missed, 15 %% misnamed")
    parser.add_argument("--spread", action="store_true", help="what is added is of all rooms")
    parser.add_argument("--found", type=float, default=1.0, help="share of the objects that the detector finds")
    parser.add_argument("--rendered", type=Path, help="folder that keeps what is rendered")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found = measure(given)
    of_map = f"{found.keyframes} keyframes, {found.added} of them added, {found.objects} objects"
    print(f"{of_map}, {found.landmarks} landmarks")
    for name in ("reading", "before", "after", "whole"):
        seconds = getattr(found, name)
        shares = f"{seconds / found.reading:8.1f} times reading{seconds / found.whole:8.3f} of the whole"
        print(f"{name:10}{seconds:8.1f} s of one core{shares}")
    print(f"{found.cores} cores, {found.memory_mib} MiB of memory at most beyond rendered rooms")
    print(
        f"remembered {found.stored_bytes / 2**20:.0f} MiB; contents are {'the same' if found.same else 'NOT THE SAME'}"
    )
    if given.json is not None:
        given.json.write_text(json.dumps(asdict(found), indent=2) + "\n")


if __name__ == "__main__":
    main()
