"""The queries of `bench.trust`: which maps are made, who is asked what, and which answers would be right.

A query is *positive* when its map saw what it shows (common view of at least 0.3 with a keyframe), *hard* when its map
saw it but it is spoiled, moved, repeated, or seen at the edge, and *negative* when its map never saw it. Everything
is deterministic. Scenes are in two halves, ``fit`` and ``test``, and no rendered query is asked of the other half.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from bench.trust.images import SPOILED, Picture, Rng, close_up, no_place
from semdb.ingestion.keyframes import select_keyframes
from semdb.ingestion.view_overlap import ViewGrid, ViewStack, view_grid
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from semdb.types import Camera, FloatArray, InstanceMasks

POSITIVE, HARD, NEGATIVE = "positive", "hard", "negative"
FIT, TEST = "fit", "test"
MOVED, REFURNISHED = "moved furniture", "other furniture"
AGAIN = "second visit, other light"  # furniture moved, noise and some blur besides
ALIKE, ELSEWHERE = "room that looks alike", "same furniture elsewhere"
SEEN, EDGE, UNSEEN = 0.3, 0.02, 0.003  # common view with the best keyframe
REAL_KEYFRAMES = (12, 25, 50)

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class RenderedSize:
    """How many rooms and offices are rendered, once around in `frames` frames; every `stride`-th is a keyframe."""

    rooms: int = 6
    offices: int = 3
    frames: int = 48
    stride: int = 3
    width: int = 640
    height: int = 480
    like: tuple[str, ...] = (MOVED, AGAIN, REFURNISHED, ALIKE, ELSEWHERE)  # what is rendered beside each room


@dataclass(frozen=True, slots=True, eq=False)
class MapPlan:
    """A map to be made: `entries` of `recording` are its keyframes."""

    name: str
    half: str
    recording: Recording
    entries: tuple[FrameEntry, ...]


@dataclass(frozen=True, slots=True)
class Asked:
    """One question about an image: of which map, as what, in which suite."""

    map_name: str
    suite: str
    kind: str


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """An image, made when asked for, and who is asked about it. `world_from_camera` is true where the map knows it."""

    name: str
    picture: Callable[[], Picture]
    world_from_camera: FloatArray | None
    asked: tuple[Asked, ...]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A set of maps of one kind (rendered, or recorded) and the queries asked of them."""

    name: str
    maps: tuple[MapPlan, ...]
    queries: Callable[[], Iterator[Query]]


def _evenly(entries: Sequence[FrameEntry], count: int) -> list[FrameEntry]:
    if len(entries) <= count:
        return list(entries)
    return [entries[round(i)] for i in np.linspace(0, len(entries) - 1, count)]


class _Views:
    """Common view of any frame of a recording with the keyframes of its maps."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._grids: dict[int, ViewGrid] = {}

    def _grid(self, entry: FrameEntry) -> ViewGrid:
        if entry.index not in self._grids:
            depth = self._recording.read_depth(entry)
            camera = self._recording.camera
            missing = np.full((camera.height, camera.width), np.nan, np.float32)
            self._grids[entry.index] = view_grid(camera, missing if depth is None else depth)
        return self._grids[entry.index]

    def best(self, entry: FrameEntry, keyframes: Sequence[FrameEntry]) -> float:
        """The greatest common view with a keyframe; -1 where too little depth is known to tell."""
        views = [entry, *keyframes]
        poses = [v.world_from_camera for v in views if v.world_from_camera is not None]
        grids = [self._grid(v) for v in views]
        if not grids[0].known:
            return -1.0
        return float(ViewStack(grids, poses).overlap_with(0)[1:].max())


def _in_turn(parts: Sequence[Iterator[Query]]) -> Iterator[Query]:
    """One of each part after the other, so that what is cut off is cut off everywhere."""
    waiting = list(parts)
    while waiting:
        for part in tuple(waiting):
            found = next(part, None)
            if found is None:
                waiting.remove(part)
            else:
                yield found


def _picture(recording: Recording, entry: FrameEntry) -> Picture:
    return Picture(recording.read_image(entry), recording.camera, recording.read_instances(entry))


def _kind(common: float) -> str | None:
    """What a clean image of the map's own recording is; None between being seen at the edge and not at all."""
    if common >= SEEN:
        return POSITIVE
    if common >= EDGE:
        return HARD
    return NEGATIVE if 0 <= common < UNSEEN else None


# --- rendered rooms -------------------------------------------------------------------------------------------------


def _render(work: Path, name: str, options: SyntheticOptions, say: Say) -> Recording:
    folder = work / name
    if not folder.exists():
        say(f"rendering {name}")
        write_synthetic_recording(folder, options)
    return open_recordings(folder)[0]


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A rendered room with all that is asked of its map; `others` are recordings of rooms that are like it."""

    name: str
    half: str
    recording: Recording
    keyframes: tuple[FrameEntry, ...]
    part: tuple[FrameEntry, ...]  # keyframes that look into one half of the room
    queries: tuple[FrameEntry, ...]
    others: tuple[tuple[str, str, Recording], ...] = ()  # suite, kind, recording


def _room(work: Path, number: int, size: RenderedSize, say: Say) -> _Scene:
    name = f"room{number}"
    own = SyntheticOptions(
        frames=size.frames,
        width=size.width,
        height=size.height,
        lap_frames=size.frames,
        seed=number,
        noise=True,
        room_seed=100 + number,
        furniture_seed=200 + number,
    )
    few = replace(own, frames=10, lap_frames=10)
    kinds = {
        MOVED: ("-moved", HARD, replace(own, frames=12, lap_frames=12, second_visit=True)),
        # an exposure smears over 2.4 degrees
        AGAIN: ("-again", HARD, replace(own, frames=12, lap_frames=12, second_visit=True, lighting=0.6, blur=0.08)),
        REFURNISHED: ("-refurnished", HARD, replace(few, seed=50 + number, furniture_seed=300 + number)),
        ALIKE: ("-alike", NEGATIVE, replace(few, seed=60 + number, alike=True)),
        ELSEWHERE: ("-elsewhere", NEGATIVE, replace(few, seed=70 + number, room_seed=400 + number)),
    }
    first = _render(work, name, own, say)
    others = []
    for suite in size.like:
        suffix, kind, options = kinds[suite]
        others.append((suite, kind, _render(work, name + suffix, options, say)))
    return _scene(name, number, first, size.stride, tuple(others))


def _office(work: Path, number: int, size: RenderedSize, say: Say) -> _Scene:
    options = SyntheticOptions(
        frames=size.frames,
        width=size.width,
        height=size.height,
        lap_frames=size.frames,
        seed=number,
        noise=True,
        room_seed=500 + number,
        desks=6,
    )
    name = f"office{number}"
    return _scene(name, number, _render(work, name, options, say), size.stride, ())


def _scene(
    name: str, number: int, recording: Recording, stride: int, others: tuple[tuple[str, str, Recording], ...]
) -> _Scene:
    entries = recording.entries
    keyframes, rest = entries[::stride], [e for k, e in enumerate(entries) if k % stride]
    half = FIT if number % 2 == 0 else TEST
    return _Scene(name, half, recording, keyframes, keyframes[: len(keyframes) * 2 // 5], tuple(rest), others)


def rendered_world(work: Path, say: Say, size: RenderedSize | None = None) -> World:
    """Rooms, rooms like them, and offices of equal desks; rendered into `work`, or found there."""
    size = size or RenderedSize()
    rooms = [_room(work, number, size, say) for number in range(size.rooms)]
    offices = [_office(work, number, size, say) for number in range(size.offices)]
    maps = []
    for scene in (*rooms, *offices):
        maps.append(MapPlan(scene.name, scene.half, scene.recording, scene.keyframes))
    for scene in rooms:
        maps.append(MapPlan(f"{scene.name}-part", scene.half, scene.recording, scene.part))

    def queries() -> Iterator[Query]:
        for seed, half in enumerate((FIT, TEST)):
            asked = tuple(Asked(s.name, "no place at all", NEGATIVE) for s in (*rooms, *offices) if s.half == half)
            if not asked:
                continue
            camera = rooms[0].recording.camera
            yield from _nothing(camera, seed, asked, rooms[0].recording.categories is not None)
        parts = [_queries_of_office(scene, [s for s in rooms if s.half == scene.half]) for scene in offices]
        for scene in rooms:
            others = [s for s in (*rooms, *offices) if s.half == scene.half and s is not scene]
            parts.append(_queries_of_room(scene, others))
        yield from _in_turn(parts)

    return World("rendered", tuple(maps), queries)


def _nothing(camera: Camera, seed: int, asked: tuple[Asked, ...], with_masks: bool) -> Iterator[Query]:
    masks = InstanceMasks(np.zeros((camera.height, camera.width), np.uint16), {}) if with_masks else None
    for number, image in enumerate(no_place(camera, seed)):
        yield Query(f"nothing{seed}/{number}", partial(Picture, image, camera, masks), None, asked)


def _queries_of_room(scene: _Scene, others: Sequence[_Scene]) -> Iterator[Query]:
    views = _Views(scene.recording)
    elsewhere = tuple(Asked(other.name, "other room", NEGATIVE) for other in others)
    clean = scene.queries[::2]
    for entry in scene.queries:
        common, of_part = views.best(entry, scene.keyframes), views.best(entry, scene.part)
        asked: tuple[Asked, ...] = ()
        if entry in clean:
            asked = (*_own(scene.name, common), *elsewhere)
        if 0 <= of_part < UNSEEN:
            asked += (Asked(f"{scene.name}-part", "outside the map", NEGATIVE),)
        if asked:
            yield _query(scene.name, scene.recording, entry, asked)
    for number, entry in enumerate(clean):
        if _kind(views.best(entry, scene.keyframes)) != POSITIVE or number % 2:
            continue
        other = others[number // 2 % len(others)].name if others else None
        yield from _spoiled(scene.name, scene.recording, entry, scene.name, other)
    for suite, kind, recording in scene.others:
        for number, entry in enumerate(recording.entries):
            asked = (Asked(scene.name, suite, kind),)
            if suite == AGAIN and others:
                asked += (Asked(others[number % len(others)].name, "other room, other light", NEGATIVE),)
            yield _query(f"{scene.name}/{suite}", recording, entry, asked)


def _own(map_name: str, common: float) -> tuple[Asked, ...]:
    kind = _kind(common)
    suites = {POSITIVE: "seen by the map", HARD: "edge of the map", NEGATIVE: "outside the map"}
    return () if kind is None else (Asked(map_name, suites[kind], kind),)


def _query(name: str, recording: Recording, entry: FrameEntry, asked: tuple[Asked, ...]) -> Query:
    return Query(f"{name}/{entry.index}", partial(_picture, recording, entry), entry.world_from_camera, asked)


def _spoiled(name: str, recording: Recording, entry: FrameEntry, own: str, other: str | None) -> Iterator[Query]:
    """One frame spoiled in every way: hard for its own map, negative for another."""
    for cause, ways in SPOILED.items():
        for level, spoil in enumerate(ways, start=1):
            asked: tuple[Asked, ...] = (Asked(own, f"{cause} {level}", HARD),)
            if other is not None:
                asked += (Asked(other, f"other room, {cause}", NEGATIVE),)
            picture = partial(_spoil, recording, entry, spoil, level)
            yield Query(f"{name}/{entry.index}/{cause}{level}", picture, entry.world_from_camera, asked)


def _spoil(recording: Recording, entry: FrameEntry, spoil: Callable[[Picture, Rng], Picture], level: int) -> Picture:
    return spoil(_picture(recording, entry), np.random.default_rng([entry.index, level]))


def _queries_of_office(scene: _Scene, others: Sequence[_Scene]) -> Iterator[Query]:
    for entry in scene.queries:
        elsewhere = tuple(Asked(other.name, "other room", NEGATIVE) for other in others[:2])
        yield _query(scene.name, scene.recording, entry, (Asked(scene.name, "equal desks", HARD), *elsewhere))
        picture = _picture(scene.recording, entry)
        assert picture.instances is not None
        labels, counts = np.unique(picture.instances.labels, return_counts=True)
        screens = [
            int(label)
            for label, count in zip(labels, counts, strict=True)
            if count > 400 and picture.instances.categories.get(int(label)) in ("tv", "laptop")
        ]
        for label in screens[:1]:
            near = partial(close_up, picture, label)
            asked = (Asked(scene.name, "equal desks, close up", HARD),)
            yield Query(f"{scene.name}/{entry.index}/close", near, entry.world_from_camera, asked)


# --- recordings -----------------------------------------------------------------------------------------------------


def recorded_world(paths: Sequence[Path], say: Say, queries_each: int = 60) -> World:
    """Recordings, each asked of its own maps (of 12, 25 and 50 keyframes, and of a part of it) and of the others'."""
    recordings = [found for path in paths for found in open_recordings(path)]
    sizes: dict[str, dict[str, tuple[FrameEntry, ...]]] = {}
    maps = []
    for number, recording in enumerate(recordings):
        half = FIT if number % 2 == 0 else TEST
        say(f"selecting keyframes of {recording.name}")
        own: dict[str, tuple[FrameEntry, ...]] = {}
        for count in REAL_KEYFRAMES:
            if count <= len(recording.entries) // 2:
                own[f"{recording.name}-{count}"] = tuple(select_keyframes(recording, count=count))
        first = [e for e in recording.entries[: len(recording.entries) * 2 // 5] if e.world_from_camera is not None]
        own[f"{recording.name}-part"] = tuple(_evenly(first, 12))
        sizes[recording.name] = own
        maps += [MapPlan(name, half, recording, entries) for name, entries in own.items()]

    def queries() -> Iterator[Query]:
        parts = []
        for number, recording in enumerate(recordings):
            foreign = [
                name for r in recordings if r is not recording for name in sizes[r.name] if not name.endswith("-part")
            ]
            parts.append(_queries_of_recording(recording, sizes[recording.name], foreign, queries_each))
            asked = tuple(Asked(name, "no place at all", NEGATIVE) for name in list(sizes[recording.name])[:2])
            parts.append(_nothing(recording.camera, number, asked, recording.categories is not None))
        yield from _in_turn(parts)

    return World("recorded", tuple(maps), queries)


def _queries_of_recording(
    recording: Recording, own: dict[str, tuple[FrameEntry, ...]], foreign: Sequence[str], count: int
) -> Iterator[Query]:
    views = _Views(recording)
    taken = {entry.index for entries in own.values() for entry in entries}
    posed = [e for e in recording.entries if e.world_from_camera is not None]
    free = [e for e in posed if e.index not in taken]
    chosen = _evenly(free, count)
    elsewhere = tuple(Asked(name, "other room", NEGATIVE) for name in foreign)
    for entry in posed:
        asked: tuple[Asked, ...] = ()
        for name, keyframes in own.items():
            common = views.best(entry, keyframes)
            outside = name.endswith("-part") and 0 <= common < UNSEEN
            if entry in keyframes or not (outside or entry in chosen):
                continue
            asked += _own(name, common)
        if entry in chosen:
            asked += elsewhere
        if asked:
            yield _query(recording.name, recording, entry, asked)
    full = [name for name in own if not name.endswith("-part")]
    for number, entry in enumerate(chosen[::2]):
        name = full[number % len(full)]
        if views.best(entry, own[name]) < SEEN:
            continue
        other = foreign[number % len(foreign)] if foreign else None
        yield from _spoiled(recording.name, recording, entry, name, other)
