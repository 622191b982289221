"""The last steps that all readers share: choose the camera, and drop the frames whose files cannot be used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.geometry import FARTHEST_POSE_M
from semdb.names import storable
from semdb.recordings.base import DroppedFrame, FrameData, FrameEntry, Recording
from semdb.recordings.camera_files import CAMERA_FILE, find_camera_file
from semdb.recordings.cameras import with_size
from semdb.recordings.focus import NotAmongFramesError, in_focus, is_wanted, told
from semdb.recordings.images import ImageHeader, inspect_file
from semdb.recordings.intrinsics import camera_doubts, camera_problem
from semdb.recordings.lines import TOO_FAR
from semdb.recordings.options import ReadOptions
from semdb.recordings.registration import depth_size
from semdb.shown import number
from semdb.types import Camera

HIGHEST_INDEX = 2**31 - 1  # that the database takes


@dataclass(slots=True)
class Draft:
    """A recording while it is read: frames in the lists, before any image file has been looked at."""

    path: Path
    name: str
    format: str
    total_frames: int
    entries: list[FrameEntry]
    dropped: list[DroppedFrame]
    notes: list[str] = field(default_factory=list)
    depth_registration: str = ""
    categories: Mapping[int, str] | None = None
    known_camera: Camera | None = None  # of the data set; an explicit camera wins over it
    depth_scale: float = 5000.0
    assumed_scale: str = ""  # why that scale, where nothing says it; "" where something does
    assumed: list[str] = field(default_factory=list)  # what is taken for granted, for people
    data: FrameData | None = None  # where images are no files of their own
    contents: tuple[str, ...] = ()


def use_camera_file(draft: Draft, camera: Camera | None, options: ReadOptions, *folders: Path) -> bool:
    """Takes camera and depth scale from the file beside the frames, in one of `folders`; False where there is none.

    `camera` and `options` are what the user gave, which wins. Raises RecordingError for a file that cannot be read,
    unless it is another than ``camera.json`` and there is a `camera`.
    """
    found, there = None, False
    try:
        found = find_camera_file(*folders)
        there = found is not None
    except RecordingError as error:
        if camera is None or any((folder / CAMERA_FILE).exists() for folder in folders):
            raise
        draft.notes.append(f"{error}; --camera is taken")
        there = True
    if found is not None:
        draft.known_camera = found.camera
        draft.assumed_scale = f"{found.path.name} does not say it"
        if found.depth_scale is not None:
            draft.depth_scale, draft.assumed_scale = found.depth_scale, ""
        if found.path.name != CAMERA_FILE and camera is None:
            draft.assumed.append(f"camera: {found.path.name}, as that of colour, depth and poses alike")
    if options.depth_scale is not None:
        draft.depth_scale, draft.assumed_scale = options.depth_scale, ""
    return there


def finish(draft: Draft, camera: Camera | None) -> Recording:
    """Checks headers and ends of all files and makes the `Recording`. `camera` given by the user wins.

    Where entries have cameras of their own, `camera` takes the place of each. Images that are no files of their own
    are not looked at: `known_camera` or `camera` must have their size.
    Raises RecordingError when no frame is left, or the images do not have the size of the camera.
    """
    kept = []
    for entry in draft.entries:
        impossible = _impossible(entry)
        if impossible:
            draft.dropped.append(DroppedFrame(entry.name, impossible))
        else:
            kept.append(entry)
    draft.entries = kept
    if draft.data is None:  # names that are no UTF-8 are for people here; the paths stay as they are
        draft.entries = [_with_storable_name(entry) for entry in draft.entries]
    if in_focus():
        _keep_wanted(draft)
    if draft.data is not None:
        return _finish_data(draft, camera)
    headers, unreadable = _inspect_images(draft.entries)
    draft.dropped += unreadable
    if not headers:
        raise no_usable_frame(draft)
    chosen = _choose_camera(draft, camera, [header for _, header in headers])
    _check_cameras(draft, [entry for entry, _ in headers], chosen, camera)
    usable = []
    for found, header in told(headers, len(draft.entries), len(draft.entries) + len(headers)):
        entry = found if camera is None else replace(found, camera=None)
        own = entry.camera or chosen
        reason = _problem(entry, header, own, depth_size(own, draft.depth_registration))
        if reason:
            draft.dropped.append(DroppedFrame(entry.name, reason))
        else:
            usable.append(entry)
    return _recording(draft, usable, chosen)


def _impossible(entry: FrameEntry) -> str:
    """Why the database would not take a frame; "" where it does."""
    if entry.index > HIGHEST_INDEX:
        return f"its number is too large: at most {HIGHEST_INDEX}"
    pose = entry.world_from_camera
    if pose is not None and not (np.abs(pose[:3, 3]) <= FARTHEST_POSE_M).all():
        return f"its pose {TOO_FAR}"
    return ""


def _with_storable_name(entry: FrameEntry) -> FrameEntry:
    return entry if entry.name.isascii() else replace(entry, name=storable(entry.name))


def _keep_wanted(draft: Draft) -> None:
    """Raises NotAmongFramesError where no frame is wanted."""
    wanted: list[FrameEntry] = []
    for entry in draft.entries:
        if is_wanted(entry.image_path.name if draft.data is None else entry.name, len(wanted)):
            wanted.append(entry)
    if not wanted:
        raise NotAmongFramesError(f"{draft.path}: the recording has no such frame")
    draft.entries = wanted


def _finish_data(draft: Draft, camera: Camera | None) -> Recording:
    chosen = draft.known_camera
    if camera is not None:
        chosen = camera if chosen is None else with_size(camera, (chosen.width, chosen.height))
        draft.entries = [replace(entry, camera=None) for entry in draft.entries]
    if chosen is None or not (chosen.width and chosen.height):
        raise unknown_camera(draft.path)
    _check_cameras(draft, draft.entries, chosen, camera)
    return _recording(draft, draft.entries, chosen)


def _recording(draft: Draft, usable: Sequence[FrameEntry], camera: Camera) -> Recording:
    if not usable:
        raise no_usable_frame(draft)
    if draft.assumed_scale and any(entry.depth_path for entry in usable):
        draft.assumed.append(
            f"depth scale: {number(draft.depth_scale)} per metre ({draft.assumed_scale}); --depth-scale gives another"
        )
    if _stands_still(usable):
        draft.notes.append("the poses of all frames are the same: the camera does not move in them")
    return Recording(
        path=draft.path,
        name=storable(draft.name),
        format=draft.format,
        camera=camera,
        depth_scale=draft.depth_scale,
        total_frames=draft.total_frames,
        entries=tuple(sorted(usable, key=lambda entry: entry.index)),
        dropped=tuple(draft.dropped),
        notes=tuple(draft.notes),
        assumed=tuple(draft.assumed),
        depth_registration=draft.depth_registration if any(entry.depth_path for entry in usable) else "",
        categories=draft.categories,
        data=draft.data,
        contents=draft.contents,
    )


def _stands_still(entries: Sequence[FrameEntry]) -> bool:
    """Whether at least three frames have a pose, and all have the same."""
    poses = [entry.world_from_camera for entry in entries if entry.world_from_camera is not None]
    return len(poses) > 2 and all(np.abs(pose - poses[0]).max() < 1e-9 for pose in poses[1:])


def unknown_camera(path: Path) -> RecordingError:
    """The error for a recording that says nothing of its camera."""
    return RecordingError(f"{path}: the camera is not known; give --camera fx,fy,cx,cy")


def no_usable_frame(draft: Draft) -> RecordingError:
    """The error for a recording of which every frame was dropped."""
    if in_focus():
        return NotAmongFramesError(f"{draft.path}: the recording has no usable frame of those that are wanted")
    if not draft.dropped:
        return RecordingError(f"{draft.path}: the recording lists no frame")
    first = draft.dropped[0]
    return RecordingError(
        f"{draft.path}: none of {draft.total_frames} frames can be used; the first, {first.name}: {first.reason}"
    )


def _inspect_images(
    entries: Sequence[FrameEntry],
) -> tuple[list[tuple[FrameEntry, ImageHeader]], list[DroppedFrame]]:
    headers, dropped = [], []
    for entry in told(entries, 0, 2 * len(entries)):
        try:
            headers.append((entry, inspect_file(entry.image_path)))
        except FrameError as error:
            dropped.append(DroppedFrame(entry.name, f"colour image: {error}"))
    return headers, dropped


def _choose_camera(draft: Draft, camera: Camera | None, headers: Sequence[ImageHeader]) -> Camera:
    size, count = Counter(header.size for header in headers).most_common(1)[0]
    chosen = camera or draft.known_camera or _usual_camera(draft.entries)
    if chosen is None:
        raise unknown_camera(draft.path)
    chosen = with_size(chosen, size)
    if draft.known_camera is None and camera is None:
        return chosen  # each frame has its own
    if (chosen.width, chosen.height) == size or any(h.size == (chosen.width, chosen.height) for h in headers):
        return chosen
    origin = "the given camera" if camera else "the camera of this recording"
    raise RecordingError(
        f"{draft.path}: {count} of {len(headers)} images have {size[0]}x{size[1]} pixels, none the "
        f"{chosen.width}x{chosen.height} of {origin}; give the intrinsics of these images with --camera fx,fy,cx,cy"
    )


def _check_cameras(draft: Draft, entries: Sequence[FrameEntry], chosen: Camera, given: Camera | None) -> None:
    """Refuses intrinsics that nothing has, and says what is to be doubted. Raises UsageError, RecordingError."""
    if given is not None:
        if problem := camera_problem(chosen):
            raise UsageError(f"--camera: {problem}")
    else:
        for camera in {chosen, *(entry.camera for entry in entries if entry.camera is not None)}:
            if problem := camera_problem(camera):
                raise RecordingError(
                    f"{draft.path}: the camera of this recording is impossible: {problem}; --camera gives another"
                )
    draft.assumed += [f"camera: {doubt}" for doubt in camera_doubts(chosen)]


def _usual_camera(entries: Sequence[FrameEntry]) -> Camera | None:
    """The camera that most frames have; None where they name none."""
    cameras = Counter(entry.camera for entry in entries if entry.camera is not None)
    return cameras.most_common(1)[0][0] if cameras else None


def _problem(entry: FrameEntry, header: ImageHeader, camera: Camera, depth: tuple[int, int]) -> str | None:
    """Why a frame with a readable colour header cannot be used; None when it can."""
    checks: tuple[tuple[str, Callable[[], str | None]], ...] = (
        ("colour image", lambda: _wrong_size(header, (camera.width, camera.height))),
        ("depth image", lambda: _grey16_problem(entry.depth_path, depth)),
        ("masks", lambda: _grey16_problem(entry.masks_path, (camera.width, camera.height))),
    )
    for what, check in checks:
        try:
            reason = check()
        except FrameError as error:
            reason = str(error)
        if reason:
            return f"{what}: {reason}"
    return None


def _wrong_size(header: ImageHeader, size: tuple[int, int]) -> str | None:
    if header.size == size:
        return None
    return f"{header.width}x{header.height} pixels instead of {size[0]}x{size[1]}"


def _grey16_problem(path: Path | None, size: tuple[int, int]) -> str | None:
    if path is None:
        return None
    header = inspect_file(path)
    if (header.bits, header.channels) != (16, 1):
        return f"{header.channels} channel(s) of {header.bits} bits instead of one of 16"
    return _wrong_size(header, size)
