"""A method made ready on the keyframes of a task: it answers queries and ranks keyframes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from semdb.database.records import MapInfo, RowOptions
from semdb.database.store import Store
from semdb.errors import FrameError, RecordingError, UsageError
from semdb.evaluation.baselines import SiftReference, nearest_in_pose
from semdb.evaluation.colmap_method import ColmapReference
from semdb.evaluation.failures import sharpness
from semdb.evaluation.methods import COLMAP, ORACLE, SEMDB_FRAMES, SIFT_REFERENCE, TRIVIAL, Method
from semdb.evaluation.metrics import QueryResult, query_result, with_reach
from semdb.evaluation.regression import (
    FIXED,
    NEAR,
    PoseTraining,
    TrainedNetwork,
    always,
    fixed_pose,
    keyframe_poses,
    near_queries,
    regressed,
    trained_network,
)
from semdb.evaluation.retrieval import FIRST, reach
from semdb.evaluation.tasks import REFINED, Part, Task
from semdb.ingestion.frames import add_frames
from semdb.ingestion.run import IngestOptions, ingest_recording
from semdb.localization.images import fallback_of, make_localizer, with_matcher
from semdb.localization.localizer import Localizer
from semdb.localization.query_image import frame_at_scale
from semdb.perception.describe import Describer, describer_from_specs
from semdb.refinement.run import refine_map
from semdb.refinement.steps import FOR_LOCALIZATION, LANDMARKS
from semdb.settings import Settings
from semdb.types import Camera, Description, Detection, FloatArray, Frame, Localization, ModelInfo, Tolerance

Progress = Callable[[str, int, int], None]
Described = dict[tuple[int, bool], tuple[Description, float]]  # by describer and whether depth was given


class Describers:
    """One describer per kind of features, sharing the networks."""

    def __init__(self, detector: str, encoder: str, features: str, settings: Settings) -> None:
        self._default = features
        self.encoder = encoder
        self.settings = settings
        self._made = {features: describer_from_specs(detector, encoder, features, settings)}

    def of(self, method: Method) -> Describer:
        name = method.features or self._default
        if name not in self._made:
            from semdb.perception.features import load_features

            first = self._made[self._default]
            self._made[name] = Describer(
                first.detector, first.encoder, load_features(name, self.settings), first.rules, first.batch
            )
        return self._made[name]


def read_frames(parts: Sequence[Part], known: Sequence[Camera] = ()) -> Iterator[tuple[str, Frame, float]]:
    """Name of the recording, frame, decoding time in ms; what cannot be decoded is in `recording.decode_failures`.

    Frames that are larger than the images of the cameras `known` come at their scale, as queries of `semdb localize`.
    """
    for part in parts:
        for entry in part.entries:
            started = time.perf_counter()
            try:
                frame = frame_at_scale(part.recording.read(entry), known)
            except FrameError as error:
                part.recording.note_decode_failure(entry, error)
                continue
            yield part.recording.name, frame, (time.perf_counter() - started) * 1000


class Run:
    """A method, ready to answer. `poses` ``[n, 4, 4]`` are those of its keyframes: the frames that could be read."""

    retrieves = True
    training_frames: int | None = None

    def __init__(self, method: Method, models: tuple[ModelInfo, ...], poses: FloatArray) -> None:
        self.method = method
        self.models = models
        self.poses = poses

    def answer(
        self, recording: str, frame: Frame, decode_ms: float, described: Described
    ) -> tuple[QueryResult, Localization]:
        """The result for one frame. `described` shares descriptions between the methods of one query."""
        localization, timing = self.localize(frame, described, recording)
        timing = {"decode": decode_ms, **timing, **localization.timing_ms}
        timing["total"] = decode_ms + timing.pop("describe") + timing.pop("localize")
        result = query_result(
            frame.name,
            frame.index,
            localization,
            frame.world_from_camera,
            timing_ms=timing,
            recording=recording,
            timestamp_ns=frame.timestamp_ns,
        )
        result = replace(result, sharpness=sharpness(frame.image))
        if frame.world_from_camera is not None and len(self.poses):
            order = self.order(frame, localization, described) if self.retrieves else None
            found = reach(frame.world_from_camera, self.poses, order)
            result = with_reach(result, found, retrieves=self.retrieves)
        return result, localization

    def localize(
        self, frame: Frame, described: Described, recording: str = ""
    ) -> tuple[Localization, dict[str, float]]:
        """The answer, and wall times; `describe` and `localize` among them, which are whole."""
        raise TypeError(f"{type(self).__name__} answers nothing")

    def order(self, frame: Frame, localization: Localization, described: Described) -> list[int]:
        """Positions of the first ten keyframes in the order in which the method would ask them."""
        raise TypeError(f"{type(self).__name__} does not retrieve")

    def position_of(self, keyframe_id: int | None) -> int | None:
        """Where a keyframe that a localization names stands in `poses`."""
        return keyframe_id

    def keyframe(self, position: int) -> tuple[str, int, tuple[Detection, ...]]:
        """Recording, frame index and objects of the keyframe at a position, for pictures."""
        raise TypeError(f"{type(self).__name__} has no keyframes")


class LocalizerRun(Run):
    """The methods that are a `Localizer` with other options. `query_depth` gives queries their depth images."""

    def __init__(
        self, method: Method, describer: Describer, localizer: Localizer, query_depth: bool, store: Store | None = None
    ) -> None:
        self._ids, poses = localizer.cache.poses()
        super().__init__(method, describer.models, poses)
        self._describer = describer
        self._localizer = localizer
        self._query_depth = query_depth
        self._store = store

    def describe(self, frame: Frame, described: Described) -> tuple[Description, dict[str, float]]:
        key = id(self._describer), self._query_depth
        if key not in described:
            started = time.perf_counter()
            depth = frame.depth if self._query_depth else None
            description = self._describer.describe(frame.image, depth, frame.camera, frame.instances)
            described[key] = description, (time.perf_counter() - started) * 1000
        description, milliseconds = described[key]
        return description, {"describe": milliseconds, **description.timing_ms}

    def localize(
        self, frame: Frame, described: Described, recording: str = ""
    ) -> tuple[Localization, dict[str, float]]:
        description, timing = self.describe(frame, described)
        started = time.perf_counter()
        found = self._localizer.localize(description)
        return found, {**timing, "localize": (time.perf_counter() - started) * 1000}

    def order(self, frame: Frame, localization: Localization, described: Described) -> list[int]:
        description, _ = self.describe(frame, described)
        ids = [proposal.keyframe_id for proposal in self._localizer.retrieve(description, max(FIRST))]
        position = {keyframe_id: at for at, keyframe_id in enumerate(self._ids)}
        return [position[keyframe_id] for keyframe_id in ids if keyframe_id in position]

    def position_of(self, keyframe_id: int | None) -> int | None:
        return self._ids.index(keyframe_id) if keyframe_id in self._ids else None

    def keyframe(self, position: int) -> tuple[str, int, tuple[Detection, ...]]:
        if self._store is None:
            return super().keyframe(position)
        stored = self._store.load_keyframes([self._ids[position]], descriptors=False)[0]
        masks = self._store.load_masks(stored.id)
        things = tuple(
            Detection(thing.category, thing.score, thing.box, mask)
            for thing, mask in zip(stored.objects, masks, strict=True)
        )
        return stored.recording, stored.frame_index, things


class OracleRun(LocalizerRun):
    """Told the true pose, to choose keyframes by."""

    retrieves = False

    def localize(
        self, frame: Frame, described: Described, recording: str = ""
    ) -> tuple[Localization, dict[str, float]]:
        if frame.world_from_camera is None:
            raise FrameError(f"{frame.name}: oracle chooses keyframes by the true pose, and there is none")
        description, timing = self.describe(frame, described)
        chosen = [self._ids[position] for position in nearest_in_pose(frame.world_from_camera, self.poses)]
        started = time.perf_counter()
        found = self._localizer.localize_among(description, chosen)
        return found, {**timing, "localize": (time.perf_counter() - started) * 1000}


class ReferenceRun(Run):
    """The methods without a database: `sift-reference` and `colmap`."""

    def __init__(self, method: Method, reference: SiftReference | ColmapReference) -> None:
        super().__init__(method, reference.models, reference.poses)
        self.retrieves = isinstance(reference, ColmapReference)
        self._reference = reference

    def localize(
        self, frame: Frame, described: Described, recording: str = ""
    ) -> tuple[Localization, dict[str, float]]:
        found = self._reference.localize(frame)
        features = found.timing_ms["features"]
        return found, {"describe": features, "localize": found.timing_ms["total"] - features}

    def order(self, frame: Frame, localization: Localization, described: Described) -> list[int]:
        return [candidate.keyframe_id for candidate in localization.candidates[: max(FIRST)]]

    def keyframe(self, position: int) -> tuple[str, int, tuple[Detection, ...]]:
        return *self._reference.names[position], ()


class UnmatchedRun(Run):
    """The methods that look for no keyframe; pictures show the nearest one all the same."""

    retrieves = False

    def __init__(self, method: Method, models: tuple[ModelInfo, ...], task: Task) -> None:
        super().__init__(method, models, keyframe_poses(task))
        self._names = [(part.recording.name, entry.index) for part in task.keyframes for entry in part.entries]

    def keyframe(self, position: int) -> tuple[str, int, tuple[Detection, ...]]:
        return *self._names[position], ()


class FixedRun(UnmatchedRun):
    """The methods that give one pose to whatever is asked."""

    def __init__(self, method: Method, task: Task) -> None:
        super().__init__(method, (), task)
        self._pose = fixed_pose(method, self.poses)

    def localize(
        self, frame: Frame, described: Described, recording: str = ""
    ) -> tuple[Localization, dict[str, float]]:
        return always(self._pose, FIXED, "the same for every query", 0.0), {"describe": 0.0, "localize": 0.0}


class NetworkRun(UnmatchedRun):
    """The methods that regress a pose."""

    def __init__(self, method: Method, network: TrainedNetwork, task: Task) -> None:
        super().__init__(method, network.models, task)
        self._network = network
        self.training_frames = network.frames

    def localize(
        self, frame: Frame, described: Described, recording: str = ""
    ) -> tuple[Localization, dict[str, float]]:
        found, described_ms = regressed(self._network, recording, frame)
        return found, {"describe": described_ms, "encode": described_ms, "localize": found.timing_ms["total"]}


def open_run(
    method: Method,
    task: Task,
    describers: Describers,
    store: Store,
    coarse: str,
    query_depth: bool,
    progress: Progress | None,
    accept: Tolerance | None = None,
    *,
    refine: bool = True,
    training: PoseTraining | None = None,
) -> Run:
    """The method on the keyframes of `task`, which go into `store` unless another method brought them there."""
    if method.name in TRIVIAL:
        return FixedRun(method, task)
    if method.network is not None:
        own = describers.encoder, describers.settings
        network = trained_network(method, task, training or PoseTraining(), *own, progress)
        return NetworkRun(method, network, task)
    if method.name in (SIFT_REFERENCE, COLMAP):
        frames = [name_and_frame[:2] for name_and_frame in read_frames(task.keyframes)]
        if not frames:
            raise RecordingError(f"{task.name}: no keyframe can be read")
        if method.name == COLMAP:

            def tell(what: str, done: int, total: int) -> None:
                if progress is not None:
                    progress(f"colmap: {what} of {task.name}", done, total)

            return ReferenceRun(method, ColmapReference(frames, progress=tell))
        return ReferenceRun(method, SiftReference(frames))
    describer = describers.of(method)
    map_name = describer.features.info.name  # one map per kind of features: rows of two kinds do not mix
    if all(info.name != map_name for info in store.maps()):
        rows = RowOptions(describers.settings.descriptor_dtype, describers.settings.keep_images)
        _fill(IngestOptions(map_name=map_name, rows=rows), task, describer, store, progress)
        if refine:
            kinds = (*FOR_LOCALIZATION, LANDMARKS)
            refine_map(store, store.find_map(map_name), kinds=kinds, progress=progress)
    options = replace(method.options.with_threads(describers.settings.threads), accept=accept)
    info = store.find_map(map_name)
    if method.frames:
        _add_frames(info, task, describer, store, progress)
    else:
        options = replace(options, frames=0)
    if method.features is None:  # those that name their feature name their matching too
        options = with_matcher(options, describers.settings, store.map_models(info.id))
    fallback = fallback_of(describers.settings, store.map_models(info.id)) if options.fallback else None
    localizer = make_localizer(store, info, coarse, options, fallback=fallback)
    run = OracleRun if method.name.startswith(ORACLE) else LocalizerRun
    return run(method, describer, localizer, query_depth or method.query_depth, store)


def _add_frames(info: MapInfo, task: Task, describer: Describer, store: Store, progress: Progress | None) -> None:
    """Frames beside the keyframes, but for queries and the two on each side of them. Raises UsageError."""
    if task.truth == REFINED:
        raise UsageError(f"{SEMDB_FRAMES} needs --truth given: only keyframes and queries have refined poses")
    free = 0
    for part in task.keyframes:
        near = near_queries(task, part.recording)
        free += len({e.index for e in part.recording.entries} - near - {e.index for e in part.entries})
        add_frames(store, info, part.recording, describer, without=near, progress=progress)
    if not free:
        raise UsageError(
            f"{task.name}: every frame is a keyframe, a query or within {NEAR} frames of one, so {SEMDB_FRAMES} "
            "has none to add: ask fewer with --max-queries"
        )


def _fill(options: IngestOptions, task: Task, describer: Describer, store: Store, progress: Progress | None) -> None:
    """Keyframes into the map."""
    for part in task.keyframes:
        summary = ingest_recording(
            part.recording, store, describer, options, progress=progress, entries=list(part.entries)
        )
        for entry in part.entries:
            if entry.index in summary.failed:
                part.recording.note_decode_failure(entry, FrameError(summary.failed[entry.index]))
