"""What one evaluation is about: which frames make the map, which are asked about, and whose poses count as true."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from semdb.errors import RecordingError
from semdb.evaluation.protocols import PAPER, SPLIT, evenly_spaced, split_paper
from semdb.evaluation.published import PaperRow, counts_like, sequence_of
from semdb.evaluation.refined_truth import Disagreement, disagreement, refine_poses
from semdb.evaluation.rolling_shutter import rates_between
from semdb.ingestion.keyframes import select_keyframes
from semdb.recordings.base import FrameEntry, Recording
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

GIVEN = "given"
REFINED = "refined"
USUAL_RATE = 30.0  # frames a second, where a recording has no times

Progress = Callable[[str, int, int], None]
Say = Callable[[str], None]
Key = tuple[str, int]  # name of a recording and index of a frame in it


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Some frames of one recording."""

    recording: Recording
    entries: tuple[FrameEntry, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Keyframes and queries, ready to be run.

    `keyframes_asked` is None where the protocol chose the number. `other_truth` are poses ``[4, 4]`` of queries by
    the other truth.
    """

    name: str
    protocol: str
    keyframes: tuple[Part, ...]
    queries: tuple[Part, ...]
    frames: int
    keyframes_asked: int | None = None
    sequence: str | None = None
    truth: str = GIVEN
    other_truth: Mapping[Key, FloatArray] = field(default_factory=dict)
    disagreement: Disagreement | None = None

    @property
    def recordings(self) -> list[Recording]:
        """Every recording that has a part in it, once."""
        return list(dict.fromkeys(part.recording for part in (*self.keyframes, *self.queries)))

    @property
    def map_cameras(self) -> list[Camera]:
        """What took the keyframes."""
        return list(dict.fromkeys(p.recording.camera_of(entry) for p in self.keyframes for entry in p.entries))

    @property
    def query_count(self) -> int:
        return sum(len(part.entries) for part in self.queries)


class Plan(Protocol):
    """An evaluation whose frames are still to be chosen: choosing reads every depth image."""

    @property
    def name(self) -> str: ...

    @property
    def recordings(self) -> Sequence[Recording]: ...

    def choose(
        self, keyframes: int | None, max_queries: int | None, progress: Progress | None, say: Say | None
    ) -> Task:
        """Raises UsageError where no frame is left for queries, or there are too few for the keyframes."""


@dataclass(frozen=True, slots=True, eq=False)
class PaperPlan:
    """Protocol `paper`: keyframes and queries from one recording."""

    recording: Recording

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def recordings(self) -> Sequence[Recording]:
        return [self.recording]

    def choose(
        self, keyframes: int | None, max_queries: int | None, progress: Progress | None, say: Say | None
    ) -> Task:
        """The paper's own numbers for its sequences, where none are given."""
        row, asked = sequence_of(self.recording.path), keyframes
        if row is not None and (keyframes is None or max_queries is None):
            keyframes, max_queries = self._like_the_paper(row, keyframes, max_queries, say)
        chosen = select_keyframes(self.recording, count=keyframes, progress=_selecting(self.name, progress))
        queries = split_paper(self.recording.entries, chosen, max_queries)
        return Task(
            self.name,
            PAPER,
            (Part(self.recording, tuple(chosen)),),
            (Part(self.recording, tuple(queries)),),
            self.recording.total_frames,
            asked,
            None if row is None else row.sequence,
        )

    def _like_the_paper(
        self, row: PaperRow, keyframes: int | None, max_queries: int | None, say: Say | None
    ) -> tuple[int, int]:
        posed = sum(entry.world_from_camera is not None for entry in self.recording.entries)
        counts = counts_like(row, posed)
        if say is not None:
            own = [f"--keyframes {keyframes}"] * (keyframes is not None)
            own += [f"--max-queries {max_queries}"] * (max_queries is not None)
            say(f"{self.name} {counts.note}" + (f", but for {' and '.join(own)}" if own else ""))
        return keyframes or counts.keyframes, max_queries or counts.queries


@dataclass(frozen=True, slots=True, eq=False)
class SplitPlan:
    """Protocol `split`: keyframes from some recordings, queries from others, all in one world frame."""

    name: str
    map_recordings: tuple[Recording, ...]
    query_recordings: tuple[Recording, ...]

    @property
    def recordings(self) -> Sequence[Recording]:
        return [*self.map_recordings, *self.query_recordings]

    def choose(
        self, keyframes: int | None, max_queries: int | None, progress: Progress | None, say: Say | None
    ) -> Task:
        """`keyframes` is the number of the whole map, `max_queries` that of all queries."""
        parts = _select_together(self.map_recordings, keyframes, _selecting(self.name, progress))
        posed = [
            (recording, entry)
            for recording in self.query_recordings
            for entry in recording.entries
            if entry.world_from_camera is not None
        ]
        if not posed:
            names = ", ".join(recording.name for recording in self.query_recordings)
            raise RecordingError(f"{names}: no frame has a pose, so no answer could be compared with the true one")
        if max_queries is not None:
            posed = [posed[position] for position in evenly_spaced(len(posed), max_queries)]
        queries = tuple(
            Part(recording, tuple(entry for owner, entry in posed if owner is recording))
            for recording in self.query_recordings
        )
        frames = sum(recording.total_frames for recording in self.recordings)
        return Task(self.name, SPLIT, parts, queries, frames, keyframes)


def refine_truth(task: Task, *, both: bool, progress: Progress | None) -> list[Task]:
    """The task with refined poses, after the given one where `both` are wanted; each knows the other's poses.

    The same frames are keyframes and queries in both, but for queries and keyframes that structure from motion could
    not place. Raises ModelError without pycolmap, RecordingError where the images have too little in common.
    """
    rows = [(part.recording, entry) for part in (*task.keyframes, *task.queries) for entry in part.entries]
    order = sorted(range(len(rows)), key=lambda i: (task.recordings.index(rows[i][0]), rows[i][1].index))
    rows = [rows[i] for i in order]
    given = np.stack([entry.world_from_camera for _, entry in rows if entry.world_from_camera is not None])
    cameras: list[Camera] = [recording.camera for recording, _ in rows]

    def frame(i: int) -> tuple[ImageArray, Float32Array | None]:
        recording, entry = rows[i]
        return recording.read_image(entry), recording.read_depth(entry)

    found = refine_poses(cameras, frame, given, _turn_rates(rows), name=task.name, progress=progress)
    old = {_key(*row): pose for row, pose in zip(rows, given, strict=True)}
    new = {
        _key(*row): pose for row, pose, good in zip(rows, found.world_from_camera, found.refined, strict=True) if good
    }
    figures = disagreement(given, found)
    better = replace(
        task,
        truth=REFINED,
        keyframes=_with_poses(task.keyframes, new),
        queries=_with_poses(task.queries, new),
        other_truth=old,
        disagreement=figures,
    )
    return [replace(task, other_truth=new, disagreement=figures), better] if both else [better]


def _turn_rates(rows: Sequence[tuple[Recording, FrameEntry]]) -> FloatArray:
    """How the camera turns in each of the frames, ``[n, 3]``: as the recording says, or from the frames around."""
    known: dict[Key, FloatArray] = {}
    for recording in dict.fromkeys(recording for recording, _ in rows):
        posed = [(entry, entry.world_from_camera) for entry in recording.entries]
        entries = [entry for entry, pose in posed if pose is not None]
        poses = np.stack([pose for _, pose in posed if pose is not None])
        between = rates_between(poses, np.array([_time_s(entry) for entry in entries]))
        for entry, rate in zip(entries, between, strict=True):
            known[_key(recording, entry)] = rate if entry.turn_rate is None else entry.turn_rate
    return np.stack([known[_key(*row)] for row in rows])


def _time_s(entry: FrameEntry) -> float:
    return entry.index / USUAL_RATE if entry.timestamp_ns is None else entry.timestamp_ns * 1e-9


def _key(recording: Recording, entry: FrameEntry) -> Key:
    return recording.name, entry.index


def _with_poses(parts: Sequence[Part], poses: Mapping[Key, FloatArray]) -> tuple[Part, ...]:
    """The parts with these poses, in their recordings too, without the frames that have none."""
    found = []
    for part in parts:
        own = {
            entry.index: replace(entry, world_from_camera=poses[_key(part.recording, entry)])
            for entry in part.entries
            if _key(part.recording, entry) in poses
        }
        entries = tuple(own.get(entry.index, entry) for entry in part.recording.entries)
        found.append(Part(replace(part.recording, entries=entries), tuple(own.values())))
    return tuple(found)


def _selecting(name: str, progress: Progress | None) -> Callable[[int, int], None]:
    def selecting(done: int, total: int) -> None:
        if progress is not None:
            progress(f"selecting keyframes of {name}", done, total)

    return selecting


@dataclass(slots=True, eq=False)
class _Joined(Recording):
    """Recordings of one camera as one, so that keyframes are chosen by little common view over all of them."""

    owners: Mapping[int, Recording] = field(default_factory=dict)  # by id of the entry

    def read_depth(self, entry: FrameEntry) -> Float32Array | None:
        return self.owners[id(entry)].read_depth(entry)


def _select_together(
    recordings: Sequence[Recording], count: int | None, progress: Callable[[int, int], None]
) -> tuple[Part, ...]:
    """Keyframes over all `recordings`; those of another camera are chosen apart, in proportion to their frames."""
    by_camera: dict[Camera, list[Recording]] = {}
    for recording in recordings:
        by_camera.setdefault(recording.camera, []).append(recording)
    groups = list(by_camera.values())
    counts = _proportional([sum(len(r.entries) for r in group) for group in groups], count)
    parts = []
    for group, own in zip(groups, counts, strict=True):
        owners = {id(entry): recording for recording in group for entry in recording.entries}
        first = group[0]
        joined = _Joined(
            path=first.path,
            name=first.name,
            format=first.format,
            camera=first.camera,
            depth_scale=first.depth_scale,
            total_frames=len(owners),
            entries=tuple(entry for recording in group for entry in recording.entries),
            dropped=(),
            owners=owners,
        )
        chosen = {id(entry) for entry in select_keyframes(joined, count=own, progress=progress)}
        parts += [
            Part(recording, tuple(entry for entry in recording.entries if id(entry) in chosen)) for recording in group
        ]
    return tuple(part for part in parts if part.entries)


def _proportional(sizes: Sequence[int], count: int | None) -> list[int | None]:
    """`count` shared out in proportion to `sizes`, at least one each, by largest remainder."""
    if count is None:
        return [None] * len(sizes)
    exact = [count * size / sum(sizes) for size in sizes]
    shares = [max(1, int(value)) for value in exact]
    for i in sorted(range(len(sizes)), key=lambda i: int(exact[i]) - exact[i])[: max(0, count - sum(shares))]:
        shares[i] += 1
    return list(shares)
