"""Hard places of `bench.trust --scene`: bare rooms, corridors, rooms whose textures are mirrored, and a recording.

Each is a world of its own with one map, so that they can be asked one after the other and told apart as scenes: those
of even number are the ``fit`` half, the others ``test``. Images are asked by colour alone and with depth; those of
another place of the same kind must not be localized.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from bench.corridor import Corridor
from bench.trust.images import Picture
from bench.trust.suites import FIT, HARD, NEGATIVE, TEST, Asked, MapPlan, Query, Say, World
from semdb.errors import UsageError
from semdb.ingestion.keyframes import select_keyframes
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from semdb.recordings.synthetic.writer import write_frames

KINDS = ("bare", "corridor", "furnished", "mirrored")  # "furnished" is a corridor, too
FIRST_MIRRORED = 900  # seed of its room 0: none of `bench.trust` or `bench.visits`
LAP = 48  # frames of a room
KEYFRAMES = {"bare": 12, "corridor": 20, "furnished": 20, "mirrored": 12}
FOREIGN = 4  # one in so many frames of the other place
HOW = ("colour", "with depth")


def scene_world(name: str, work: Path, say: Say, queries: int | None = None) -> World:
    """The world of a scene such as ``bare3``: a map, `queries` images of it (None: all) and some of another place.

    Raises UsageError for a name that is none.
    """
    found = re.fullmatch(rf"({'|'.join(KINDS)})(\d+)", name)
    if found is None:
        raise UsageError(f"--scene {name}: a kind of {', '.join(KINDS)} and a number are expected, as bare3")
    kind, number = found[1], int(found[2])
    own = _rendered(kind, number, work, say)
    other = _mirror(number, work, say) if kind == "mirrored" else _rendered(kind, number + 2, work, say)
    half = FIT if number % 2 == 0 else TEST
    keyframes = tuple(select_keyframes(own, count=KEYFRAMES[kind]))
    rest = [entry for entry in own.entries if entry not in keyframes]
    asked = _evenly(rest, queries)
    foreign = other.entries if kind == "mirrored" else _evenly(other.entries, max(len(asked) // FOREIGN, 1))
    what = {"bare": "bare room", "furnished": "furnished corridor", "mirrored": "room"}.get(kind, kind)
    elsewhere = "the same room, textures mirrored" if kind == "mirrored" else f"another {what}"
    plan = MapPlan(name, half, own, keyframes)
    return World(
        kind,
        (plan,),
        partial(_queries, name, ((own, asked, what, HARD), (other, foreign, elsewhere, NEGATIVE))),
    )


def recorded_scene(recording: Recording, number: int, keyframes: int) -> World:
    """A map of a recording, and all its other frames, by colour alone and with depth."""
    chosen = tuple(select_keyframes(recording, count=keyframes))
    rest = [entry for entry in recording.entries if entry not in chosen and entry.world_from_camera is not None]
    name = f"{recording.name}-{keyframes}"
    plan = MapPlan(name, FIT if number % 2 == 0 else TEST, recording, chosen)
    return World("recorded", (plan,), partial(_queries, name, ((recording, rest, recording.name, HARD),)))


def _queries(name: str, parts: Sequence[tuple[Recording, Sequence[FrameEntry], str, str]]) -> Iterator[Query]:
    for recording, entries, what, kind in parts:
        for entry in entries:
            for how in HOW:
                picture = partial(_picture, recording, entry, how != HOW[0])
                pose = entry.world_from_camera if kind == HARD else None
                yield Query(f"{name}/{what}/{entry.index}/{how}", picture, pose, (Asked(name, f"{what}, {how}", kind),))


def _picture(recording: Recording, entry: FrameEntry, with_depth: bool) -> Picture:
    frame = recording.read(entry)
    return Picture(frame.image, frame.camera, frame.instances, frame.depth if with_depth else None)


def _evenly(entries: Sequence[FrameEntry], count: int | None) -> list[FrameEntry]:
    if count is None or count >= len(entries):
        return list(entries)
    return [entries[round(k * (len(entries) - 1) / max(count - 1, 1))] for k in range(count)]


def _rendered(kind: str, number: int, work: Path, say: Say) -> Recording:
    if kind in ("corridor", "furnished"):
        return _at(
            work / f"{kind}{number}",
            lambda folder: write_frames(folder, Corridor(number, kind == "furnished"), None),
            say,
        )
    bare = kind == "bare"
    seed = number if bare else FIRST_MIRRORED + number
    options = SyntheticOptions(frames=LAP, lap_frames=LAP, seed=number, room_seed=seed, noise=True, bare=bare)
    return _at(work / f"{kind}{number}", lambda folder: _room(folder, options), say)


def _mirror(number: int, work: Path, say: Say) -> Recording:
    options = SyntheticOptions(
        frames=12, lap_frames=12, seed=60 + number, room_seed=FIRST_MIRRORED + number, noise=True, alike=True
    )
    return _at(work / f"mirrored{number}-alike", lambda folder: _room(folder, options), say)


def _room(folder: Path, options: SyntheticOptions) -> None:
    write_synthetic_recording(folder, options)


def _at(folder: Path, write: Callable[[Path], None], say: Say) -> Recording:
    """The recording in `folder`, written there first where there is none."""
    if not folder.exists():
        say(f"rendering {folder.name}")
        new = folder.with_name(folder.name + ".new")
        new.mkdir(parents=True)
        write(new)
        new.rename(folder)
    return open_recordings(folder)[0]
