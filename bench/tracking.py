"""Tracking against single images: accuracy, jitter, honesty, cost; kidnapping and blackouts.

``python -m bench.tracking RECORDING... [--stride N] [--frames N] [--truth refined] [--json FILE]``. Every N-th frame is
a keyframe, all others are tracked in their order, and each is localized beside it. Costs are without networks: local
features and all after them, in processor time of the same run. With ``--truth refined`` keyframes and truth have
the poses that structure from motion gives, as with ``semdb evaluate``: those of the recordings differ from their images
by more than steps do. Kidnapped: the camera jumps over a third of the recording, and ten frames of the next
recording named (or of a rendered room) come in between; a frame is wrong when its state is ``tracking`` and it is more
than 0.25 m or 5 degrees off, or shows the other place. Blackout: three seconds of black images while time goes on.
Models are those of the settings (``SEMDB_DETECTOR``, ``SEMDB_ENCODER``).
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import semdb
from semdb.api import Database
from semdb.api.tracking import smooth_answers
from semdb.door.tracked import Tracked
from semdb.evaluation.protocols import SPLIT
from semdb.evaluation.tasks import GIVEN, REFINED, Part, Task, refine_truth
from semdb.geometry import invert_pose, pose_error
from semdb.perception.quality import with_contrast
from semdb.recordings import Recording, open_recording
from semdb.recordings.base import FrameEntry
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from semdb.trajectory.recording import times_of
from semdb.types import FloatArray, Frame, Verdict

FALSE_M, FALSE_DEG = 0.25, 5.0
FOREIGN, BLACKOUT_S = 10, 3.0
GAP_NS = 200_000_000  # between frames after a jump


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One frame's answer beside the truth; `pose` is None where there is none that counts."""

    pose: FloatArray | None
    covariance: FloatArray | None
    truth: FloatArray
    ms: float  # of processor time, without networks


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--stride", type=int, default=5)
    parser.add_argument("--frames", type=int, help="at most so many of each recording")
    parser.add_argument("--truth", choices=(GIVEN, REFINED), default=GIVEN)
    parser.add_argument("--poses", type=Path, help="folder that keeps refined poses for the next run")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for number, path in enumerate(given.recordings):
            others = [p for p in given.recordings if p != path]
            foreign = others[number % len(others)] if others else rendered(Path(folder) / "room")
            recording = with_truth(open_recording(path), given.truth, given.poses)
            with semdb.open(f"sqlite:///{folder}/{number}.sqlite3") as database:
                results[recording.name] = measure(database, recording, given.stride, given.frames, foreign)
            show(recording.name, results[recording.name])
    if given.json:
        given.json.write_text(json.dumps(results, indent=2))


def with_truth(recording: Recording, truth: str, kept: Path | None) -> Recording:
    """The recording with refined poses and without frames that have none, where these are asked for."""
    if truth == GIVEN:
        return recording
    file = None if kept is None else kept / f"refined_{recording.path.name}.npz"
    if file is not None and file.exists():
        with np.load(file) as known:
            poses = dict(zip(known["index"].tolist(), known["pose"], strict=True))
        entries = [replace(e, world_from_camera=poses[e.index]) for e in recording.entries if e.index in poses]
        return replace(recording, entries=tuple(entries))
    part = Part(recording, tuple(entry for entry in recording.entries if entry.world_from_camera is not None))
    task = Task(recording.name, SPLIT, (part,), (), len(part.entries))
    [better] = refine_truth(task, both=False, progress=None)
    found = better.keyframes[0].entries
    if file is not None:
        np.savez(file, index=[e.index for e in found], pose=np.stack([truth_of(e) for e in found]))
    return replace(recording, entries=found)


def rendered(folder: Path) -> Path:
    write_synthetic_recording(folder, SyntheticOptions(frames=FOREIGN * 2, noise=True, room_seed=9))
    return folder


def measure(database: Database, recording: Recording, stride: int, most: int | None, foreign: Path) -> dict[str, Any]:
    """All parts of one recording."""
    database.ingest(recording, map="tracked", stride=stride)
    entries = recording.entries[:most]
    times_s, _ = times_of(entries)
    frames = [
        frame_of(recording, number, round(times_s[number] * 1e9)) for number in range(len(entries)) if number % stride
    ]
    single, answers, spent = beside(database, frames)
    again = database.tracker("tracked")
    smooth = list(smooth_answers((again.update(frame) for frame in frames), again))
    return {
        "single": scores(single),
        "tracked": scores(rows_of(answers, frames, spent)),
        "smoothed": scores(rows_of(smooth, frames)),
        "states": Counter(str(answer.state) for answer in answers),
        "kidnapped": kidnapped(database, frames, open_recording(foreign)),
        "blackout": blackout(database, frames),
    }


def beside(database: Database, frames: Sequence[Frame]) -> tuple[list[Row], list[Tracked], list[float]]:
    """Each frame as a single image and tracked, in turn, so that what else the machine does meets both alike."""
    tracker = database.tracker("tracked")
    single, answers, spent = [], [], []
    for frame in frames:
        single.append(one_by_one(database, frame))
        started = time.process_time()
        answers.append(tracker.update(frame))
        spent.append((time.process_time() - started) * 1000)
    return single, answers, spent


def frame_of(recording: Recording, number: int, time_ns: int) -> Frame:
    entry = recording.entries[number]
    return Frame(
        index=entry.index,
        name=entry.name,
        timestamp_ns=time_ns,
        image=recording.read_image(entry),
        depth=None,
        camera=recording.camera_of(entry),
        world_from_camera=entry.world_from_camera,
        instances=recording.read_instances(entry),
    )


def one_by_one(database: Database, frame: Frame) -> Row:
    """A single image, localized; local features and all after them are timed."""
    [entry] = database._here.maps().asked("tracked", "index")
    description = entry.describer.describe(frame.image, None, frame.camera, frame.instances)
    grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), np.uint8)
    started = time.process_time()
    entry.describer.features.extract(with_contrast(grey)[0])
    answer = entry.localizer.localize(description)
    spent = (time.process_time() - started) * 1000
    pose = answer.world_from_camera if answer.verdict is Verdict.LOCALIZED else None
    return Row(pose, answer.covariance, truth_of(frame), spent)


def truth_of(frame: Frame | FrameEntry) -> FloatArray:
    if frame.world_from_camera is None:
        raise ValueError(f"{frame.name} has no pose to be compared with")
    return frame.world_from_camera


def rows_of(answers: Sequence[Tracked], frames: Sequence[Frame], spent: Sequence[float] | None = None) -> list[Row]:
    spent = spent or [answer.latency_ms for answer in answers]
    return [
        Row(a.world_from_camera if a.tracking else None, a.covariance, truth_of(f), ms)
        for a, f, ms in zip(answers, frames, spent, strict=True)
    ]


def scores(rows: Sequence[Row]) -> dict[str, float]:
    """Shares, errors in metres and degrees, steps between successive frames, NEES of the position, milliseconds."""
    found = [row for row in rows if row.pose is not None]
    if not found:
        return {"share": 0.0}
    errors = np.array([pose_error(row.pose, row.truth) for row in found if row.pose is not None])
    steps = np.array(
        [
            pose_error(invert_pose(a.pose) @ b.pose, invert_pose(a.truth) @ b.truth)
            for a, b in itertools.pairwise(rows)
            if a.pose is not None and b.pose is not None
        ]
    ).reshape(-1, 2)
    ms = np.array([row.ms for row in rows])
    return {
        "share": len(found) / len(rows),
        "median_m": float(np.median(errors[:, 0])),
        "median_deg": float(np.median(errors[:, 1])),
        "p99_m": float(np.percentile(errors[:, 0], 99)),
        "step_m": float(np.median(steps[:, 0])),
        "step_deg": float(np.median(steps[:, 1])),
        "step_p99_m": float(np.percentile(steps[:, 0], 99)),
        "p99_deg": float(np.percentile(errors[:, 1], 99)),
        "nees": float(np.median([nees(row) for row in found])),
        "ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95)),
    }


def nees(row: Row) -> float:
    """Squared error of the position in standard deviations; 2.4 in the median where covariances are true."""
    if row.pose is None or row.covariance is None:
        return float("nan")
    off = row.pose[:3, 3] - row.truth[:3, 3]
    return float(off @ np.linalg.solve(row.covariance[:3, :3], off))


def kidnapped(database: Database, frames: Sequence[Frame], foreign: Recording) -> dict[str, int]:
    """A jump over a third of the frames, with frames of another place in between."""
    third = len(frames) // 3
    camera = frames[0].camera
    elsewhere = [frame_of(foreign, number, 0) for number in range(min(FOREIGN, len(foreign.entries)))]
    shown = [*frames[:third], *(replace(f, camera=f.camera) for f in elsewhere), *frames[2 * third :]]
    tracker = database.tracker("tracked", camera=camera if same_size(elsewhere, frames) else None)
    time_ns, wrong, back = -GAP_NS, 0, -1
    for number, frame in enumerate(shown):
        steady = 0 < number < third or number > third + len(elsewhere)
        time_ns += gap_of(shown, number) if steady else GAP_NS
        answer = tracker.update(replace(frame, timestamp_ns=time_ns))
        is_foreign = third <= number < third + len(elsewhere)
        if answer.tracking and answer.world_from_camera is not None:
            off = (np.inf, np.inf) if is_foreign else pose_error(answer.world_from_camera, truth_of(frame))
            wrong += off[0] > FALSE_M or off[1] > FALSE_DEG
            if not is_foreign and number >= third and back < 0:
                back = number - third - len(elsewhere) + 1
    return {"wrong": int(wrong), "back_after": back}


def same_size(some: Sequence[Frame], others: Sequence[Frame]) -> bool:
    return some[0].image.shape == others[0].image.shape


def gap_of(frames: Sequence[Frame], number: int) -> int:
    """Nanoseconds since the frame before; both have times of one recording."""
    now, before = frames[number].timestamp_ns, frames[number - 1].timestamp_ns
    return GAP_NS if now is None or before is None or now <= before else now - before


def blackout(database: Database, frames: Sequence[Frame]) -> dict[str, Any]:
    """Black images for three seconds in the middle of the recording."""
    middle = len(frames) // 2
    start = frames[middle].timestamp_ns or 0
    tracker = database.tracker("tracked")
    states: Counter[str] = Counter()
    inside, back = [], -1
    for number, frame in enumerate(frames):
        dark = start <= (frame.timestamp_ns or 0) < start + BLACKOUT_S * 1e9
        answer = tracker.update(replace(frame, image=np.zeros_like(frame.image)) if dark else frame)
        if dark:
            states[str(answer.state)] += 1
            if answer.world_from_camera is not None:
                inside.append(nees(Row(answer.world_from_camera, answer.covariance, truth_of(frame), 0.0)))
        elif number > middle and answer.tracking and back < 0:
            back = number - middle - states.total() + 1
    return {"states": states, "nees": float(np.median(inside)) if inside else None, "back_after": back}


def show(name: str, result: dict[str, Any]) -> None:
    print(name, dict(result["states"]))
    for method in ("single", "tracked", "smoothed"):
        row = result[method]
        print(f"  {method:9}" + "  ".join(f"{key} {value:.4g}" for key, value in row.items()))
    ratio = result["tracked"]["ms"] / result["single"]["ms"]
    print(f"  cost of a tracked frame {ratio:.2f} of a single image; kidnapped {result['kidnapped']}")
    print(f"  blackout {result['blackout']}", flush=True)


if __name__ == "__main__":
    main()
