"""Local features against each other, as what maps are made of: recordings, numbers of keyframes, conditions.

    python -m bench.features [RECORDING...] [--room N]... [--keyframes 6,12] [--conditions clean,small] [--json FILE]

Keyframes and queries are those of ``semdb evaluate``, networks those of SEMDB_DETECTOR and SEMDB_ENCODER; learned
features are SEMDB_FEATURES_FALLBACK and SEMDB_MATCHER, which have to be named. All features answer the same queries
through the same cascade, pose and verdict. ``--room N`` is a rendered room with exact masks, kept in ``--work`` as
the maps are; what ``--json`` already holds is not measured again, so that a run goes on where it ended. Times are
processor time on one thread.

clean    as recorded
night    a fifth of the light, from elsewhere and of another colour, with the noise of a sensor (rendered rooms only)
small    a third of the resolution, up again
blurN    motion of N pixels
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from sqlalchemy import func, select

from bench.poor_images import degraded
from bench.trust.images import Picture, darkened
from semdb.cli.options import load_settings
from semdb.database import tables
from semdb.database.store import Store, open_store
from semdb.evaluation.tasks import PaperPlan, Task
from semdb.geometry import pose_error
from semdb.ingestion.run import IngestOptions, ingest_recording
from semdb.localization.images import make_localizer
from semdb.localization.localizer import Localizer
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.features import load_features
from semdb.perception.model_choice import specs_for_ingest
from semdb.perception.protocols import FeatureExtractor
from semdb.recordings import open_recordings
from semdb.recordings.base import Recording
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence, write_synthetic_recording
from semdb.refinement.run import refine_map
from semdb.refinement.steps import FOR_LOCALIZATION
from semdb.settings import Settings
from semdb.types import Description, Detection, Float32Array, FloatArray, Frame, ImageArray, InstanceMasks, Verdict

FALSE, WITHIN = (0.25, 5.0), (0.05, 5.0)  # metres, degrees
NIGHT = 0.2  # of the light
ROOM_FRAMES = 48  # once around
BYTES = (("keypoints", "data"), ("descriptors", "data"))
Key = tuple[str, int, str, str]  # recording, keyframes, condition, feature


@dataclass(frozen=True, slots=True)
class Contestant:
    """A feature of a map, with what is asked beside it."""

    name: str
    features: str
    matcher: str | None = None
    fallback: str | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """What one feature does in one place under one condition; medians are of the localized queries."""

    recording: str
    keyframes: int
    condition: str
    feature: str
    queries: int
    localized: int
    within: int  # 5 cm and 5 degrees, and localized
    false: int
    median_m: float | None
    median_deg: float | None
    inliers: float  # median over all queries
    extract_ms: float
    localize_ms: float
    kilobytes: float  # of keypoints and descriptors, a keyframe

    @property
    def key(self) -> Key:
        return self.recording, self.keyframes, self.condition, self.feature


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A recording that becomes a map and is asked about; `night` is the same walk in other light."""

    recording: Recording
    night: SyntheticSequence | None = None


class Remembered:
    """A detector and an encoder whose answers are kept, so that every feature is told the same at no cost.

    `file` keeps them between runs, for these networks.
    """

    def __init__(self, describer: Describer, file: Path) -> None:
        self.key: object = None
        self._describer, self._file = describer, file
        self._networks = describer.detector.info, describer.encoder.info
        self._found: dict[object, tuple[tuple[Detection, ...], Float32Array]] = {}
        if file.exists():
            networks, found = pickle.loads(zlib.decompress(file.read_bytes()))
            self._found = found if networks == self._networks else {}
        self._saved = len(self._found)
        self.detector: Any = _Half(describer.detector, self.detect)
        self.encoder: Any = _Half(describer.encoder, self.encode)

    @property
    def knows(self) -> bool:
        return self.key in self._found

    def save(self) -> None:
        if len(self._found) > self._saved:
            new = self._file.with_name(self._file.name + ".new")
            new.write_bytes(zlib.compress(pickle.dumps((self._networks, self._found)), 1))
            new.replace(self._file)
            self._saved = len(self._found)

    def _both(self, image: ImageArray, instances: InstanceMasks | None) -> tuple[tuple[Detection, ...], Float32Array]:
        if self.key not in self._found:
            own = self._describer
            self._found[self.key] = own.detector.detect(image, instances), own.encoder.encode(image)
        return self._found[self.key]

    def detect(self, image: ImageArray, instances: InstanceMasks | None = None) -> tuple[Detection, ...]:
        return self._both(image, instances)[0]

    def encode(self, image: ImageArray) -> Float32Array:
        return self._found[self.key][1]


class _Half:
    """A network of `Remembered`, by the name that the describer calls."""

    def __init__(self, own: Any, work: Callable[..., Any]) -> None:
        self.info, self.classes = own.info, getattr(own, "classes", ())
        self.detect = self.encode = work


def contestants(settings: Settings) -> list[Contestant]:
    """SURF and SIFT, and what the settings name of learned features."""
    learned, matcher = settings.features_fallback, settings.matcher
    found = [Contestant("SURF", "surf"), Contestant("SIFT", "sift")]
    if learned is None:
        print("SEMDB_FEATURES_FALLBACK is not set: learned features are left out", file=sys.stderr)
        return found
    found.append(Contestant("learned", learned))
    if matcher is not None:
        found.append(Contestant("learned, with matcher", learned, matcher))
    return [*found, Contestant("SURF, then learned", "surf", None, learned)]


def room(work: Path, number: int) -> Place:
    """A rendered room, kept in `work`, and the same by night, of which only what is asked is rendered."""
    day = SyntheticOptions(
        frames=ROOM_FRAMES, lap_frames=ROOM_FRAMES, seed=number, room_seed=100 + number,
        furniture_seed=200 + number, noise=True,
    )  # fmt: skip
    name = f"room{number}"
    if not (work / name).exists():
        print(f"rendering {name}", file=sys.stderr)
        write_synthetic_recording(work / name, day)
    return Place(open_recordings(work / name)[0], SyntheticSequence(replace(day, lighting=1.0)))


def seen_as(place: Place, frame: Frame, condition: str, seed: int) -> Frame:
    """A query `frame` under a condition; the same image every time."""
    rng = np.random.default_rng([seed, frame.index])
    if condition != "night":
        return replace(frame, image=degraded(frame.image, condition, rng))
    assert place.night is not None
    picture = Picture(place.night.render(frame.index).rgb, frame.camera, None)
    return replace(frame, image=darkened(picture, rng, NIGHT).image)


class Measuring:
    """All features on one place: one map for each feature and number of keyframes, kept in `work`."""

    def __init__(self, place: Place, settings: Settings, work: Path) -> None:
        self.place, self.settings, self.work = place, settings, work
        specs = specs_for_ingest(settings, (), has_masks=place.recording.categories is not None)
        self._first = describer_from_specs(specs.detector, specs.encoder, "surf", settings)
        self._remembered = Remembered(self._first, work / f"{place.recording.name}-networks.pickle")
        self._extractors: dict[str, FeatureExtractor] = {}
        self._described: dict[tuple[str, str, int], tuple[Description, float]] = {}

    def describer(self, features: str, networks: Describer | Remembered) -> Describer:
        if features not in self._extractors:
            self._extractors[features] = load_features(features, self.settings)
        return Describer(networks.detector, networks.encoder, self._extractors[features], self._first.rules)

    def describe(self, features: str, frame: Frame, condition: str) -> tuple[Description, float]:
        """What a map of `features` is told of a query, and the milliseconds of the feature."""
        key = features, condition, frame.index
        if key not in self._described:
            describer = self.describer(features, self._remembered)
            self._remembered.key = condition, frame.index
            seen = seen_as(self.place, frame, condition, 0)
            if not self._remembered.knows:  # the networks are not what is timed
                describer.describe(seen.image, None, seen.camera, seen.instances)
            started = time.process_time()
            found = describer.describe(seen.image, None, seen.camera, seen.instances)
            self._described[key] = found, 1000 * (time.process_time() - started)
        return self._described[key]

    def store(self, features: str, task: Task) -> Store:
        """The map, made where it is not there yet."""
        count = sum(len(part.entries) for part in task.keyframes)
        name = f"{self.place.recording.name}-{count}-{features.rpartition('/')[2]}.sqlite3".replace(":", "-")
        path, new = self.work / name, self.work / f"{name}.new"
        if not path.exists():
            new.unlink(missing_ok=True)
            with open_store(f"sqlite:///{new}", create=True) as store:
                describer, options = self.describer(features, self._first), IngestOptions(map_name="m")
                for part in task.keyframes:
                    ingest_recording(part.recording, store, describer, options, entries=list(part.entries))
                refine_map(store, store.find_map("m"), kinds=FOR_LOCALIZATION)
            new.rename(path)
        return open_store(f"sqlite:///{path}")

    def row(self, contestant: Contestant, task: Task, condition: str) -> Row:
        own = self.settings.model_copy(
            update={
                "features": contestant.features,
                "matcher": contestant.matcher,
                "features_fallback": contestant.fallback,
            }
        )
        with self.store(contestant.features, task) as store:
            localizer = make_localizer(store, store.find_map("m"), "sql", settings=own)
            answers = list(self._answers(localizer, contestant, task, condition))
            self._remembered.save()
            return _row(
                (self.place.recording.name, len(store.keyframe_ids(1)), condition, contestant.name),
                answers, kilobytes(store),
            )  # fmt: skip

    def _answers(
        self, localizer: Localizer, contestant: Contestant, task: Task, condition: str
    ) -> Iterator[tuple[bool, float, float, int, float, float]]:
        """Whether localized, errors, inliers, milliseconds of feature and of localization."""
        for part in task.queries:
            for entry in part.entries:
                frame = part.recording.read(entry)
                description, extract = self.describe(contestant.features, frame, condition)
                started = time.process_time()
                found = localizer.localize(description)
                spent = 1000 * (time.process_time() - started)
                metres, degrees = float("inf"), float("inf")
                if found.world_from_camera is not None and frame.world_from_camera is not None:
                    metres, degrees = pose_error(found.world_from_camera, frame.world_from_camera)
                yield found.verdict is Verdict.LOCALIZED, metres, degrees, found.inliers, extract, spent


def _row(key: Key, answers: Sequence[tuple[bool, float, float, int, float, float]], size: float) -> Row:
    localized, *columns = (np.array(column) for column in zip(*answers, strict=True))
    metres, degrees, inliers, extract, spent = columns
    sure = localized.astype(bool)

    def median(values: FloatArray) -> float | None:
        return float(np.median(values[sure])) if sure.any() else None

    inside = sure & (metres <= WITHIN[0]) & (degrees <= WITHIN[1])
    wrong = sure & ((metres > FALSE[0]) | (degrees > FALSE[1]))
    return Row(
        *key, len(answers), int(sure.sum()), int(inside.sum()), int(wrong.sum()), median(metres), median(degrees),
        float(np.median(inliers)), float(np.median(extract)), float(np.median(spent)), size,
    )  # fmt: skip


def kilobytes(store: Store) -> float:
    """Of the keypoints and descriptors of a keyframe, in the mean."""
    total = 0
    with store.engine.connect() as connection:
        for table, column in BYTES:
            size = select(func.sum(func.length(tables.metadata.tables[table].c[column])))
            total += int(connection.execute(size).scalar() or 0)
    return total / 1024 / len(store.keyframe_ids(1))


def show(rows: Sequence[Row]) -> None:
    """As a table of Markdown."""
    print(
        "| recording | keyframes | condition | feature | localized | within 5 cm, 5° | false | median | inliers "
        "| extract + localize | KiB a keyframe |\n|" + "---|" * 11
    )
    for row in rows:
        middle = "-" if row.median_m is None else f"{row.median_m:.4f} m {row.median_deg:.2f}°"
        print(
            f"| {row.recording} | {row.keyframes} | {row.condition} | {row.feature} | {row.localized} of {row.queries} "
            f"| {row.within} | {row.false} | {middle} | {row.inliers:.0f} "
            f"| {row.extract_ms:.0f} + {row.localize_ms:.0f} ms | {row.kilobytes:.0f} |"
        )


def main(given: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--room", type=int, action="append", default=[], help="a rendered room, by number")
    parser.add_argument("--keyframes", default="12")
    parser.add_argument("--conditions", default="clean")
    parser.add_argument("--queries", type=int, default=40)
    parser.add_argument("--only", help="features by name, in their order, separated by semicolons")
    parser.add_argument("--work", type=Path, help="rooms and maps are kept here and found again")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args(given)
    cv2.setNumThreads(1)
    rows = [] if arguments.json is None or not arguments.json.exists() else load(arguments.json)
    with tempfile.TemporaryDirectory() as folder:
        work = arguments.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        places = [Place(found) for path in arguments.recordings for found in open_recordings(path)]
        places += [room(work, number) for number in arguments.room]
        for place in places:
            for row in measured(place, arguments, work, {row.key for row in rows}):
                rows.append(row)
                show([row])
                sys.stdout.flush()
                if arguments.json is not None:
                    save(arguments.json, rows)
    print()
    show(rows)


def measured(place: Place, arguments: argparse.Namespace, work: Path, done: set[Key]) -> Iterator[Row]:
    """The rows of a place that are not `done`."""
    settings = load_settings().model_copy(update={"threads": 1})
    if place.recording.categories is not None:
        settings = settings.model_copy(update={"detector": "recorded"})
    known = contestants(settings)
    chosen = arguments.only.split(";") if arguments.only else [one.name for one in known]
    measuring = Measuring(place, settings, work)
    for count in map(int, arguments.keyframes.split(",")):
        task = PaperPlan(place.recording).choose(count, arguments.queries, None, None)
        for condition in arguments.conditions.split(","):
            if condition == "night" and place.night is None:
                continue
            for contestant in known:
                key = place.recording.name, count, condition, contestant.name
                if contestant.name in chosen and key not in done:
                    yield measuring.row(contestant, task, condition)


def load(path: Path) -> list[Row]:
    return [Row(**values) for values in json.loads(path.read_text())]


def save(path: Path, rows: Sequence[Row]) -> None:
    new = path.with_name(path.name + ".new")
    new.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    new.replace(path)


if __name__ == "__main__":
    main()
