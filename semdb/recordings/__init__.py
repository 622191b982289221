"""Recordings on disk become `Frame`s. `open_recording` recognises the layout; see docs/recordings.md."""

from __future__ import annotations

from pathlib import Path

from semdb.errors import RecordingError
from semdb.recordings.base import DroppedFrame, FrameEntry, Recording, register_depth
from semdb.recordings.cameras import parse_camera
from semdb.recordings.credentials import refuse_credentials
from semdb.recordings.icl_nuim import is_icl_nuim, open_icl_nuim
from semdb.recordings.images import decode_color, decode_depth, read_depth_image, read_query_image
from semdb.recordings.seven_scenes import find_sequences, is_seven_scenes, open_seven_scenes
from semdb.recordings.tum import is_tum, open_tum
from semdb.types import Camera

__all__ = [
    "DroppedFrame",
    "FrameEntry",
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

LAYOUTS = (
    "known layouts: TUM RGB-D (rgb.txt, depth.txt, groundtruth.txt), ICL-NUIM (associations.txt, *.gt.freiburg), "
    "7-Scenes (frame-XXXXXX.color.png, or folders seq-XX of them)"
)


def open_recordings(path: Path | str, camera: Camera | None = None) -> list[Recording]:
    """All recordings of a folder: one, or one per ``seq-XX`` of a 7-Scenes scene. Nothing is decoded.

    `camera` wins over what the recording says; a width and height of 0 mean those of the images.
    Raises RecordingError that says what is wrong with the folder, or with the file and line.
    """
    folder = Path(path)
    _check_folder(folder)
    if is_icl_nuim(folder):
        return [open_icl_nuim(folder, camera)]
    if is_tum(folder):
        return [open_tum(folder, camera)]
    if is_seven_scenes(folder):
        return [open_seven_scenes(folder, camera)]
    sequences = find_sequences(folder)
    if sequences:
        return [open_seven_scenes(sequence, camera) for sequence in sequences]
    raise _not_a_recording(folder)


def open_recording(path: Path | str, camera: Camera | None = None) -> Recording:
    """The one recording of a folder; see `open_recordings`. Raises RecordingError, also where there are several."""
    folder = Path(path)
    _check_folder(folder)
    if not (is_icl_nuim(folder) or is_tum(folder) or is_seven_scenes(folder)):
        sequences = find_sequences(folder)
        if len(sequences) > 1:
            names = ", ".join(sequence.name for sequence in sequences)
            raise RecordingError(f"{folder}: holds {len(sequences)} recordings ({names}); name one of them")
    return open_recordings(folder, camera)[0]


def _check_folder(folder: Path) -> None:
    refuse_credentials(str(folder))  # a URL where only a folder is taken is shown in the message
    if not folder.exists():
        raise RecordingError(f"{folder}: no such folder")
    if not folder.is_dir():
        raise RecordingError(f"{folder}: is a file; a recording is a folder ({LAYOUTS})")
    try:
        next(folder.iterdir(), None)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be read: {error.strerror}") from error


def _not_a_recording(folder: Path) -> RecordingError:
    children = sorted(folder.iterdir())
    if not children:
        return RecordingError(f"{folder}: the folder is empty; {LAYOUTS}")
    inside = [child.name for child in children if child.is_dir() and _looks_like_recording(child)]
    if inside:
        return RecordingError(
            f"{folder}: is no recording itself, but these folders in it are: {', '.join(inside[:10])}"
        )
    if (folder / "depth.txt").exists() or (folder / "groundtruth.txt").exists():
        return RecordingError(f"{folder / 'rgb.txt'}: the file is missing; the TUM layout needs it")
    return RecordingError(f"{folder}: is no recording that semdb knows; {LAYOUTS}")


def _looks_like_recording(folder: Path) -> bool:
    try:
        return is_icl_nuim(folder) or is_tum(folder) or is_seven_scenes(folder) or bool(find_sequences(folder))
    except OSError:
        return False
