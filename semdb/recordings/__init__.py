"""Recordings on disk become `Frame`s. `open_recording` recognises the layout; see docs/recordings.md."""

from __future__ import annotations

from pathlib import Path

from semdb.errors import RecordingError
from semdb.recordings.base import DroppedFrame, FrameEntry, Recording
from semdb.recordings.cameras import parse_camera
from semdb.recordings.credentials import refuse_credentials
from semdb.recordings.images import decode_color, decode_depth, read_depth_image, read_query_image
from semdb.recordings.layouts import find_layout, not_a_recording, open_with
from semdb.recordings.options import ReadOptions
from semdb.recordings.registration import register_depth
from semdb.types import Camera

__all__ = [
    "DroppedFrame",
    "FrameEntry",
    "ReadOptions",
    "Recording",
    "decode_color",
    "decode_depth",
    "open_recording",
    "open_recordings",
    "parse_camera",
    "read_depth_image",
    "read_query_image",
    "register_depth",
]


def open_recordings(
    path: Path | str, camera: Camera | None = None, options: ReadOptions | None = None
) -> list[Recording]:
    """All recordings of a folder or file: one, or one per ``seq-XX`` of a 7-Scenes scene. Nothing is decoded.

    `camera` wins over what the recording says; a width and height of 0 mean those of the images. `options` say what
    the files do not. Raises RecordingError that says what is wrong with the folder, or with the file and line.
    """
    where = Path(path)
    _check(where)
    layout = find_layout(where)
    if layout is None:
        raise not_a_recording(where)
    return open_with(layout, where, camera, options or ReadOptions())


def open_recording(path: Path | str, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """The one recording of a folder or file; see `open_recordings`. Raises RecordingError, also for several."""
    found = open_recordings(path, camera, options)
    if len(found) > 1:
        names = ", ".join(recording.path.name for recording in found)
        raise RecordingError(f"{path}: holds {len(found)} recordings ({names}); name one of them")
    return found[0]


def _check(path: Path) -> None:
    refuse_credentials(str(path))  # a URL where only a folder is taken is shown in the message
    if not path.exists():
        raise RecordingError(f"{path}: no such folder or file")
    if not path.is_dir() and not path.is_file():
        raise RecordingError(f"{path}: is neither a folder nor a regular file")
    try:
        if path.is_dir():
            next(path.iterdir(), None)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
