"""The last steps that all readers share: choose the camera, and drop the frames whose files cannot be used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from semdb.errors import FrameError, RecordingError
from semdb.recordings.base import DroppedFrame, FrameEntry, Recording, depth_size
from semdb.recordings.cameras import with_size
from semdb.recordings.images import ImageHeader, inspect_file
from semdb.types import Camera


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


def finish(draft: Draft, camera: Camera | None) -> Recording:
    """Checks headers and ends of all files and makes the `Recording`. `camera` given by the user wins.

    Raises RecordingError when no frame is left, or the images do not have the size of the camera.
    """
    headers, unreadable = _inspect_images(draft.entries)
    draft.dropped += unreadable
    if not headers:
        raise no_usable_frame(draft)
    chosen = _choose_camera(draft, camera, [header for _, header in headers])
    usable = []
    for entry, header in headers:
        reason = _problem(entry, header, chosen, depth_size(chosen, draft.depth_registration))
        if reason:
            draft.dropped.append(DroppedFrame(entry.name, reason))
        else:
            usable.append(entry)
    if not usable:
        raise no_usable_frame(draft)
    return Recording(
        path=draft.path,
        name=draft.name,
        format=draft.format,
        camera=chosen,
        depth_scale=draft.depth_scale,
        total_frames=draft.total_frames,
        entries=tuple(sorted(usable, key=lambda entry: entry.index)),
        dropped=tuple(draft.dropped),
        notes=tuple(draft.notes),
        depth_registration=draft.depth_registration if any(entry.depth_path for entry in usable) else "",
        categories=draft.categories,
    )


def no_usable_frame(draft: Draft) -> RecordingError:
    """The error for a recording of which every frame was dropped."""
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
    for entry in entries:
        try:
            headers.append((entry, inspect_file(entry.image_path)))
        except FrameError as error:
            dropped.append(DroppedFrame(entry.name, f"colour image: {error}"))
    return headers, dropped


def _choose_camera(draft: Draft, camera: Camera | None, headers: Sequence[ImageHeader]) -> Camera:
    size, count = Counter(header.size for header in headers).most_common(1)[0]
    chosen = camera or draft.known_camera
    if chosen is None:
        raise RecordingError(f"{draft.path}: the camera is not known; give --camera fx,fy,cx,cy")
    chosen = with_size(chosen, size)
    if (chosen.width, chosen.height) == size or any(h.size == (chosen.width, chosen.height) for h in headers):
        return chosen
    origin = "the given camera" if camera else "the camera of this recording"
    raise RecordingError(
        f"{draft.path}: {count} of {len(headers)} images have {size[0]}x{size[1]} pixels, none the "
        f"{chosen.width}x{chosen.height} of {origin}; give the intrinsics of these images with --camera fx,fy,cx,cy"
    )


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
