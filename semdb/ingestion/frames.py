"""What frames beside the keyframes show, while their recording is at hand (`semdb refine --frames`).

Where keyframes are few, what a query sees was seen from nearer by frames that are none. So many of these as it takes
until every frame has much in common with a keyframe or one of them are described as keyframes are, and kept with a
grey image: without vector and objects, so that nothing is ranked by them. Their poses are kept relative to the nearest
keyframe, which they move with.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semdb.database.frame_views import FrameHead, FrameRow, write_frame_views
from semdb.database.records import KeyframeHead, MapInfo
from semdb.database.store import Store
from semdb.errors import FrameError, NotFoundError, RecordingError, UsageError
from semdb.geometry import invert_pose, pose_distances, pose_error
from semdb.ingestion.keyframes import MIN_OVERLAP, select_keyframes
from semdb.ingestion.plan import fingerprint
from semdb.perception.describe import Describer
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.kept_images import as_jpeg
from semdb.types import FloatArray, Frame, Keypoints

JPEG_QUALITY = 92
MOST_APART_M, MOST_APART_DEG = 0.1, 3.0  # that one keyframe may lie otherwise in the map than the recording says

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class FramesAdded:
    """How many frames of a recording are beside its keyframes now; `failed` could not be read."""

    recording: str
    frames: int
    keyframes: int
    failed: tuple[str, ...]


def add_frames(
    store: Store,
    info: MapInfo,
    recording: Recording,
    describer: Describer,
    *,
    without: Collection[int] = (),
    dtype: str = "auto",
    progress: Progress | None = None,
) -> FramesAdded:
    """Frames of `recording`, which the map holds, in place of those that are there of it: again, the same ones.

    Frames of the indexes `without` are not looked at; `dtype` is that of descriptors. Raises UsageError where the map
    does not hold this recording, RecordingError where it brings no poses or others than those of the keyframes.
    """
    recording_id, known = _keyframes_of(store, info, recording)
    entries = {entry.index: entry for entry in recording.entries}
    kept = [entries[head.frame_index] for head in known]
    _check_poses(recording, known, kept)
    _check_plan(store, info, recording, entries)

    def selecting(done: int, total: int) -> None:
        if progress is not None:
            progress(f"looking at the frames of {recording.name}", done, total)

    there = {entry.index for entry in kept}
    noted = len(recording.decode_failures)
    usable = tuple(entry for entry in recording.entries if entry.index in there or entry.index not in without)
    chosen = select_keyframes(
        replace(recording, entries=usable), keep=kept, min_overlap=MIN_OVERLAP, progress=selecting
    )
    unreadable = [one.reason for one in recording.decode_failures[noted:]]  # their depth, which is compared
    new = [entry for entry in chosen if entry.index not in there]
    rows, failed = [], []
    for done, entry in enumerate(new, start=1):
        try:
            rows += _row(recording.read(entry), recording_id, known, kept, describer)
        except FrameError as error:
            failed.append(str(error))
        if progress is not None:
            progress(f"describing frames of {recording.name}", done, len(new))
    if failed and not rows:
        raise RecordingError(f"{recording.path}: no frame can be used, the first: {failed[0]}")
    count = write_frame_views(store.engine, recording_id, rows, dtype)
    return FramesAdded(recording.name, count, len(kept), (*unreadable, *failed))


def map_with(store: Store, recording: Recording, name: str | None) -> MapInfo:
    """The map of that `name`, or the one that holds a recording of this name. Raises UsageError, NotFoundError."""
    if name is not None:
        return store.find_map(name)
    known = [one.map for one in store.status() if one.name == recording.name]
    if len(known) != 1:
        which = f"the maps {', '.join(known)} hold" if known else "no map holds"
        mend = "name one with --map" if known else "ingest it first"
        raise UsageError(f"{recording.path}: {which} a recording {recording.name!r}: {mend}")
    return store.find_map(known[0])


def _keyframes_of(store: Store, info: MapInfo, recording: Recording) -> tuple[int, list[KeyframeHead]]:
    """The id of `recording` in the map, and its keyframes, by frame."""
    try:
        recording_id = store.find_recording(info.id, recording.name)
    except NotFoundError:
        recording_id = -1
    known = [] if recording_id < 0 else store.keyframe_heads(info.id, recording_id, bad=store.left_out)
    if not known:
        raise UsageError(
            f"{recording.path}: the map {info.name!r} holds no keyframe of a recording {recording.name!r}: ingest it "
            "first, or name the map that holds it with --map"
        )
    there = {entry.index for entry in recording.entries}
    lacking = sum(head.frame_index not in there for head in known)
    if lacking:
        raise RecordingError(
            f"{recording.path}: {lacking} of the {len(known)} keyframes of {recording.name!r} are no usable frames of "
            "it: this is another recording of that name, or is read otherwise than it was ingested"
        )
    return recording_id, sorted(known, key=lambda head: head.frame_index)


def _check_poses(recording: Recording, known: Sequence[KeyframeHead], kept: Sequence[FrameEntry]) -> None:
    """Whether the keyframes lie as the recording says, wherever the whole of it was moved."""
    bases = []
    for head, entry in zip(known, kept, strict=True):
        if entry.world_from_camera is None:
            raise RecordingError(
                f"{recording.path}: it brings no pose of frame {entry.index}, and frames beside the keyframes are "
                "placed by the poses that a recording brings"
            )
        bases.append(head.world_from_camera @ invert_pose(entry.world_from_camera))
    middle = len(bases) // 2
    for head, entry in zip(known, kept, strict=True):
        metres, degrees = pose_error(bases[middle] @ _pose(entry), head.world_from_camera)
        if metres > MOST_APART_M or degrees > MOST_APART_DEG:
            raise RecordingError(
                f"{recording.path}: keyframe {entry.index} lies {metres:.2f} m and {degrees:.1f} deg otherwise in the "
                "map than the recording says: its poses were estimated, or this is another recording"
            )


def _check_plan(store: Store, info: MapInfo, recording: Recording, entries: Mapping[int, FrameEntry]) -> None:
    """Whether camera, depth scale, and times and poses of what was ingested are those of `recording`."""
    plan = store.find_plan(info.name, recording.name)
    if plan is None or not plan.frame_indexes or any(index not in entries for index in plan.frame_indexes):
        return  # it cannot be told; where keyframes are was compared
    planned = [entries[index] for index in plan.frame_indexes]
    unplaced = [replace(entry, world_from_camera=None) for entry in planned]  # of one whose poses were estimated
    if plan.fingerprint not in (fingerprint(recording, planned), fingerprint(recording, unplaced)):
        raise RecordingError(
            f"{recording.whereabouts}: its camera, its depth scale, or names, times or poses of keyframes are not "
            f"those that the map {info.name!r} was ingested with: this is another recording, or is read otherwise "
            "(--camera is as for ingest; its other options are taken by db.add_frames of Python alone, as reading=)"
        )


def _pose(entry: FrameEntry) -> FloatArray:
    assert entry.world_from_camera is not None
    return entry.world_from_camera


def _row(
    frame: Frame, recording_id: int, known: Sequence[KeyframeHead], kept: Sequence[FrameEntry], describer: Describer
) -> list[FrameRow]:
    """The row of a frame; none where nothing is seen in it. Raises FrameError where no keyframe has its camera."""
    assert frame.world_from_camera is not None
    alike = [n for n, head in enumerate(known) if head.camera == frame.camera]
    if not alike:
        raise FrameError(f"{frame.name}: no keyframe of the map has its camera")
    found = describer.describe(frame.image, frame.depth, frame.camera, frame.instances)
    keypoints = found.keypoints
    if not np.isfinite(keypoints.points).all(axis=1).any():
        return []
    distance = pose_distances(frame.world_from_camera, np.stack([_pose(kept[n]) for n in alike]))
    nearest = alike[int(np.argmin(distance))]
    relative = invert_pose(_pose(kept[nearest])) @ frame.world_from_camera
    head = FrameHead(known[nearest].id, frame.index, relative, frame.camera, recording_id)
    on_nothing = np.full(len(keypoints), -1, np.int32)
    bare = Keypoints(keypoints.features, on_nothing, keypoints.points)
    grey = found.grey if found.grey is not None else np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), np.uint8)
    return [FrameRow(head, bare, as_jpeg(grey, JPEG_QUALITY))]
