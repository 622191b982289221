"""The pipeline from a recording to rows: select keyframes, plan, describe, store. Called by the CLI and the workers.

The plan is written before the first keyframe, each keyframe with all its children in one transaction, so a run
that is cut off anywhere is finished by running it again.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from semdb.database.planning import check_models
from semdb.database.records import KeyframeRecord, PlannedRecording, RecordingPlan
from semdb.database.store import Store, open_store
from semdb.errors import FrameError, UsageError
from semdb.keyframes import select_keyframes
from semdb.model_choice import settings_of_map, specs_for_ingest
from semdb.perception.describe import Describer, describer_from_specs
from semdb.recordings import open_recordings
from semdb.recordings.base import DroppedFrame, FrameEntry, Recording
from semdb.settings import Settings
from semdb.types import Camera, Frame, ModelInfo

Progress = Callable[[str, int, int], None]  # what, done, total


@dataclass(frozen=True, slots=True)
class IngestOptions:
    """`keyframes` and `stride` as in `semdb.keyframes.select_keyframes`; `name` overrides the recording's own.

    `map_name` None gives each recording the map of `default_map_name`.
    """

    map_name: str | None = None
    name: str | None = None
    keyframes: int | None = None
    stride: int | None = None
    camera: Camera | None = None


@dataclass(slots=True)
class IngestSummary:
    """What became of one recording. `seconds` are wall times of stages; networks' time is in detect and encode."""

    map_name: str
    recording: str
    recording_id: int
    total_frames: int
    usable_frames: int
    planned: int
    already_stored: int
    models: tuple[ModelInfo, ...]
    stored: int = 0
    objects: int = 0
    keypoints: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    dropped: tuple[DroppedFrame, ...] = ()
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


def ingest_recordings(
    paths: Sequence[Path],
    settings: Settings,
    options: IngestOptions | None = None,
    *,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> list[IngestSummary]:
    """Ingests every recording under `paths` into one map; one summary each, in order.

    `say` takes lines for people (what was chosen where nothing was set). Raises RecordingError for a path that
    cannot be used at all, UsageError when the models or the plan contradict what is stored, DatabaseError.
    """
    options = options or IngestOptions()
    recordings = [found for path in paths for found in open_recordings(path, options.camera)]
    if options.name is not None:
        if len(recordings) > 1:
            raise UsageError(f"--name names one recording, but {len(recordings)} were found")
        recordings[0].name = options.name
    _check_names(recordings)
    describers: dict[object, Describer] = {}
    summaries: list[IngestSummary] = []
    with open_store(settings.database_url, create=True) as store:
        for recording in recordings:
            map_models = map_models_of(store, options.map_name or default_map_name(recording))
            specs = specs_for_ingest(settings, map_models, has_masks=recording.categories is not None)
            for note in (*recording.notes, *specs.notes):
                (say or _nobody)(f"{recording.name}: {note}")
            own = settings_of_map(settings, map_models)
            key = (specs, own.score_threshold, own.max_keypoints, own.classes, own.dynamic)
            if key not in describers:
                describers[key] = describer_from_specs(specs.detector, specs.encoder, specs.features, own)
            summary = ingest_recording(recording, store, describers[key], options, progress=progress)
            summary.notes = (*recording.notes, *specs.notes)
            summaries.append(summary)
    return summaries


def ingest_recording(
    recording: Recording,
    store: Store,
    describer: Describer,
    options: IngestOptions,
    *,
    progress: Progress | None = None,
    entries: Sequence[FrameEntry] | None = None,
) -> IngestSummary:
    """Ingests one open recording. Frames that cannot be read are `failed` with their reason; the rest goes on.

    `entries` are the keyframes where the caller has selected them.
    """
    map_name = options.map_name or default_map_name(recording)
    check_models(map_models_of(store, map_name), describer.models, f"the map {map_name!r}")
    started = time.perf_counter()
    if entries is None:
        entries = _planned_entries(recording, store, map_name, options, progress)
    selected = time.perf_counter()
    plan = _plan(recording, store, map_name, describer, entries)
    summary = IngestSummary(
        map_name=map_name,
        recording=recording.name,
        recording_id=plan.recording_id,
        total_frames=recording.total_frames,
        usable_frames=len(recording.entries) - len(recording.decode_failures),
        planned=len(entries),
        already_stored=len(plan.stored),
        models=describer.models,
        dropped=(*recording.dropped, *recording.decode_failures),
    )
    summary.seconds = {
        "select": selected - started,
        "read": 0.0,
        "detect": 0.0,
        "encode": 0.0,
        "features": 0.0,
        "store": 0.0,
    }
    pending = set(plan.pending)
    todo = [entry for entry in entries if entry.index in pending]
    for done, (entry, result, seconds) in enumerate(_read_ahead(recording, todo), start=1):
        summary.seconds["read"] += seconds
        if isinstance(result, FrameError):
            _fail(summary, store, entry, result)
        else:
            _describe_and_store(summary, store, describer, result)
        if progress is not None:
            progress(f"ingesting {recording.name}", done, len(todo))
    store.finish_recording(plan.recording_id)
    summary.seconds["total"] = time.perf_counter() - selected
    return summary


def default_map_name(recording: Recording) -> str:
    """The map of a recording nobody named one for: its own, since only people know which recordings share a frame.

    The sequences of one 7-Scenes scene do share one: they go into the map of the scene's folder.
    """
    folder = recording.path.resolve()
    if recording.format == "seven_scenes" and folder.name.startswith("seq-"):
        return folder.parent.name
    return recording.name


def map_models_of(store: Store, map_name: str) -> tuple[ModelInfo, ...]:
    """The models that describe a map; empty for one that is empty or not there."""
    for known in store.maps():
        if known.name == map_name:
            return store.map_models(known.id)
    return ()


def fingerprint(recording: Recording, keyframes: Sequence[FrameEntry]) -> str:
    """SHA-256 over format, camera and the keyframes' names, times and poses: tells recordings of one name apart.

    Other frames are not in it, so a recording whose broken files were mended is still the same one.
    """
    digest = hashlib.sha256(f"{recording.format}|{recording.camera}|{recording.depth_scale}".encode())
    for entry in keyframes:
        digest.update(f"|{entry.index}|{entry.name}|{entry.timestamp_ns}".encode())
        if entry.world_from_camera is not None:
            digest.update(entry.world_from_camera.astype("<f8").tobytes())
    return digest.hexdigest()


def _planned_entries(
    recording: Recording, store: Store, map_name: str, options: IngestOptions, progress: Progress | None
) -> list[FrameEntry]:
    """The keyframes to be: those of the stored plan where one is being resumed, else a new selection."""
    if options.keyframes is None and options.stride is None:
        stored = store.planned_frames(map_name, recording.name)
        if stored:
            known = {entry.index: entry for entry in recording.entries}
            missing = [index for index in stored if index not in known]
            if not missing:
                return [known[index] for index in stored]

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(f"selecting keyframes of {recording.name}", done, total)

    return select_keyframes(recording, count=options.keyframes, stride=options.stride, progress=report)


def _plan(
    recording: Recording, store: Store, map_name: str, describer: Describer, entries: Sequence[FrameEntry]
) -> PlannedRecording:
    plan = RecordingPlan(
        name=recording.name,
        format=recording.format,
        source=str(recording.path.absolute()),
        frame_count=recording.total_frames,
        fingerprint=fingerprint(recording, entries),
        frame_indexes=tuple(entry.index for entry in entries),
    )
    return store.plan_recording(store.ensure_map(map_name), plan, describer.models)


def _read_ahead(
    recording: Recording, entries: Sequence[FrameEntry]
) -> Iterator[tuple[FrameEntry, Frame | FrameError, float]]:
    """Frames in order, the next one decoding in a thread while this one is described."""

    def read(entry: FrameEntry) -> tuple[FrameEntry, Frame | FrameError, float]:
        started = time.perf_counter()
        try:
            result: Frame | FrameError = recording.read(entry)
        except FrameError as error:
            result = error
        return entry, result, time.perf_counter() - started

    with ThreadPoolExecutor(1, thread_name_prefix="semdb-read") as pool:
        following = [pool.submit(read, entry) for entry in entries[:2]]
        for position in range(len(entries)):
            current = following.pop(0).result()
            if position + 2 < len(entries):
                following.append(pool.submit(read, entries[position + 2]))
            yield current


def _describe_and_store(summary: IngestSummary, store: Store, describer: Describer, frame: Frame) -> None:
    if frame.world_from_camera is None:
        raise UsageError(f"{frame.name} has no pose, so it cannot be a keyframe")
    description = describer.describe(frame.image, frame.depth, frame.camera, frame.instances)
    for stage, milliseconds in description.timing_ms.items():
        summary.seconds[stage] += milliseconds / 1000
    started = time.perf_counter()
    record = KeyframeRecord(
        frame_index=frame.index,
        timestamp_ns=frame.timestamp_ns,
        camera=frame.camera,
        world_from_camera=frame.world_from_camera,
        image_bytes=frame.image_bytes,
        depth_bytes=frame.depth_bytes,
        depth_scale=frame.depth_scale,
        depth_registration=frame.depth_registration,
        description=description,
    )
    result = store.write_keyframe(summary.recording_id, record)
    summary.seconds["store"] += time.perf_counter() - started
    summary.stored += int(result.created)
    summary.objects += len(description.detections)
    summary.keypoints += len(description.keypoints)


def _fail(summary: IngestSummary, store: Store, entry: FrameEntry, error: FrameError) -> None:
    summary.failed[entry.index] = str(error)
    store.fail_item(summary.recording_id, entry.index, str(error))


def _check_names(recordings: Sequence[Recording]) -> None:
    seen: dict[str, Path] = {}
    for recording in recordings:
        if recording.name in seen:
            raise UsageError(
                f"{recording.path} and {seen[recording.name]} are both named {recording.name!r}: "
                "ingest them one by one with --name"
            )
        seen[recording.name] = recording.path


def _nobody(_line: str) -> None:
    """Nobody listens."""
