"""What every reader makes: a `Recording` with the frames that can be used and those that cannot, and why."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError
from semdb.files import only_below, places
from semdb.recordings.images import (
    decode_16bit,
    decode_color,
    encode_16bit,
    encode_color,
    read_bytes,
    remark_on_color,
    remark_on_depth,
    scaled_depth,
)
from semdb.recordings.options import AS_THE_FORMAT_SAYS, ReadOptions
from semdb.recordings.registration import decode_registered_depth
from semdb.types import FROM_MEMORY, Camera, Float32Array, FloatArray, Frame, ImageArray, InstanceMasks


@dataclass(frozen=True, slots=True, eq=False)
class FrameEntry:
    """One usable frame, not yet decoded.

    `index` is stable: 7-Scenes the number in the file name, the other layouts the position (from 0) in the colour
    list sorted by time; it does not depend on which other frames can be used. `world_from_camera` ``[4, 4]`` is
    the colour camera's pose, rotation in SO(3). `turn_rate` ``[3]`` is how the camera turns meanwhile, in radians a
    second in its own frame, where the trajectory is finer than the frames. Paths are those of the files that hold
    the images, which may hold those of other frames too. `camera` is this frame's own, where frames differ in it.
    """

    index: int
    name: str  # of the colour image, relative to the recording
    timestamp_ns: int | None
    image_path: Path
    depth_path: Path | None
    masks_path: Path | None
    world_from_camera: FloatArray | None
    turn_rate: FloatArray | None = None
    camera: Camera | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RawDepth:
    """Depth ``[H, W]`` uint16 registered to the colour image; 0 and 65535 are invalid, `scale` units are a metre.

    `png` is the same as a file, where there is one.
    """

    values: npt.NDArray[np.uint16]
    scale: float
    png: bytes | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RawColor:
    """A colour image as a PNG or JPEG `file`, or as `pixels` ``[H, W, 3]`` RGB uint8 where it was none."""

    file: bytes | None = None
    pixels: ImageArray | None = None


class FrameData(Protocol):
    """Images that are no files of their own: in bags, archives, databases and videos. Several threads may read."""

    def color(self, entry: FrameEntry) -> RawColor:
        """The colour image. Raises FrameError."""

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        """The depth, registered to the colour image; None where there is none. Raises FrameError."""


@dataclass(frozen=True, slots=True)
class DroppedFrame:
    """A frame that cannot be used, and why."""

    name: str
    reason: str


@dataclass(slots=True, eq=False)
class Recording:
    """A recording that was recognised: its usable frames in ascending index, and what was dropped.

    `depth_scale` is units per metre of the depth files, `depth_registration` what `read` does to them ("" nothing),
    `categories` the class of each mask label where the recording has masks. `notes` are for people, and so is what
    of camera, depth and poses is `assumed` because no file says it; `said` is both.
    `decode_failures` collects frames that looked right when the recording was opened but cannot be decoded, `remarks`
    those that can be used but show next to nothing.
    """

    path: Path
    name: str
    format: str  # "tum", "icl_nuim", "seven_scenes" or "synthetic"
    camera: Camera
    depth_scale: float
    total_frames: int
    entries: tuple[FrameEntry, ...]
    dropped: tuple[DroppedFrame, ...]
    notes: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()
    depth_registration: str = ""
    categories: Mapping[int, str] | None = None
    source: str = ""  # what the database keeps of where it came from; "": the folder
    data: FrameData | None = None  # where images are no files of their own
    reading: ReadOptions = AS_THE_FORMAT_SAYS  # what was said by hand of how it is to be read
    takes: frozenset[str] = frozenset()  # the options that mean something to its format
    world_turn: FloatArray | None = None  # by which poses were turned to have z up
    estimated: bool = False  # poses are semdb's: no part of what the recording is
    contents: tuple[str, ...] = ()  # what else the file holds and what is taken of it, a line each for people
    decode_failures: list[DroppedFrame] = field(default_factory=list)
    remarks: list[DroppedFrame] = field(default_factory=list)
    below: tuple[Path, ...] = field(default_factory=places)  # where its files may lie; (): anywhere
    _failed: set[str] = field(default_factory=set)  # names of those

    @property
    def said(self) -> tuple[str, ...]:
        """All that people should know about how the recording was read."""
        return tuple(dict.fromkeys((*self.notes, *self.assumed)))

    @property
    def whereabouts(self) -> str:
        """For messages: its folder, or its name where frames came from memory."""
        return self.name if self.format == FROM_MEMORY else str(self.path)

    def camera_of(self, entry: FrameEntry) -> Camera:
        """The camera of a frame: its own where frames differ in it."""
        return entry.camera or self.camera

    def read(self, entry: FrameEntry) -> Frame:
        """Decodes one frame. Raises FrameError that names the file."""
        image, file = self._color(entry)
        camera = self.camera_of(entry)
        if image.shape[:2] != (camera.height, camera.width):
            raise FrameError(
                f"{self.name_of(entry)}: {image.shape[1]}x{image.shape[0]} pixels, but the camera has "
                f"{camera.width}x{camera.height}"
            )
        depth, depth_bytes, scale = self._depth(entry, with_bytes=True)
        return Frame(
            index=entry.index,
            name=entry.name,
            timestamp_ns=entry.timestamp_ns,
            image=image,
            depth=depth,
            camera=camera,
            world_from_camera=entry.world_from_camera,
            instances=self.read_instances(entry),
            image_bytes=encode_color(image) if file is None else file,
            depth_bytes=depth_bytes,
            depth_scale=scale,
            depth_registration="" if depth is None else self.depth_registration,
        )

    def read_image(self, entry: FrameEntry) -> ImageArray:
        """Only the colour image ``[H, W, 3]``. Raises FrameError that names the file."""
        return self._color(entry)[0]

    def read_depth(self, entry: FrameEntry) -> Float32Array | None:
        """Only the registered depth ``[H, W]`` metres; None where there is none. Raises FrameError."""
        return self._depth(entry, with_bytes=False)[0]

    def name_of(self, entry: FrameEntry) -> str:
        """The image of a frame, for messages."""
        return str(entry.image_path) if self.data is None else f"{self.path}: {entry.name}"

    def read_instances(self, entry: FrameEntry) -> InstanceMasks | None:
        """Only the object masks; None where there are none. Raises FrameError that names the file."""
        if entry.masks_path is None or self.categories is None:
            return None
        name = str(entry.masks_path)
        camera = self.camera_of(entry)
        size = (camera.width, camera.height)
        with only_below(self.below):
            labels = decode_16bit(read_bytes(entry.masks_path), name, size, "an image of masks")
        unknown = sorted(set(np.unique(labels).tolist()) - {0} - set(self.categories))
        if unknown:
            raise FrameError(f"{name}: label {unknown[0]} is not in masks/classes.json")
        return InstanceMasks(labels, self.categories)

    def frames(self) -> Iterator[Frame]:
        """All usable frames, decoded one by one; what cannot be decoded goes to `decode_failures`."""
        for entry in self.entries:
            try:
                frame = self.read(entry)
            except FrameError as error:
                self.note_decode_failure(entry, error)
                continue
            yield frame

    def note_decode_failure(self, entry: FrameEntry, error: FrameError) -> None:
        """Remembers that `entry` cannot be decoded, once."""
        if entry.name not in self._failed:
            self._failed.add(entry.name)
            self.decode_failures.append(DroppedFrame(entry.name, str(error)))

    def note_remarks(self, frame: Frame) -> None:
        """Remembers what people should know of a decoded frame."""
        self.remarks += [DroppedFrame(frame.name, remark) for remark in remarks_on(frame)]

    def trajectory_length(self) -> float:
        """Metres travelled along the usable frames that have a pose."""
        poses = [entry.world_from_camera for entry in self.entries if entry.world_from_camera is not None]
        if len(poses) < 2:
            return 0.0
        positions = np.stack([pose[:3, 3] for pose in poses])
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())

    def _color(self, entry: FrameEntry) -> tuple[ImageArray, bytes | None]:
        """Pixels, and the file where there is one."""
        with only_below(self.below):
            raw = RawColor(file=read_bytes(entry.image_path)) if self.data is None else self.data.color(entry)
        if raw.pixels is not None:
            return raw.pixels, raw.file
        file = raw.file or b""
        return decode_color(file, self.name_of(entry)), file

    def _depth(self, entry: FrameEntry, *, with_bytes: bool) -> tuple[Float32Array | None, bytes | None, float | None]:
        """Registered depth, its file and the file's scale; None where there is none."""
        if entry.depth_path is None:
            return None, None, None
        camera = self.camera_of(entry)
        if self.data is None:
            with only_below(self.below):
                data = read_bytes(entry.depth_path)
            name, scale = str(entry.depth_path), self.depth_scale
            return decode_registered_depth(data, name, scale, self.depth_registration, camera), data, scale
        with only_below(self.below):
            raw = self.data.depth(entry)
        if raw is None:
            return None, None, None
        if raw.values.shape != (camera.height, camera.width):
            height, width = raw.values.shape
            raise FrameError(f"{self.name_of(entry)}: depth of {width}x{height} pixels, but colour has another size")
        file = (raw.png or encode_16bit(raw.values)) if with_bytes else None
        return scaled_depth(raw.values, raw.scale), file, raw.scale


def remarks_on(frame: Frame) -> list[str]:
    """What people should know of a frame that shows next to nothing; empty for others."""
    depth = None if frame.depth is None else remark_on_depth(frame.depth)
    return [remark for remark in (remark_on_color(frame.image), depth) if remark is not None]


@dataclass(frozen=True, slots=True)
class Layout:
    """One kind of recording: how it is recognised and opened. Each has a file of its own in this package.

    `about` says for people what it looks like, `takes` names the fields of `ReadOptions` that can mean something to
    it. `open` gives one recording, or several where the folder holds them.
    """

    name: str
    about: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, Camera | None, ReadOptions], list[Recording]]
    takes: frozenset[str] = frozenset()
