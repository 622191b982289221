"""Runs evaluations: keyframes into a database of its own, the other frames as queries, one result per method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from semdb.database.store import Store
from semdb.errors import SemdbError, UsageError
from semdb.evaluation.colmap import load_pycolmap
from semdb.evaluation.methods import COLMAP, SEMDB, Method, method_named
from semdb.evaluation.metrics import EvaluationResult, QueryResult, summarise, with_other_truth
from semdb.evaluation.protocols import PAPER, PROTOCOLS, evenly_spaced
from semdb.evaluation.regression import PoseTraining, check_torch
from semdb.evaluation.runs import Described, Describers, Run, open_run, read_frames
from semdb.evaluation.splits import folder_plan, paper_plans, scene_plan, tell_apart
from semdb.evaluation.tasks import GIVEN, REFINED, Plan, Task, refine_truth
from semdb.evaluation.workspace import evaluation_store
from semdb.evaluation.worst import PackedDetection, Shown, draw_worst
from semdb.localization.images import check_coarse
from semdb.perception.model_choice import specs_for_ingest
from semdb.recordings.base import Recording
from semdb.recordings.options import AS_THE_FORMAT_SAYS, ReadOptions
from semdb.settings import Settings
from semdb.types import Camera, Tolerance

BOTH = "both"
TRUTHS = (GIVEN, REFINED, BOTH)

Progress = Callable[[str, int, int], None]
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """`query_depth` gives the queries of every method their depth images; otherwise a query is one colour image.

    Without `refine` the map stays as ingest makes it. `keyframes` are numbers to run one by one, None for what the
    protocol chooses. `map_from` and `query_from` are folders for protocol `split`. Poses within `accept` are one.
    `truth` is ``given``, ``refined`` or ``both``. `pictures` is how many of the worst queries are drawn.
    `training` is how networks that regress poses are made.
    """

    methods: tuple[str, ...] = (SEMDB,)
    keyframes: tuple[int | None, ...] = (None,)
    max_queries: int | None = None
    coarse: str = "sql"
    accept: Tolerance | None = None
    camera: Camera | None = None
    reading: ReadOptions = AS_THE_FORMAT_SAYS
    query_depth: bool = False
    refine: bool = True
    protocol: str = PAPER
    map_from: tuple[Path, ...] = ()
    query_from: tuple[Path, ...] = ()
    truth: str = GIVEN
    pictures: int = 0
    training: PoseTraining = field(default_factory=PoseTraining)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one recording (or scene) and number of keyframes: its results, or why there are none."""

    name: str
    results: tuple[EvaluationResult, ...] = ()
    error: SemdbError | None = None


def evaluate(
    paths: Sequence[Path],
    settings: Settings,
    options: EvaluateOptions | None = None,
    *,
    progress: Progress | None = None,
    say: Say | None = None,
) -> list[EvaluationResult]:
    """All results of `evaluate_each`; the first failure is raised."""
    results: list[EvaluationResult] = []
    for outcome in evaluate_each(paths, settings, options, progress=progress, say=say):
        if outcome.error is not None:
            raise outcome.error
        results += outcome.results
    return results


def evaluate_each(
    paths: Sequence[Path],
    settings: Settings,
    options: EvaluateOptions | None = None,
    *,
    progress: Progress | None = None,
    say: Say | None = None,
) -> Iterator[Outcome]:
    """One outcome per recording or scene and number of keyframes, as soon as it is there; a recording named twice once.

    What is wrong with one recording is the `error` of its outcome, and the others go on. Raises UsageError for what
    is wrong with the options, and ModelError where a method needs what is not installed, before anything runs.
    """
    options = options or EvaluateOptions()
    methods = check_options(paths, options)
    plans = []
    for name, opening in _openings(paths, options):
        try:
            plans += opening()
        except SemdbError as error:
            yield Outcome(name, error=error)
    for plan in tell_apart(plans):
        for keyframes in options.keyframes:
            try:
                results = _evaluate_plan(plan, keyframes, methods, settings, options, progress, say)
            except SemdbError as error:
                yield Outcome(plan.name, error=error)
            else:
                yield Outcome(plan.name, tuple(results))


def check_options(paths: Sequence[Path], options: EvaluateOptions) -> list[Method]:
    """The methods. Raises UsageError or ModelError for what could not work in the end."""
    methods = [method_named(name) for name in dict.fromkeys(options.methods)]
    check_coarse(options.coarse)
    for name, value, known in (("protocol", options.protocol, PROTOCOLS), ("truth", options.truth, TRUTHS)):
        if value not in known:
            raise UsageError(f"--{name} {value}: known are {', '.join(known)}")
    if options.max_queries is not None:
        evenly_spaced(0, options.max_queries)  # says now what would be wrong with it later
    for count in options.keyframes:
        if count is not None and count < 1:
            raise UsageError(f"--keyframes {count}: at least one keyframe is needed")
    if options.truth != GIVEN or any(method.name == COLMAP for method in methods):
        load_pycolmap()
    for method in methods:
        check_torch(method)
    by_name = options.map_from or options.query_from
    if by_name and paths:
        raise UsageError("give either folders to evaluate one by one, or --map-from and --query-from, not both")
    if not by_name and not paths:
        raise UsageError("name the folder of a recording, or --map-from FOLDER and --query-from FOLDER")
    if by_name and not (options.map_from and options.query_from):
        present, absent = ("--map-from", "--query-from") if options.map_from else ("--query-from", "--map-from")
        raise UsageError(f"{present} needs {absent} too: the one makes the map, the other is asked about")
    return methods


def _openings(paths: Sequence[Path], options: EvaluateOptions) -> list[tuple[str, Callable[[], list[Plan]]]]:
    """What is to be opened, by name; opening may fail for each."""
    camera, reading = options.camera, options.reading
    if options.map_from or options.query_from:
        name = ", ".join(str(path) for path in (*options.map_from, *options.query_from))
        return [(name, lambda: [folder_plan(options.map_from, options.query_from, camera, options.reading)])]
    if options.protocol == PAPER:
        return [(str(path), lambda path=path: paper_plans(path, camera, reading)) for path in paths]  # type: ignore[misc]
    return [(str(path), lambda path=path: [scene_plan(path, camera, reading)]) for path in paths]  # type: ignore[misc]


def _evaluate_plan(
    plan: Plan,
    keyframes: int | None,
    methods: Sequence[Method],
    settings: Settings,
    options: EvaluateOptions,
    progress: Progress | None,
    say: Say | None,
) -> list[EvaluationResult]:
    has_masks = all(recording.categories is not None for recording in plan.recordings)
    specs = specs_for_ingest(settings, (), has_masks=has_masks)
    notes = [f"{recording.name}: {note}" for recording in plan.recordings for note in recording.said]
    for line in dict.fromkeys((*notes, *(f"{plan.name}: {note}" for note in specs.notes))):
        if say is not None:
            say(line)
    describers = Describers(specs.detector, specs.encoder, specs.features, settings)
    results = []
    with evaluation_store(settings.database_url, say=say) as store:  # first: it may not answer, and choosing takes long
        task = plan.choose(keyframes, options.max_queries, progress, say)
        tasks = [task]
        if options.truth != GIVEN:
            tasks = refine_truth(task, both=options.truth == BOTH, progress=progress)
        runs = [_open(method, tasks[0], describers, store, options, progress) for method in methods]
        results += _answer(tasks[0], runs, options, progress)
    for other in tasks[1:]:
        with evaluation_store(settings.database_url) as store:
            runs = [_open(method, other, describers, store, options, progress) for method in methods]
            results += _answer(other, runs, options, progress)
    for recording in plan.recordings:
        for line in _unusable(recording):
            if say is not None:
                say(line)
    return results


def _open(
    method: Method,
    task: Task,
    describers: Describers,
    store: Store,
    options: EvaluateOptions,
    progress: Progress | None,
) -> Run:
    return open_run(
        *(method, task, describers, store, options.coarse, options.query_depth, progress, options.accept),
        refine=options.refine,
        training=options.training,
    )


def _answer(
    task: Task, runs: Sequence[Run], options: EvaluateOptions, progress: Progress | None
) -> list[EvaluationResult]:
    """All queries of `task` to all `runs`."""
    answers: list[list[QueryResult]] = [[] for _ in runs]
    shown: list[dict[tuple[str, int], Shown]] = [{} for _ in runs]
    objects: dict[tuple[str, int], list[PackedDetection]] = {}
    label = f"localizing in {task.name}" + (" with refined poses" if task.truth == REFINED else "")
    for done, (name, frame, decode_ms) in enumerate(read_frames(task.queries, task.map_cameras), start=1):
        described: Described = {}
        key = name, frame.index
        for run, found, kept in zip(runs, answers, shown, strict=True):
            query, localization = run.answer(name, frame, decode_ms, described)
            found.append(with_other_truth(query, task.other_truth.get(key)))
            if options.pictures:
                kept[key] = Shown.of(localization)
        if options.pictures and described:
            description = next(iter(described.values()))[0]
            objects[key] = [PackedDetection.of(thing) for thing in description.detections]
        if progress is not None:
            progress(label, done, task.query_count)
    results = [_result(task, run, found, options) for run, found in zip(runs, answers, strict=True)]
    if not options.pictures:
        return results
    drawn = []
    for done, (result, run, kept) in enumerate(zip(results, runs, shown, strict=True), start=1):
        pictures = draw_worst(result, task, run, kept, objects, options.pictures)
        drawn.append(replace(result, pictures=pictures))
        if progress is not None:
            progress(f"drawing queries of {task.name}", done * options.pictures, len(runs) * options.pictures)
    return drawn


def _result(task: Task, run: Run, found: Sequence[QueryResult], options: EvaluateOptions) -> EvaluationResult:
    result = summarise(
        found,
        recording=task.name,
        protocol=task.protocol,
        method=run.method.name,
        models=run.models,
        frames=task.frames,
        keyframes=len(run.poses),
    )
    return replace(
        result,
        sequence=task.sequence,
        keyframes_asked=task.keyframes_asked,
        query_depth=options.query_depth or run.method.query_depth,
        map_recordings=tuple(part.recording.name for part in task.keyframes),
        query_recordings=tuple(part.recording.name for part in task.queries),
        truth=task.truth,
        disagreement=task.disagreement,
        training_frames=run.training_frames,
    )


def _unusable(recording: Recording) -> list[str]:
    """A line about the frames that were neither keyframe nor query, none where all were fit for it."""
    unusable = (*recording.dropped, *recording.decode_failures)
    if not unusable:
        return []
    return [
        f"{recording.name}: {len(unusable)} of {recording.total_frames} frames could not be used, the first "
        f"{unusable[0].name}: {unusable[0].reason} (semdb recording {recording.path} names all)"
    ]
