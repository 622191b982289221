"""The pipeline from a recording to rows: select keyframes, plan, describe, store. Called by the CLI and the workers.

The plan is written before the first keyframe, each keyframe with all its children in one transaction, so a run
that is cut off anywhere is finished by running it again. `semdb.ingestion.work` does the work that is planned.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from semdb.database import items
from semdb.database.findings import write_findings
from semdb.database.ids import check_name
from semdb.database.planning import check_models
from semdb.database.records import PlannedRecording, RecordingFinding, RecordingPlan, RowOptions
from semdb.database.requeue import requeue_failed
from semdb.database.store import Store, open_store
from semdb.errors import UsageError
from semdb.ingestion.contradictions import check_before_ingest
from semdb.ingestion.estimation import AUTO, Posed, posed
from semdb.ingestion.plan import Choice, choose_keyframes, fingerprint
from semdb.ingestion.work import STAGES, Item, log_item, work_off
from semdb.names import storable
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.model_choice import ModelSpecs, settings_of_map, specs_for_ingest
from semdb.recordings import parse_camera
from semdb.recordings.base import DroppedFrame, FrameEntry, Recording
from semdb.recordings.focus import watched
from semdb.recordings.options import AS_THE_FORMAT_SAYS, ReadOptions
from semdb.recordings.source import locate, open_located, write_source
from semdb.refinement.error_step import measure_recording
from semdb.settings import Settings
from semdb.types import ModelInfo

if TYPE_CHECKING:
    from semdb.refinement.align_report import AlignReport

Progress = Callable[[str, int, int], None]  # what, done, total
Describers = dict[object, list[Describer]]  # by all that makes them what they are
MOST_DESCRIBERS = 4  # each holds networks of its own
AS_RECORDED = RowOptions()
SECONDS_BETWEEN_LOOKS = 0.5  # at what other workers still have


@dataclass(frozen=True, slots=True)
class IngestOptions:
    """`keyframes` and `stride` as in `ingestion.keyframes.select_keyframes`; `name` overrides the recording's own.

    `map_name` None gives each recording the map of `default_map_name`. `camera` is the text of ``--camera``,
    `reading` says of the files what they do not say, `check` whether that is compared with the images first;
    `rows` is how rows are stored. `poses` are ``recorded``, ``estimated``, or ``auto``:
    recorded where there are some. `like` names a map whose models describe a map that has none yet.
    """

    map_name: str | None = None
    name: str | None = None
    keyframes: int | None = None
    stride: int | None = None
    camera: str | None = None
    reading: ReadOptions = AS_THE_FORMAT_SAYS
    check: bool = True
    rows: RowOptions = AS_RECORDED
    poses: str = AUTO
    like: str | None = None

    def map_of(self, recording: Recording) -> str:
        """The map that `recording` goes into."""
        return storable(default_map_name(recording) if self.map_name is None else self.map_name)


@dataclass(slots=True)
class IngestSummary:
    """What became of one recording. `elsewhere` counts keyframes that other processes stored meanwhile.

    `blank` are frames that were stored without a keypoint: nothing can be matched with them.

    `seconds` are the wall times of stages, summed over keyframes: stages overlap, so they are more than the `total`.
    Networks' time is in detect and encode.
    """

    map_name: str
    recording: str
    recording_id: int
    total_frames: int
    usable_frames: int
    planned: int
    already_stored: int
    models: tuple[ModelInfo, ...]
    pose_source: str = "recorded"
    alignment: AlignReport | None = None  # where it was to be found in another map
    stored: int = 0
    elsewhere: int = 0
    objects: int = 0
    keypoints: int = 0
    blank: list[int] = field(default_factory=list)
    failed: dict[int, str] = field(default_factory=dict)
    dropped: tuple[DroppedFrame, ...] = ()
    remarks: list[DroppedFrame] = field(default_factory=list)  # keyframes that show next to nothing
    notes: tuple[str, ...] = ()
    findings: tuple[RecordingFinding, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


def ingest_recordings(
    paths: Sequence[Path | str],
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
    recordings = open_all(paths, settings, options, progress)
    with open_store(settings.database_url, create=True) as store:
        return ingest_opened(recordings, store, settings, options, progress=progress, say=say)


def ingest_opened(
    recordings: Sequence[Recording],
    store: Store,
    settings: Settings,
    options: IngestOptions,
    *,
    describers: Describers | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> list[IngestSummary]:
    """Ingests open recordings into `store`; one summary each, in order. Raises what `ingest_recordings` raises.

    `describers` keeps networks for the next call, which must not be made meanwhile.
    """
    options = replace(options, rows=RowOptions(settings.descriptor_dtype, settings.keep_images))
    describers = {} if describers is None else describers
    summaries: list[IngestSummary] = []
    for recording in recordings:
        has_masks = recording.categories is not None
        of_map = options.map_of(recording)
        if options.like is not None and not map_models_of(store, of_map):
            of_map = options.like
        specs, own = describers_for(of_map, has_masks, store, settings, describers)
        for note in (*recording.said, *specs.notes):
            (say or _nobody)(f"{recording.name}: {note}")
        known = posed(recording, store, options.map_of(recording), options.poses, progress=progress, say=say)
        warnings = look_first(known.recording, store, settings, options, progress, say)
        summary = ingest_recording(known, store, own, options, progress=progress)
        summary.notes = (*recording.said, *specs.notes)
        keep_findings(store, summary, warnings)
        summaries.append(summary)
    return summaries


def describers_for(
    map_name: str, has_masks: bool, store: Store, settings: Settings, known: Describers
) -> tuple[ModelSpecs, list[Describer]]:
    """What describes a recording of a map, from `known` where it is there, which it is added to.

    Raises UsageError where no detector is at hand, ModelError.
    """
    map_models = map_models_of(store, map_name)
    specs = specs_for_ingest(settings, map_models, has_masks=has_masks)
    own = settings_of_map(settings, map_models)
    key = (specs, own.encoder_crop, own.score_threshold, own.max_keypoints, own.classes, own.dynamic)
    if key not in known:
        known[key] = make_describers(specs, own)
    return specs, known[key]


def look_first(
    recording: Recording,
    store: Store,
    settings: Settings,
    options: IngestOptions,
    progress: Progress | None,
    say: Callable[[str], None] | None,
) -> list[RecordingFinding] | None:
    """What is likely wrong with how a recording is read (said); None where it was not looked at.

    One that is planned already was looked at then. Raises RecordingError for what is certainly wrong.
    """
    if recording.estimated or not (options.check and settings.check_recordings):
        return None
    if store.planned_frames(options.map_of(recording), recording.name):
        return None
    findings = check_before_ingest(recording, progress)
    for finding in findings:
        mend = f"; {finding.option} would mend it" if finding.option else ""
        (say or _nobody)(f"{recording.name}: likely: {finding.message}{mend}")
    return findings


def keep_findings(store: Store, summary: IngestSummary, findings: Sequence[RecordingFinding] | None) -> None:
    """Writes the findings of a recording that was looked at."""
    if findings:
        write_findings(store.engine, summary.recording_id, findings)
        summary.findings = tuple(findings)


def open_all(
    paths: Sequence[Path | str], settings: Settings, options: IngestOptions, progress: Progress | None = None
) -> list[Recording]:
    """Every recording under `paths`, which are folders or URLs, under the names that they will have.

    Raises RecordingError for a path that cannot be used, UsageError where names collide or one name is given to many.
    """
    camera = None if options.camera is None else parse_camera(options.camera)
    recordings = []
    for path in paths:
        with watched(None if progress is None else partial(progress, f"looking at the files of {path}")):
            found = open_located(locate(str(path), settings), settings, camera, options.reading)
        for recording in found:
            below = recording.path.name if recording.path.name != Path(str(path)).name else None
            address = str(path) if below is None else f"{path}/{below}"
            recording.source = write_source(address, options.camera, options.reading)
            recordings.append(recording)
    if options.name is not None:
        if len(recordings) > 1:
            raise UsageError(f"--name names one recording, but {len(recordings)} were found")
        recordings[0].name = storable(options.name)
    _check_names(recordings, options)
    return recordings


def make_describers(specs: ModelSpecs, settings: Settings) -> list[Describer]:
    """Equal describers for as many threads as `settings` allow, which they share: rows do not depend on how many.

    Two networks with one thread each do more in a second than one with two. Raises UsageError, ModelError.
    """
    count = min(settings.threads, MOST_DESCRIBERS)
    own = settings.model_copy(update={"threads": settings.threads // count})
    return [describer_from_specs(specs.detector, specs.encoder, specs.features, own) for _ in range(count)]


def ingest_recording(
    source: Recording | Posed,
    store: Store,
    describer: Describer | Sequence[Describer],
    options: IngestOptions,
    *,
    progress: Progress | None = None,
    entries: Sequence[FrameEntry] | None = None,
) -> IngestSummary:
    """Ingests one open recording. Frames that cannot be read are `failed` with their reason; the rest goes on.

    `entries` are the keyframes where the caller has selected them. Several equal describers work side by side. Other
    processes may ingest the same recording: they share the work, and this one returns when all of it is done.
    """
    describers = (describer,) if isinstance(describer, Describer) else tuple(describer)
    started = time.perf_counter()
    known = source if isinstance(source, Posed) else Posed(source)
    recording = known.recording
    summary, todo = plan_ingest(known, store, describers[0].models, options, progress=progress, entries=entries)
    selected = time.perf_counter()
    summary.seconds = {"select": selected - started, **dict.fromkeys(STAGES, 0.0)}
    requeue_failed(store.engine, summary.recording_id)
    done = 0
    while True:
        for item in work_off(recording, summary.recording_id, store, describers, rows=options.rows):
            _count(summary, item)
            log_item(summary.recording_id, item)
            done += 1
            if progress is not None:
                progress(f"ingesting {recording.name}", min(done, todo), todo)
        left = sum(items.left(store.engine, summary.recording_id))
        if not left:
            break
        if progress is not None and todo:
            progress(f"waiting for other processes at {recording.name}", max(0, todo - left), todo)
        time.sleep(SECONDS_BETWEEN_LOOKS)  # others are still at theirs, or have died: then their leases run out
    if store.finish_recording(summary.recording_id) == "complete":
        measure_recording(store, summary.recording_id, changed=summary.stored > 0)
    summary.failed = {item.frame_index: item.error for item in store.failed_items(summary.recording_id)}
    summary.elsewhere = max(0, todo - summary.stored - len(summary.failed))
    summary.seconds["total"] = time.perf_counter() - selected
    return summary


def plan_ingest(
    source: Recording | Posed,
    store: Store,
    models: tuple[ModelInfo, ...],
    options: IngestOptions,
    *,
    progress: Progress | None = None,
    entries: Sequence[FrameEntry] | None = None,
) -> tuple[IngestSummary, int]:
    """Selects keyframes, unless `entries` are given or a plan is stored, and writes the plan; nothing is described.

    Returns a summary of which nothing is done yet, and how many keyframes are to be done. Raises as
    `Store.plan_recording` does.
    """
    known = source if isinstance(source, Posed) else Posed(source)
    recording = known.recording
    map_name = options.map_of(recording)
    check_models(map_models_of(store, map_name), models, f"the map {map_name!r}")
    if entries is None:
        report = None if progress is None else partial(progress, f"selecting keyframes of {recording.name}")
        choice = choose_keyframes(
            recording, store, map_name, count=options.keyframes, stride=options.stride, progress=report
        )
    else:
        choice = Choice(entries)
    plan = _plan(known, store, map_name, models, choice)
    summary = IngestSummary(
        map_name=map_name,
        recording=recording.name,
        recording_id=plan.recording_id,
        total_frames=recording.total_frames,
        usable_frames=len(recording.entries) - len(recording.decode_failures),
        planned=len(choice.entries),
        already_stored=len(plan.stored),
        models=models,
        pose_source="estimated" if recording.estimated else "recorded",
        dropped=(*recording.dropped, *recording.decode_failures),
    )
    return summary, len(plan.pending)


def _count(summary: IngestSummary, item: Item) -> None:
    for stage, seconds in item.seconds.items():
        summary.seconds[stage] += seconds
    summary.remarks += [DroppedFrame(item.name, remark) for remark in item.remarks]
    if item.created:
        summary.stored += 1
        summary.objects += item.objects
        summary.keypoints += item.keypoints
        if not item.keypoints:
            summary.blank.append(item.claim.frame_index)


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


def _plan(known: Posed, store: Store, map_name: str, models: tuple[ModelInfo, ...], choice: Choice) -> PlannedRecording:
    recording = known.recording
    plan = RecordingPlan(
        name=recording.name,
        format=recording.format,
        source=recording.source or str(recording.path.absolute()),
        frame_count=recording.total_frames,
        fingerprint=fingerprint(recording, choice.entries),
        frame_indexes=tuple(entry.index for entry in choice.entries),
        extends=choice.extends,
        poses=known.planned(choice.entries),
    )
    return store.plan_recording(store.ensure_map(map_name), plan, models)


def _check_names(recordings: Sequence[Recording], options: IngestOptions) -> None:
    """Before anything is computed. Raises UsageError."""
    seen: dict[str, Path] = {}
    for recording in recordings:
        check_name("map", options.map_of(recording))
        check_name("recording", recording.name)
        if recording.name in seen:
            raise UsageError(
                f"{recording.path} and {seen[recording.name]} are both named {recording.name!r}: "
                "ingest them one by one with --name"
            )
        seen[recording.name] = recording.path


def _nobody(_line: str) -> None:
    """Nobody listens."""
