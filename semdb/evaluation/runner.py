"""Runs an evaluation: keyframes into a database of its own, the other frames as queries, one result per method."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from semdb.database.store import Store
from semdb.errors import FrameError
from semdb.evaluation.baselines import SiftReference, nearest_in_pose
from semdb.evaluation.methods import ORACLE, SEMDB, SIFT_REFERENCE, Method, method_named
from semdb.evaluation.metrics import EvaluationResult, QueryResult, query_result, summarise
from semdb.evaluation.protocols import PAPER, evenly_spaced, split_paper
from semdb.evaluation.workspace import evaluation_store
from semdb.ingest import IngestOptions, ingest_recording
from semdb.keyframes import select_keyframes
from semdb.localization.localizer import Localizer
from semdb.localize import check_coarse, make_localizer
from semdb.model_choice import specs_for_ingest
from semdb.perception.describe import Describer, describer_from_specs
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording
from semdb.settings import Settings
from semdb.types import Camera, Description, Frame, Localization, ModelInfo

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """`query_depth` gives the queries their depth images too; otherwise a query is one colour image."""

    methods: tuple[str, ...] = (SEMDB,)
    keyframes: int | None = None
    max_queries: int | None = None
    coarse: str = "sql"
    camera: Camera | None = None
    query_depth: bool = False


def evaluate(
    paths: Sequence[Path],
    settings: Settings,
    options: EvaluateOptions | None = None,
    *,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> list[EvaluationResult]:
    """Protocol `paper` on every recording under `paths`, every method on the same keyframes and queries.

    Raises what `semdb.ingest.ingest_recordings` raises, and UsageError for an unknown method or too few frames.
    """
    options = options or EvaluateOptions()
    methods = [method_named(name) for name in options.methods]
    check_coarse(options.coarse)
    if options.max_queries is not None:
        evenly_spaced(0, options.max_queries)  # says now what would be wrong with it later
    recordings = [found for path in paths for found in open_recordings(path, options.camera)]
    results = []
    for recording in recordings:
        specs = specs_for_ingest(settings, (), has_masks=recording.categories is not None)
        for note in (*recording.notes, *specs.notes):
            if say is not None:
                say(f"{recording.name}: {note}")
        describers = _Describers(specs.detector, specs.encoder, specs.features, settings)
        results += _evaluate_recording(recording, describers, methods, settings, options, progress)
        if say is not None:
            for line in _unusable(recording):
                say(line)
    return results


class _Describers:
    """One describer per kind of features, sharing the networks."""

    def __init__(self, detector: str, encoder: str, features: str, settings: Settings) -> None:
        self._default = features
        self._settings = settings
        self._made = {features: describer_from_specs(detector, encoder, features, settings)}

    def of(self, method: Method) -> Describer:
        name = method.features or self._default
        if name not in self._made:
            from semdb.perception.features import load_features

            first = self._made[self._default]
            self._made[name] = Describer(first.detector, first.encoder, load_features(name, self._settings))
        return self._made[name]


def _evaluate_recording(
    recording: Recording,
    describers: _Describers,
    methods: Sequence[Method],
    settings: Settings,
    options: EvaluateOptions,
    progress: Progress | None,
) -> list[EvaluationResult]:
    def selecting(done: int, total: int) -> None:
        if progress is not None:
            progress(f"selecting keyframes of {recording.name}", done, total)

    with evaluation_store(settings.database_url) as store:  # first: it may not answer, and selecting takes long
        keyframes = select_keyframes(recording, count=options.keyframes, progress=selecting)
        queries = split_paper(recording.entries, keyframes, options.max_queries)
        runs = [_open_run(method, recording, keyframes, describers, store, options, progress) for method in methods]
        answers: list[list[QueryResult]] = [[] for _ in runs]
        for done, frame in enumerate(_read(recording, queries), start=1):
            described: dict[int, tuple[Description, float]] = {}
            for run, found in zip(runs, answers, strict=True):
                found.append(run.answer(frame[0], frame[1], described))
            if progress is not None:
                progress(f"localizing in {recording.name}", done, len(queries))
    return [
        summarise(
            found,
            recording=recording.name,
            protocol=PAPER,
            method=run.name,
            models=run.models,
            frames=recording.total_frames,
            keyframes=run.keyframes,
        )
        for run, found in zip(runs, answers, strict=True)
    ]


def _unusable(recording: Recording) -> list[str]:
    """A line about the frames that were neither keyframe nor query, none where all were fit for it."""
    unusable = (*recording.dropped, *recording.decode_failures)
    if not unusable:
        return []
    return [
        f"{recording.name}: {len(unusable)} of {recording.total_frames} frames could not be used, the first "
        f"{unusable[0].name}: {unusable[0].reason} (semdb recording {recording.path} names all)"
    ]


def _read(recording: Recording, queries: Sequence[FrameEntry]) -> Iterator[tuple[Frame, float]]:
    """Frames with their decoding time; those that cannot be decoded are in `recording.decode_failures`."""
    for entry in queries:
        started = time.perf_counter()
        try:
            frame = recording.read(entry)
        except FrameError as error:
            recording.note_decode_failure(entry, error)
            continue
        yield frame, (time.perf_counter() - started) * 1000


class _Run:
    """A method, ready to answer. `keyframes` is how many it has: those that could be read."""

    def __init__(self, name: str, models: tuple[ModelInfo, ...], keyframes: int) -> None:
        self.name = name
        self.models = models
        self.keyframes = keyframes

    def answer(self, frame: Frame, decode_ms: float, described: dict[int, tuple[Description, float]]) -> QueryResult:
        """The result for one frame. `described` shares descriptions between the methods of one query."""
        localization, timing = self.localize(frame, described)
        timing = {"decode": decode_ms, **timing, **localization.timing_ms}
        timing["total"] = decode_ms + timing.pop("describe") + timing.pop("localize")
        return query_result(frame.name, frame.index, localization, frame.world_from_camera, timing_ms=timing)

    def localize(
        self, frame: Frame, described: dict[int, tuple[Description, float]]
    ) -> tuple[Localization, dict[str, float]]:
        """The answer, and wall times; `describe` and `localize` among them, which are whole."""
        raise TypeError(f"{type(self).__name__} answers nothing")


class _LocalizerRun(_Run):
    def __init__(self, method: Method, describer: Describer, localizer: Localizer, query_depth: bool) -> None:
        super().__init__(method.name, describer.models, len(localizer.cache.poses()[0]))
        self._describer = describer
        self._localizer = localizer
        self._query_depth = query_depth

    def describe(
        self, frame: Frame, described: dict[int, tuple[Description, float]]
    ) -> tuple[Description, dict[str, float]]:
        key = id(self._describer)
        if key not in described:
            started = time.perf_counter()
            depth = frame.depth if self._query_depth else None
            description = self._describer.describe(frame.image, depth, frame.camera, frame.instances)
            described[key] = description, (time.perf_counter() - started) * 1000
        description, milliseconds = described[key]
        return description, {"describe": milliseconds, **description.timing_ms}

    def localize(
        self, frame: Frame, described: dict[int, tuple[Description, float]]
    ) -> tuple[Localization, dict[str, float]]:
        description, timing = self.describe(frame, described)
        started = time.perf_counter()
        found = self._localizer.localize(description)
        return found, {**timing, "localize": (time.perf_counter() - started) * 1000}


class _OracleRun(_LocalizerRun):
    """Told the true pose, to choose keyframes by."""

    def localize(
        self, frame: Frame, described: dict[int, tuple[Description, float]]
    ) -> tuple[Localization, dict[str, float]]:
        if frame.world_from_camera is None:
            raise FrameError(f"{frame.name}: oracle chooses keyframes by the true pose, and there is none")
        description, timing = self.describe(frame, described)
        ids, poses = self._localizer.cache.poses()
        chosen = [ids[position] for position in nearest_in_pose(frame.world_from_camera, poses)]
        started = time.perf_counter()
        found = self._localizer.localize_among(description, chosen)
        return found, {**timing, "localize": (time.perf_counter() - started) * 1000}


class _SiftRun(_Run):
    def __init__(self, reference: SiftReference) -> None:
        super().__init__(SIFT_REFERENCE, reference.models, len(reference))
        self._reference = reference

    def localize(
        self, frame: Frame, described: dict[int, tuple[Description, float]]
    ) -> tuple[Localization, dict[str, float]]:
        found = self._reference.localize(frame)
        features = found.timing_ms["features"]
        return found, {"describe": features, "localize": found.timing_ms["total"] - features}


def _open_run(
    method: Method,
    recording: Recording,
    keyframes: Sequence[FrameEntry],
    describers: _Describers,
    store: Store,
    options: EvaluateOptions,
    progress: Progress | None,
) -> _Run:
    if method.name == SIFT_REFERENCE:
        frames = (frame for frame, _ in _read(recording, keyframes))
        return _SiftRun(SiftReference(frames, recording=recording.name))
    describer = describers.of(method)
    map_name = describer.features.info.name  # one map per kind of features: rows of two kinds do not mix
    if all(info.name != map_name for info in store.maps()):
        ingest = IngestOptions(map_name=map_name, keyframes=options.keyframes)
        summary = ingest_recording(recording, store, describer, ingest, progress=progress, entries=keyframes)
        for entry in keyframes:
            if entry.index in summary.failed:
                recording.note_decode_failure(entry, FrameError(summary.failed[entry.index]))
    localizer = make_localizer(store, store.find_map(map_name), options.coarse, method.options)
    run = _OracleRun if method.name == ORACLE else _LocalizerRun
    return run(method, describer, localizer, options.query_depth)
