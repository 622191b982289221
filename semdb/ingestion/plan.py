"""Which keyframes an ingest plans: a new selection, those of the stored plan, or these and more.

A plan only grows: what is stored stays, and what differs from it is said rather than guessed.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass

from semdb.database.planning import StoredPlan
from semdb.database.store import Store
from semdb.errors import NotFoundError, UsageError
from semdb.ingestion.keyframes import select_keyframes
from semdb.recordings.base import FrameEntry, Recording
from semdb.shown import camera_numbers, number
from semdb.types import Camera

ADVICE = "run `semdb delete` for it first, or give the new one another name (--name)"
FRAMES_SHOWN = 5

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Choice:
    """The keyframes to be; `extends` is the fingerprint of the stored plan where there are more than in that."""

    entries: Sequence[FrameEntry]
    extends: str = ""


def fingerprint(recording: Recording, keyframes: Sequence[FrameEntry]) -> str:
    """SHA-256 over format, camera and the keyframes' names, times and poses: tells recordings of one name apart.

    Other frames are not in it, so a recording whose broken files were mended is still the same one; nor are estimated
    poses, which its plan keeps.
    """
    digest = hashlib.sha256(f"{recording.format}|{recording.camera}|{recording.depth_scale}".encode())
    for entry in keyframes:
        digest.update(f"|{entry.index}|{entry.name}|{entry.timestamp_ns}".encode(errors="surrogateescape"))
        if entry.camera is not None:
            digest.update(f"|{entry.camera}".encode())
        if entry.world_from_camera is not None and not recording.estimated:
            digest.update(entry.world_from_camera.astype("<f8").tobytes())
    return digest.hexdigest()


def choose_keyframes(
    recording: Recording,
    store: Store,
    map_name: str,
    *,
    count: int | None = None,
    stride: int | None = None,
    progress: Progress | None = None,
) -> Choice:
    """The keyframes of `recording` in a map, in ascending index.

    Where a plan is stored they are its own; `count` or `stride`, as of `select_keyframes`, may ask for these and more.
    Raises UsageError, which says what differs, for a recording that is another than the stored one, and for a wish that
    takes keyframes away; RecordingError as `select_keyframes`.
    """
    stored = store.find_plan(map_name, recording.name)
    if stored is None or (count is not None and (stride is not None or count < 1)):
        return Choice(select_keyframes(recording, count=count, stride=stride, progress=progress))
    name = f"the recording {recording.name!r} of the map {map_name!r}"
    kept = _kept(recording, store, stored, name)
    if count is None and stride is None:
        return Choice(kept)
    if count is not None and count < len(kept):
        raise UsageError(
            f"{name} was planned with {len(kept)} keyframes, and {count} are asked for: more are added, "
            "none is taken away (`semdb delete keyframes` does that). Leave it out to go on, or give another "
            "name (--name)"
        )
    if count == len(kept):
        return Choice(kept)
    entries = select_keyframes(recording, count=count, stride=stride, keep=kept, progress=progress)
    there = {entry.index for entry in entries}
    lacking = [entry.index for entry in kept if entry.index not in there]
    if lacking:
        raise UsageError(
            f"{name} was planned with {len(kept)} keyframes, of which --stride {stride} leaves out {len(lacking)} "
            f"({few(lacking)}): frames are added to a plan, none is taken away. Leave it out to go on with those, or "
            "give another name (--name)"
        )
    return Choice(entries, stored.fingerprint if len(entries) > len(kept) else "")


def few(indexes: Sequence[int]) -> str:
    """The first of them."""
    shown = ", ".join(str(index) for index in indexes[:FRAMES_SHOWN])
    return f"frame{'s' * (len(indexes) != 1)} {shown}" + (", ..." if len(indexes) > FRAMES_SHOWN else "")


def _kept(recording: Recording, store: Store, stored: StoredPlan, name: str) -> list[FrameEntry]:
    """The frames of the stored plan. Raises UsageError where they are others than they were."""
    known = {entry.index: entry for entry in recording.entries}
    missing = [index for index in stored.frame_indexes if index not in known]
    if recording.total_frames < stored.frame_count:
        what = f"its number of frames is {stored.frame_count}, not {recording.total_frames}"
    elif missing:
        what = f"{few(missing)}, which it was planned with, cannot be used (`semdb recording` says why)"
    else:
        kept = [known[index] for index in stored.frame_indexes]
        if fingerprint(recording, kept) == stored.fingerprint:
            return kept
        what = next(_differences(recording, store, stored, known))
    raise UsageError(f"{name} is stored already and is another one: {what}; {ADVICE}")


def _differences(
    recording: Recording, store: Store, stored: StoredPlan, known: Mapping[int, FrameEntry]
) -> Iterator[str]:
    """What is different between a recording and the keyframes that are stored of it, the plainest first."""
    if recording.format != stored.format:
        yield f"its format is {stored.format}, not {recording.format}"
    heads = store.keyframe_heads(stored.map_id, stored.recording_id, bad=lambda _key, _error: None)
    pairs = [(head, known[head.frame_index]) for head in heads if head.frame_index in known]
    for head, entry in pairs:
        camera = recording.camera_of(entry)
        if not _same_camera(camera, head.camera):
            yield f"its camera was {_camera_text(head.camera)}, and is {_camera_text(camera)} now"
    try:
        scale = store.recording_camera(stored.recording_id)[1]
    except NotFoundError:
        yield "its camera, its depth scale, or names, times or poses of its keyframes are others now"
        return
    if scale is not None and recording.depth_scale is not None and not math.isclose(scale, recording.depth_scale):
        yield f"its depth scale was {number(scale)}, and is {number(recording.depth_scale)} now"
    moved = [entry.index for head, entry in pairs if head.timestamp_ns != entry.timestamp_ns]
    if moved:
        yield f"times of its keyframes are others now ({few(moved)})"
    yield "poses of its keyframes, or names of their files, are others now"


def _same_camera(one: Camera, other: Camera) -> bool:
    """Whether they are, but for rounding. Coefficients of 0 at the end say nothing."""
    numbers = [(*astuple(camera)[:6], *camera.distortion, *[0.0] * 14)[:20] for camera in (one, other)]
    return all(math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-15) for a, b in zip(*numbers, strict=True))


def _camera_text(camera: Camera) -> str:
    return f"{camera.width}x{camera.height} {camera_numbers(camera)}"
