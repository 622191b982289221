"""What an export asks of a map: its keyframes in the order of recordings and frames, a few at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from semdb.database.records import KeyframeHead, StoredImage, StoredKeyframe
from semdb.database.store import Store
from semdb.errors import UsageError
from semdb.recordings import decode_color
from semdb.recordings.registration import decode_registered_depth
from semdb.types import Float32Array, ImageArray

CHUNK = 32
NAME_BYTES = 100  # of a folder: file systems take 255, of which a letter may need four
Progress = Callable[[str, int, int], None]


@dataclass(slots=True, eq=False)
class MapSource:
    """A map that is exported. Nothing of it is kept in memory but the heads of keyframes: pose, camera, time."""

    store: Store
    map_id: int
    name: str
    heads: list[KeyframeHead]
    folders: dict[str, str]  # a name that any file system takes for each recording
    progress: Progress | None = None

    @classmethod
    def of(cls, store: Store, map_name: str, progress: Progress | None = None) -> MapSource:
        """The map of that name. Raises NotFoundError, UsageError for a map without keyframes."""
        found = store.find_map(map_name)
        heads = store.keyframe_heads(map_id=found.id)
        if not heads:
            raise UsageError(f"the map {map_name!r} has no keyframes: there is nothing to export")
        heads.sort(key=lambda head: (head.recording, head.frame_index))
        return cls(store, found.id, map_name, heads, folder_names({head.recording: None for head in heads}), progress)

    def tell(self, what: str, done: int, total: int | None = None) -> None:
        """Tells of progress."""
        if self.progress is not None:
            self.progress(f"{what} {self.name}", done, len(self.heads) if total is None else total)

    def keyframes(self, *, descriptors: bool) -> Iterator[StoredKeyframe]:
        """All keyframes with objects and keypoints, in the order of `heads`."""
        for start in range(0, len(self.heads), CHUNK):
            ids = [head.id for head in self.heads[start : start + CHUNK]]
            yield from self.store.load_keyframes(ids, descriptors=descriptors)

    def file_name(self, head: KeyframeHead, suffix: str) -> str:
        """A name for a file of a keyframe that no other one has: ``RECORDING/000012.jpg``."""
        return f"{self.folders[head.recording]}/{head.frame_index:06d}{suffix}"

    def image(self, keyframe_id: int) -> StoredImage:
        """The files of a keyframe."""
        return self.store.load_image(keyframe_id)

    def refined(self, keyframe_ids: list[int]) -> dict[int, Float32Array]:
        """Refined points of keyframes, X, Y, Z and sigma of Z ``[n, 4]`` in the order of keypoints."""
        return self.store.refined_points(keyframe_ids)


def decoded(image: StoredImage, head: KeyframeHead) -> tuple[ImageArray, Float32Array | None]:
    """Colour ``[H, W, 3]`` and registered depth ``[H, W]`` metres of a keyframe. Raises FrameError."""
    name = f"keyframe {head.id}"
    pixels = decode_color(image.rgb, name)
    if image.depth is None or image.depth_scale is None:
        return pixels, None
    scale, registration = image.depth_scale, image.depth_registration
    return pixels, decode_registered_depth(image.depth, name, scale, registration, head.camera)


def folder_names(recordings: Iterable[str]) -> dict[str, str]:
    """A folder for each recording: its name without what no path may have, and a number where two would be one."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in recordings:
        safe = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in name).strip(".")
        safe = safe.encode()[:NAME_BYTES].decode(errors="ignore")
        own, number = safe or "recording", 1
        while own.lower() in taken:
            number += 1
            own = f"{safe or 'recording'}-{number}"
        taken.add(own.lower())
        found[name] = own
    return found


def suffix_of(kind: str) -> str:
    """The suffix of a stored image's format."""
    return {"jpeg": ".jpg", "png": ".png"}.get(kind, ".img")


def new_folder(path: Path) -> Path:
    """Makes an empty folder. Raises UsageError where something is there already."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UsageError(f"{path}: is there already: name a folder that is not there or is empty")
    path.mkdir(parents=True, exist_ok=True)
    return path


def new_file(path: Path) -> Path:
    """A file that can be written. Raises UsageError where something is there already, or there is no folder for it."""
    if path.exists():
        raise UsageError(f"{path}: is there already: name another file")
    if not path.parent.is_dir():
        raise UsageError(f"{path.parent}: there is no such folder")
    return path


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """`voxel_m` thins clouds, `stride` samples depth pixels, `max_depth_m` leaves out what is farther.

    `landmarks` draws the boxes of landmarks into clouds.
    """

    voxel_m: float = 0.02
    stride: int = 4
    max_depth_m: float = 8.0
    landmarks: bool = False


class Exporter(Protocol):
    """Writes a map to `out`; returns a line for people about what was written."""

    def __call__(self, source: MapSource, out: Path, options: ExportOptions) -> str: ...


def camera_centres(heads: list[KeyframeHead]) -> Float32Array:
    """Positions ``[n, 3]`` of keyframes in the map."""
    return np.stack([head.world_from_camera[:3, 3] for head in heads]).astype(np.float32)
