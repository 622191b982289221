"""The methods that regress poses: networks trained in the place, and two answers that look at nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, ModelError, RecordingError, UsageError
from semdb.evaluation.methods import MIDDLE_KEYFRAME, NETWORKS, Method, method_named
from semdb.evaluation.splits import paper_plans
from semdb.evaluation.tasks import REFINED, Part, Task
from semdb.perception.model_choice import specs_for_ingest
from semdb.perception.model_files import canonical_json
from semdb.perception.torch_models import INSTALL, import_torch
from semdb.recordings.base import FrameEntry, Recording
from semdb.settings import Settings
from semdb.training.pose_options import PoseOptions
from semdb.training.pose_targets import mean_pose
from semdb.types import FloatArray, Frame, Localization, ModelInfo, Verdict

if TYPE_CHECKING:
    from semdb.training.pose import PoseData, PoseRegressor
    from semdb.training.pose_inputs import Inputs

REGRESSED, FIXED = "regressed", "fixed"
NEAR = 2  # frames on each side of a query that no network may learn from
_KEPT = 256  # inputs of frames that the next queries may look at, too

Progress = Callable[[str, int, int], None]
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class PoseTraining:
    """How networks that regress poses are trained. `networks` is a folder where finished ones are kept and found."""

    options: PoseOptions = field(default_factory=PoseOptions)
    networks: Path | None = None


def check_torch(method: Method) -> None:
    """Raises ModelError where the method has to learn and torch is not installed."""
    if method.network is None:
        return
    try:
        import_torch()
    except ModelError as error:
        raise ModelError(f"--method {method.name} learns with torch, which cannot be used here: {INSTALL}") from error


def training_parts(task: Task, *, keyframes_only: bool) -> tuple[Part, ...]:
    """The frames that a network may learn from: the map's keyframes, or all that are not near a query.

    Near is the query itself and the two frames on each side of it, keyframes among them. With protocol `split` these
    are all frames of the map's recordings. Raises UsageError where nothing is left, and for refined poses, which only
    keyframes and queries have.
    """
    if keyframes_only:
        return task.keyframes
    if task.truth == REFINED:
        raise UsageError("networks on all frames need --truth given: only keyframes and queries have refined poses")
    parts = []
    for recording in dict.fromkeys(part.recording for part in task.keyframes):
        near = near_queries(task, recording)
        free = [e for e in recording.entries if e.index not in near and e.world_from_camera is not None]
        parts.append(Part(recording, tuple(free)))
    if not any(part.entries for part in parts):
        raise UsageError(
            f"{task.name}: every frame is a query or within {NEAR} frames of one, so there is nothing to train a "
            "network on: ask fewer with --max-queries, or take a method NAME-keyframes"
        )
    return tuple(part for part in parts if part.entries)


def near_queries(task: Task, recording: Recording) -> set[int]:
    """Indexes of the frames of `recording` that are queries, and of the `NEAR` on each side of each."""
    asked = {(part.recording.name, entry.index) for part in task.queries for entry in part.entries}
    entries = recording.entries
    return {
        other.index
        for position, entry in enumerate(entries)
        if (recording.name, entry.index) in asked
        for other in entries[max(0, position - NEAR) : position + NEAR + 1]
    }


class FrameReader:
    """Inputs of a network for frames of recordings, and of those before them, each read once."""

    def __init__(self, recordings: Sequence[Recording], inputs: Inputs, options: PoseOptions) -> None:
        self.inputs, self._options = inputs, options
        self._recordings: Mapping[str, Recording] = {recording.name: recording for recording in recordings}
        self._positions = {
            (recording.name, entry.index): position
            for recording in recordings
            for position, entry in enumerate(recording.entries)
        }
        self._kept: dict[tuple[str, int], npt.NDArray[Any]] = {}

    def window(self, recording: str, index: int) -> list[FrameEntry]:
        """The frame and those before it, oldest first; the first frame stands for what is before a recording."""
        entries, last = self._recordings[recording].entries, self._positions[recording, index]
        return [entries[max(0, position)] for position in range(last - self._options.frames + 1, last + 1)]

    def of(self, recording: str, entry: FrameEntry, frame: Frame | None = None) -> npt.NDArray[Any]:
        """What the network gets for a frame. Raises FrameError where it cannot be decoded."""
        key = recording, entry.index
        if key not in self._kept:
            source = self._recordings[recording]
            image = source.read_image(entry) if frame is None else frame.image
            depth = None
            if self._options.takes_depth:
                depth = source.read_depth(entry) if frame is None else frame.depth
            if len(self._kept) >= _KEPT:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = self.inputs(image, depth)
        return self._kept[key]

    def asked(self, recording: str, frame: Frame) -> npt.NDArray[Any]:
        """``[W, C, h, w]`` for a query: itself last."""
        *before, own = self.window(recording, frame.index)
        last = self.of(recording, own, frame)
        found = []
        for entry in before:
            try:
                found.append(self.of(recording, entry))
            except FrameError:  # a gap in the video: what is next stands in for it
                found.append(last)
        return np.stack([*found, last])

    def data(self, parts: Sequence[Part], tell: Callable[[int, int], None]) -> PoseData:
        """What a network learns from `parts`. Frames that cannot be decoded are noted at their recording."""
        from semdb.training.pose import PoseData

        at: dict[tuple[str, int], int] = {}
        rows: list[npt.NDArray[Any]] = []
        windows, poses, names = [], [], []
        total = sum(len(part.entries) for part in parts)
        for part in parts:
            name = part.recording.name
            for entry in part.entries:
                try:
                    window = self.window(name, entry.index)
                    for other in window:
                        if (name, other.index) not in at:
                            rows.append(self.of(name, other))
                            at[name, other.index] = len(rows) - 1
                except FrameError as error:
                    part.recording.note_decode_failure(entry, error)
                    continue
                windows.append([at[name, other.index] for other in window])
                poses.append(entry.world_from_camera)
                names.append(f"{name}:{entry.index}")
                tell(len(names), total)
        if not names:
            raise RecordingError("no frame that a network could be trained on can be read")
        known = [pose for pose in poses if pose is not None]
        encoder = "" if self.inputs.model is None else self.inputs.model.sha256
        return PoseData(np.stack(rows), np.array(windows, dtype=np.int32), np.stack(known), tuple(names), encoder)


def network_file(folder: Path, task: Task, method: Method) -> Path:
    """Where the network of a method on a task is kept."""
    count = sum(len(part.entries) for part in task.keyframes)
    return folder / f"{task.name}-{method.name}-{count}-{task.query_count}.pth".replace("/", "_")


@dataclass(frozen=True, slots=True, eq=False)
class TrainedNetwork:
    regressor: PoseRegressor
    reader: FrameReader
    frames: int
    models: tuple[ModelInfo, ...]


def trained_network(
    method: Method,
    task: Task,
    training: PoseTraining,
    encoder: str,
    settings: Settings,
    progress: Progress | None,
    *,
    resume: bool = False,
    must_train: bool = False,
    say: Say | None = None,
) -> TrainedNetwork:
    """The network of `method` on the frames of `task` that it may learn from: found in `training.networks`, or trained.

    With `must_train` one that is there already is an error, or is gone on from with `resume`.
    """
    from semdb.training.pose import check_checkpoint, load, train
    from semdb.training.pose_inputs import make_inputs

    if method.network is None:
        raise UsageError(f"--method {method.name} is no network")
    options = replace(training.options, kind=method.network)
    path = None if training.networks is None else network_file(training.networks, task, method)
    found = path is not None and path.exists() and not must_train
    if not found:
        check_checkpoint(path, resume=resume)  # before minutes of reading
    reader = FrameReader(task.recordings, make_inputs(options, encoder, settings, say), options)

    def tell(what: str, done: int, total: int) -> None:
        if progress is not None:
            progress(f"{method.name}: {what} of {task.name}", done, total)

    parts = training_parts(task, keyframes_only=method.keyframes_only)
    data = reader.data(parts, lambda done, total: tell("images to learn from", done, total))
    if path is not None and found:
        regressor = load(path, data, options, settings)
    else:
        regressor = train(
            options, data, settings, checkpoint=path, resume=resume,
            progress=lambda done, total: tell("steps of training", done, total),
        )  # fmt: skip
    own = regressor.options
    config = canonical_json({"backbone": own.backbone, "frames": len(data.names), "steps": own.steps})
    models = [ModelInfo("pose", method.name, "", config)]
    if reader.inputs.model is not None:
        models.append(reader.inputs.model)
    return TrainedNetwork(regressor, reader, len(data.names), tuple(models))


def keyframe_poses(task: Task) -> FloatArray:
    """``[n, 4, 4]`` of the keyframes of a task, in order."""
    poses = [entry.world_from_camera for part in task.keyframes for entry in part.entries]
    return np.stack([pose for pose in poses if pose is not None])


def fixed_pose(method: Method, poses: FloatArray) -> FloatArray:
    """The one answer of a method that looks at nothing."""
    fixed: FloatArray = poses[len(poses) // 2] if method.name == MIDDLE_KEYFRAME else mean_pose(poses)
    return fixed


def always(pose: FloatArray, stage: str, reason: str, seconds: float) -> Localization:
    """An answer without a verdict of its own: it counts as localized, and as false where it is far off."""
    return Localization(
        verdict=Verdict.LOCALIZED,
        map_name="",
        world_from_camera=pose,
        covariance=None,
        confidence=float("nan"),
        inliers=0,
        stage=stage,
        candidates=(),
        ranked_share=float("nan"),
        keyframes_matched=0,
        reason=reason,
        timing_ms={"pose": 1e3 * seconds, "total": 1e3 * seconds},
    )


def regressed(network: TrainedNetwork, recording: str, frame: Frame) -> tuple[Localization, float]:
    """The answer, and the milliseconds of what comes before the network that learnt."""
    started = time.perf_counter()
    inputs = network.reader.asked(recording, frame)
    described = time.perf_counter()
    pose = network.regressor.predict(inputs)
    seconds = time.perf_counter() - described
    reason = f"regressed by a network trained on {network.frames} frames; it always answers"
    return always(pose, REGRESSED, reason, seconds), 1e3 * (described - started)


def train_networks(
    paths: Sequence[Path],
    methods: Sequence[str],
    training: PoseTraining,
    settings: Settings,
    *,
    keyframes: int | None = None,
    max_queries: int | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    say: Say | None = None,
) -> list[tuple[Path, TrainedNetwork]]:
    """Networks of recordings, kept in ``training.networks``, on what protocol `paper` leaves to learn from.

    Raises UsageError for methods that are no networks, and what `trained_network` raises.
    """
    known = [method_named(name) for name in dict.fromkeys(methods)]
    for method in known:
        if method.network is None:
            raise UsageError(f"--method {method.name}: networks that can be trained are {', '.join(NETWORKS)}")
        check_torch(method)
    # networks look at no objects: whoever trains them needs no detector
    encoder = specs_for_ingest(settings.model_copy(update={"detector": "recorded"}), (), has_masks=True).encoder
    found = []
    for plan in (plan for path in paths for plan in paper_plans(path)):
        task = plan.choose(keyframes, max_queries, progress, say)
        for method in known:
            network = trained_network(
                method, task, training, encoder, settings, progress, resume=resume, must_train=True, say=say
            )
            if training.networks is not None:
                found.append((network_file(training.networks, task, method), network))
    return found
