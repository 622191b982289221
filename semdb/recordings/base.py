"""What every reader makes: a `Recording` with the frames that can be used and those that cannot, and why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from semdb.errors import FrameError
from semdb.recordings.cameras import SEVEN_SCENES_DEPTH
from semdb.recordings.images import decode_16bit, decode_color, decode_depth, read_bytes
from semdb.types import Camera, Float32Array, FloatArray, Frame, ImageArray, InstanceMasks

REGISTRATION_7SCENES = "7scenes"


@dataclass(frozen=True, slots=True, eq=False)
class FrameEntry:
    """One usable frame, not yet decoded.

    `index` is stable: 7-Scenes the number in the file name, the other layouts the position (from 0) in the colour
    list sorted by time; it does not depend on which other frames can be used. `world_from_camera` ``[4, 4]`` is
    the colour camera's pose, rotation in SO(3). `turn_rate` ``[3]`` is how the camera turns meanwhile, in radians a
    second in its own frame, where the trajectory is finer than the frames.
    """

    index: int
    name: str  # of the colour image, relative to the recording
    timestamp_ns: int | None
    image_path: Path
    depth_path: Path | None
    masks_path: Path | None
    world_from_camera: FloatArray | None
    turn_rate: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class DroppedFrame:
    """A frame that cannot be used, and why."""

    name: str
    reason: str


def depth_size(camera: Camera, registration: str) -> tuple[int, int]:
    """Width and height that depth files must have: of the depth camera where one registers, else of `camera`."""
    if registration == REGISTRATION_7SCENES:
        return SEVEN_SCENES_DEPTH.width, SEVEN_SCENES_DEPTH.height
    return camera.width, camera.height


def register_depth(depth: Float32Array, registration: str, camera: Camera) -> Float32Array:
    """Depth as `decode_depth` gives it, registered to the colour `camera` as `registration` names ("" does nothing).

    Raises FrameError for a registration of another version.
    """
    if registration == "":
        return depth
    if registration != REGISTRATION_7SCENES:
        raise FrameError(f"unknown depth registration {registration!r}; known are '' and {REGISTRATION_7SCENES!r}")
    from semdb.recordings.registration import register_seven_scenes

    return register_seven_scenes(depth, camera)


@dataclass(slots=True, eq=False)
class Recording:
    """A recording that was recognised: its usable frames in ascending index, and what was dropped.

    `depth_scale` is units per metre of the depth files, `depth_registration` what `read` does to them ("" nothing),
    `categories` the class of each mask label where the recording has masks. `notes` are for people.
    `decode_failures` collects frames that looked right when the recording was opened but cannot be decoded.
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
    depth_registration: str = ""
    categories: Mapping[int, str] | None = None
    source: str = ""  # what the database keeps of where it came from; "": the folder
    decode_failures: list[DroppedFrame] = field(default_factory=list)

    def read(self, entry: FrameEntry) -> Frame:
        """Decodes one frame. Raises FrameError that names the file."""
        image_bytes = read_bytes(entry.image_path)
        image = decode_color(image_bytes, str(entry.image_path))
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise FrameError(
                f"{entry.image_path}: {image.shape[1]}x{image.shape[0]} pixels, but the camera has "
                f"{self.camera.width}x{self.camera.height}"
            )
        depth_bytes = None if entry.depth_path is None else read_bytes(entry.depth_path)
        return Frame(
            index=entry.index,
            name=entry.name,
            timestamp_ns=entry.timestamp_ns,
            image=image,
            depth=None if depth_bytes is None else self._decode_depth(depth_bytes, entry),
            camera=self.camera,
            world_from_camera=entry.world_from_camera,
            instances=self.read_instances(entry),
            image_bytes=image_bytes,
            depth_bytes=depth_bytes,
            depth_scale=None if depth_bytes is None else self.depth_scale,
            depth_registration="" if depth_bytes is None else self.depth_registration,
        )

    def read_image(self, entry: FrameEntry) -> ImageArray:
        """Only the colour image ``[H, W, 3]``. Raises FrameError that names the file."""
        return decode_color(read_bytes(entry.image_path), str(entry.image_path))

    def read_depth(self, entry: FrameEntry) -> Float32Array | None:
        """Only the registered depth ``[H, W]`` metres; None where there is none. Raises FrameError."""
        if entry.depth_path is None:
            return None
        return self._decode_depth(read_bytes(entry.depth_path), entry)

    def read_instances(self, entry: FrameEntry) -> InstanceMasks | None:
        """Only the object masks; None where there are none. Raises FrameError that names the file."""
        if entry.masks_path is None or self.categories is None:
            return None
        name = str(entry.masks_path)
        size = (self.camera.width, self.camera.height)
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
        if all(failure.name != entry.name for failure in self.decode_failures):
            self.decode_failures.append(DroppedFrame(entry.name, str(error)))

    def trajectory_length(self) -> float:
        """Metres travelled along the usable frames that have a pose."""
        poses = [entry.world_from_camera for entry in self.entries if entry.world_from_camera is not None]
        if len(poses) < 2:
            return 0.0
        positions = np.stack([pose[:3, 3] for pose in poses])
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())

    def _decode_depth(self, data: bytes, entry: FrameEntry) -> Float32Array:
        size = depth_size(self.camera, self.depth_registration)
        depth = decode_depth(data, str(entry.depth_path), self.depth_scale, size)
        return register_depth(depth, self.depth_registration, self.camera)
