"""The recordings that images lie in: their camera, their masks and, for pictures, their true poses."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path

from semdb.errors import RecordingError
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.focus import NotAmongFramesError, only_images
from semdb.recordings.layouts import find_layout, open_with
from semdb.recordings.options import ReadOptions
from semdb.types import Camera

KEPT = 16  # folders of which is remembered what was found
MOST_FOUND = 4096  # frames that are remembered of a folder


@dataclass(frozen=True, slots=True)
class LikeCamera:
    """A camera to take for images without one, its depth scale, where it comes from, and what of it is `assumed`."""

    camera: Camera
    depth_scale: float | None
    origin: str
    assumed: tuple[str, ...] = ()


@dataclass(slots=True)
class _Folder:
    """What was found in a folder whose state was `state`: frames by the path of their image, or None."""

    state: object
    found: dict[Path, tuple[Recording, FrameEntry] | None] = field(default_factory=dict)
    refused: str | None = None


class RecordingsOnDisk:
    """Looks images up in the recordings around them: only these frames are looked at, and remembered. Thread-safe."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._kept: OrderedDict[Path, _Folder] = OrderedDict()
        self._like: tuple[object, LikeCamera] | None = None

    def around(
        self, path: Path, others: Collection[Path] = (), say: Callable[[str], None] | None = None
    ) -> tuple[Recording, FrameEntry] | None:
        """The recording around an image (its folder, or the one above) and the image's entry in it.

        `others` are images that will be asked for next: those in the same folder are looked up at once. A recording
        that is there and cannot be used is told to `say`.
        """
        named, real = Path(os.path.abspath(path)), path.resolve()
        for folder in dict.fromkeys((named.parent, named.parent.parent, real.parent, real.parent.parent)):
            looked_up = self._look_up(folder, path, others)
            if looked_up.refused is not None and say is not None:
                say(f"the recording around {path} is not used: {looked_up.refused}")
            found = looked_up.found.get(real)
            if found is not None:
                return found
        return None

    def camera_like(self, path: Path) -> LikeCamera:
        """The camera of the recording at `path`, of the first one where there are several. Raises RecordingError."""
        state = path, _changed(path)
        with self._turn:
            if self._like is None or self._like[0] != state:
                with only_images(None):
                    recording = open_recordings(path)[0]
                like = LikeCamera(recording.camera, recording.depth_scale, str(recording.path), recording.assumed)
                self._like = state, like
            return self._like[1]

    def _look_up(self, folder: Path, path: Path, others: Collection[Path]) -> _Folder:
        state = _changed(folder), _changed(path.resolve().parent)
        with self._turn:
            known = self._kept.get(folder)
            if known is None or known.state != state or len(known.found) > MOST_FOUND:
                known = self._kept[folder] = _Folder(state)
            self._kept.move_to_end(folder)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            if path.resolve() not in known.found:
                here = [other for other in others if other.parent == path.parent][:MOST_FOUND]
                _find(folder, [path, *(other for other in here if other.resolve() not in known.found)], known)
            return known


def _find(folder: Path, paths: Collection[Path], known: _Folder) -> None:
    """Puts into `known` the frames of the images `paths` in the one recording that `folder` is."""
    wanted = {path.resolve() for path in paths}
    known.found.update(dict.fromkeys(wanted))
    try:
        layout = find_layout(folder) if folder.is_dir() else None
        if layout is None:
            return
        with only_images({path.name for path in (*paths, *wanted)}):
            recordings = open_with(layout, folder, None, ReadOptions())
    except NotAmongFramesError:
        return
    except (RecordingError, OSError) as error:
        known.refused = str(error)
        return
    if len(recordings) == 1:
        entries = {entry.image_path.resolve(): entry for entry in recordings[0].entries}
        known.found.update({path: (recordings[0], entries[path]) for path in wanted if path in entries})


def _changed(folder: Path) -> int:
    """When names in a folder last changed; 0 where that cannot be known."""
    try:
        return folder.stat().st_mtime_ns
    except OSError:
        return 0
