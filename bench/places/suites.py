"""Maps and queries of `bench.places`: frames with what they have in common, and which of them are the map."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semdb.ingestion.keyframes import select_keyframes
from semdb.ingestion.view_overlap import ViewGrid, ViewStack, view_grid
from semdb.recordings import open_recordings
from semdb.recordings.base import Recording
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.types import BoolArray, Float32Array, FloatArray, ImageArray, IntArray

TUNE, JUDGE = "tune", "judge"
APART = 60  # frames at 30 Hz between a query and what the map has of its recording, where it is seen again
COUNTS = (12, 25, 50)
EVERY = 4  # frames of a rendered room from one query to the next

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Images with the common view ``[n, n]`` of each two, and their numbers at 30 Hz in their recording."""

    name: str
    half: str
    images: Sequence[ImageArray]
    common: Float32Array
    numbers: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Suite:
    """`allowed` ``[queries, keyframes]``: which keyframes a query is compared with; both are positions in `frames`."""

    name: str
    frames: Frames
    keyframes: IntArray
    queries: IntArray
    allowed: BoolArray


def recorded(path: Path, half: str, most_queries: int, say: Say) -> list[Suite]:
    """Maps of several numbers of keyframes, and one of all frames that are not near the query."""
    found = []
    for recording in open_recordings(path):
        say(f"reading {recording.name}")
        frames = _frames(recording, half)
        entries = [entry for entry in recording.entries if entry.world_from_camera is not None]
        place = {entry.index: number for number, entry in enumerate(entries)}
        for count in COUNTS:
            if count > len(entries) // 2:
                continue
            keyframes = np.array([place[e.index] for e in select_keyframes(recording, count=count)], np.int32)
            rest = np.setdiff1d(np.arange(len(entries), dtype=np.int32), keyframes)
            queries = _evenly(rest, most_queries)
            everything = np.ones((len(queries), len(keyframes)), np.bool_)
            found.append(Suite(f"{recording.name} {count}", frames, keyframes, queries, everything))
        every = np.arange(len(entries), dtype=np.int32)
        queries = _evenly(every, most_queries)
        apart = np.abs(frames.numbers[queries][:, None] - frames.numbers[None]) > APART
        found.append(Suite(f"{recording.name} again", frames, every, queries, apart))
    return found


def _frames(recording: Recording, half: str) -> Frames:
    images, grids, poses, numbers = [], [], [], []
    for entry in recording.entries:
        if entry.world_from_camera is None:
            continue
        frame = recording.read(entry)
        depth = frame.depth
        if depth is None:
            depth = np.full(frame.image.shape[:2], np.nan, np.float32)
        images.append(frame.image)
        grids.append(view_grid(recording.camera, depth))
        poses.append(entry.world_from_camera)
        at = entry.index if entry.timestamp_ns is None else round(entry.timestamp_ns * 30e-9)
        numbers.append(at)
    first = min(numbers)
    common = _common(grids, poses)
    return Frames(recording.name, half, images, common, np.array([n - first for n in numbers], np.int32))


def _common(grids: list[ViewGrid], poses: list[FloatArray]) -> Float32Array:
    stack = ViewStack(grids, poses)
    return np.stack([stack.overlap_with(i) for i in range(len(grids))]).astype(np.float32)


def _evenly(numbers: IntArray, most: int) -> IntArray:
    if len(numbers) <= most:
        return numbers
    return numbers[np.linspace(0, len(numbers) - 1, most).round().astype(int)]


def _rendered(
    name: str, half: str, groups: Sequence[Sequence[SyntheticOptions]], work: Path, say: Say
) -> tuple[Frames, IntArray]:
    """Frames of rooms; those of one group are in one room and one world. Also the number of each in its recording."""
    images: list[ImageArray] = []
    blocks: list[Float32Array] = []
    for number, group in enumerate(groups, 1):
        say(f"rendering {name}, room {number} of {len(groups)}")
        shown, common = _room(group, work)
        images += list(shown)
        blocks.append(common)
    own = [index for group in groups for options in group for index in range(options.frames)]
    common = np.zeros((len(images), len(images)), np.float32)
    start = 0
    for block in blocks:
        common[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    numbers = np.array(own, np.int32)
    return Frames(name, half, images, common, numbers), numbers


def _room(group: Sequence[SyntheticOptions], work: Path) -> tuple[ImageArray, Float32Array]:
    """Images and common views of one room, from `work` where they are there."""
    path = work / f"room-{hashlib.sha256(repr(group).encode()).hexdigest()[:12]}.npz"
    if path.exists():
        with np.load(path) as known:
            return known["images"], known["common"]
    images, grids, poses = [], [], []
    for options in group:
        sequence = SyntheticSequence(options)
        for index in range(options.frames):
            frame = sequence.render(index)
            images.append(frame.rgb)
            grids.append(view_grid(sequence.camera, frame.known_depth))
            poses.append(frame.world_from_camera)
    shown, common = np.stack(images), _common(grids, poses)
    np.savez_compressed(path, images=shown, common=common)
    return shown, common


def _split(frames: Frames, is_query: BoolArray) -> Suite:
    queries = np.flatnonzero(is_query).astype(np.int32)
    keyframes = np.flatnonzero(~is_query).astype(np.int32)
    return Suite(frames.name, frames, keyframes, queries, np.ones((len(queries), len(keyframes)), np.bool_))


def rooms(half: str, first_seed: int, count: int, frames: int, work: Path, say: Say) -> Suite:
    """Rooms with different furniture in one map; every fourth frame is a query."""
    base = SyntheticOptions(frames=frames, lap_frames=frames, width=320, height=240, noise=True)
    groups = [[replace(base, room_seed=first_seed + k, seed=first_seed + k)] for k in range(count)]
    found, own = _rendered(f"{count} rooms ({half})", half, groups, work, say)
    return _split(found, own % EVERY == EVERY // 2)


def alike(half: str, first: int, count: int, work: Path, say: Say) -> Suite:
    """Rooms, and for each one that looks alike, one with its furniture and one with other furniture, in one map."""
    base = SyntheticOptions(frames=12, lap_frames=12, width=320, height=240, noise=True)
    groups = []
    for k in range(first, first + count):
        own = replace(base, seed=k, room_seed=100 + k, furniture_seed=200 + k)
        groups += [[own], [replace(own, seed=60 + k, alike=True)], [replace(own, seed=70 + k, room_seed=400 + k)]]
        groups += [[replace(own, seed=50 + k, furniture_seed=300 + k)]]
    found, own_index = _rendered(f"rooms that look alike ({half})", half, groups, work, say)
    return _split(found, own_index % 3 == 1)


def offices(half: str, first: int, count: int, work: Path, say: Say) -> Suite:
    """Rooms with six equal desks each."""
    base = SyntheticOptions(frames=24, lap_frames=24, width=320, height=240, noise=True, desks=6)
    groups = [[replace(base, seed=k, room_seed=500 + k)] for k in range(first, first + count)]
    found, own = _rendered(f"offices ({half})", half, groups, work, say)
    return _split(found, own % 2 == 1)


def second_visits(half: str, first: int, count: int, work: Path, say: Say) -> Suite:
    """Rooms, and queries of a second visit: another way, other light, furniture moved, some blur."""
    base = SyntheticOptions(frames=16, lap_frames=16, width=320, height=240, noise=True)
    groups = []
    for k in range(first, first + count):
        own = replace(base, seed=k, room_seed=100 + k, furniture_seed=200 + k)
        again = replace(own, frames=12, lap_frames=12, second_visit=True, lighting=0.6, blur=0.08)
        groups.append([own, again])
    found, _ = _rendered(f"second visits ({half})", half, groups, work, say)
    return _split(found, np.tile(np.r_[np.zeros(16, np.bool_), np.ones(12, np.bool_)], count))


def rendered(work: Path, say: Say) -> Iterator[Suite]:
    """Rooms of both halves: eight to tune, twenty to judge; and look-alikes, offices and second visits for each."""
    for place, half in enumerate((TUNE, JUDGE)):
        yield rooms(half, 100 + 50 * place, (8, 20)[place], 12, work, say)
        yield alike(half, 3 * place, 3, work, say)
        yield offices(half, 2 * place, 2, work, say)
        yield second_visits(half, 3 * place, 3, work, say)
