"""Frames that a program has in memory, one by one, become a recording like any other.

A live camera, or a reader of somebody's own files, gives `Frame`s in any number. Which of them become keyframes is
known when all have been seen, so each goes into a folder on disk as it comes, and memory stays flat. What is stored of
a frame are the files that it brings, or lossless ones that are made of its arrays; what is computed is computed of what
is stored, so that rows are those of an ingest from files.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.recordings.arrays import CameraLike, as_camera, as_depth, as_image, as_pose, check_depth_scale
from semdb.recordings.base import DroppedFrame, FrameEntry, Recording
from semdb.recordings.images import encode_16bit, encode_color
from semdb.threads import each
from semdb.types import FROM_MEMORY, Camera, Frame, InstanceMasks

SOURCE = "frames from memory"
DEPTH_SCALE = 5000.0  # of depth without a file: steps of 0.2 mm up to 13.1 m, exact for millimetres and for TUM's
PATIENCE = 10  # frames from the beginning of which one at least must be usable
LARGEST = 65534  # of 16 bits; 65535 is no measurement

Progress = Callable[[int, int], None]  # frames so far, frames in all (0: not known)


def make_frame(
    index: int,
    image: Any,
    *,
    camera: CameraLike,
    depth: Any = None,
    depth_scale: float | None = None,
    world_from_camera: Any = None,
    timestamp_ns: int | None = None,
    name: str = "",
    instances: InstanceMasks | None = None,
) -> Frame:
    """A frame of arrays: `image`, `depth`, `camera` and pose as `semdb.recordings.arrays` takes them.

    `index` is the number of the frame in its recording. A frame without `world_from_camera` is no keyframe. Raises
    FrameError, UsageError.
    """
    where = name or f"frame {index}"
    rgb = as_image(image, where)
    size = (rgb.shape[1], rgb.shape[0])
    return check_frame(
        Frame(
            index=index,
            name=where,
            timestamp_ns=timestamp_ns,
            image=rgb,
            depth=None if depth is None else as_depth(depth, where, size, depth_scale),
            camera=as_camera(camera, size),
            world_from_camera=None if world_from_camera is None else as_pose(world_from_camera, where),
            instances=instances,
        )
    )


def check_frame(frame: Frame) -> Frame:
    """`frame`, its arrays as they must be. Raises FrameError that names it, UsageError for what is no frame at all."""
    if not isinstance(frame, Frame):
        raise UsageError(f"frames are of semdb.Frame (semdb.make_frame makes one), not {type(frame).__name__}")
    name = frame.name or f"frame {frame.index}"
    if isinstance(frame.index, bool) or not isinstance(frame.index, int | np.integer) or frame.index < 0:
        raise FrameError(f"{name}: index={frame.index!r}: the number of a frame, 0 or more, is needed")
    time = frame.timestamp_ns
    if time is not None and (isinstance(time, bool) or not isinstance(time, int | np.integer)):
        raise FrameError(f"{name}: timestamp_ns={time!r}: a whole number of nanoseconds is needed, or None")
    image = as_image(frame.image, name)
    size = (image.shape[1], image.shape[0])
    camera = as_camera(frame.camera, size)
    if (camera.width, camera.height) != size:
        raise FrameError(f"{name}: the image is {size[0]}x{size[1]}, but its camera {camera.width}x{camera.height}")
    return replace(
        frame,
        index=int(frame.index),
        name=name,
        timestamp_ns=None if time is None else int(time),
        image=image,
        depth=None if frame.depth is None else as_depth(frame.depth, name, size),
        camera=camera,
        world_from_camera=None if frame.world_from_camera is None else as_pose(frame.world_from_camera, name),
        instances=_check_instances(frame.instances, name, size),
    )


@contextmanager
def recording_of(
    frames: Iterable[Frame],
    name: str,
    *,
    depth_scale: float | None = None,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> Iterator[Recording]:
    """The recording `name` of `frames`, while the context lasts: its files are in a new folder below `folder`.

    Depth without a file of its own is kept as 16 bits with `depth_scale` units per metre (5000). A frame whose arrays
    cannot be used is dropped, as of files. Raises UsageError for what are no frames, RecordingError where none is
    left, where two have one index, or where they disagree in what a recording has one of.
    """
    where = Path(tempfile.mkdtemp(prefix="semdb-frames-", dir=folder))
    try:
        spool = _Spool(where, check_depth_scale(depth_scale) or DEPTH_SCALE)
        for count, frame in enumerate(frames, 1):
            spool.add(frame)
            if progress is not None:
                progress(count, 0)
        yield spool.recording(name)
    finally:
        shutil.rmtree(where, ignore_errors=True)


@dataclass(slots=True)
class _Spool:
    """Frames on their way into a folder."""

    folder: Path
    own_scale: float  # of depth that brings no file
    entries: dict[int, FrameEntry] = field(default_factory=dict)
    dropped: list[DroppedFrame] = field(default_factory=list)
    camera: Camera | None = None
    depth: tuple[float, str] | None = None  # scale and registration of the depth files
    categories: dict[int, str] = field(default_factory=dict)
    too_far: int = 0

    def add(self, given: Frame) -> None:
        try:
            frame = check_frame(given)
        except FrameError as error:
            self.dropped.append(DroppedFrame(given.name or f"frame {given.index}", str(error)))
            if not self.entries and len(self.dropped) == PATIENCE:
                raise self._none_usable(given.name) from error
            return
        if frame.index in self.entries:
            raise RecordingError(f"{frame.name}: a frame with the index {frame.index} came before; each needs its own")
        self.camera = self.camera or frame.camera
        self._check_depth(frame)
        self._check_masks(frame)
        paths = dict(each(self._write, self._files(frame), 2))  # a live camera does not wait: colour beside depth
        self.entries[frame.index] = FrameEntry(
            index=frame.index,
            name=frame.name,
            timestamp_ns=frame.timestamp_ns,
            image_path=paths["color"],
            depth_path=paths.get("depth"),
            masks_path=paths.get("masks"),
            world_from_camera=frame.world_from_camera,
            camera=None if frame.camera == self.camera else frame.camera,
        )

    def recording(self, name: str) -> Recording:
        total = len(self.entries) + len(self.dropped)
        if self.camera is None:
            raise self._none_usable(name)
        scale, registration = self.depth or (self.own_scale, "")
        return Recording(
            path=self.folder,
            name=name,
            format=FROM_MEMORY,
            camera=self.camera,
            depth_scale=scale,
            total_frames=total,
            entries=tuple(self.entries[index] for index in sorted(self.entries)),
            dropped=tuple(self.dropped),
            notes=self._notes(),
            depth_registration=registration,
            categories=self.categories or None,
            source=SOURCE,
        )

    def _none_usable(self, name: str) -> RecordingError:
        first = f"; the first: {self.dropped[0].reason}" if self.dropped else ""
        return RecordingError(f"{name}: none of {len(self.dropped)} frames can be used{first}")

    def _notes(self) -> tuple[str, ...]:
        if not self.too_far:
            return ()
        limit = LARGEST / self.own_scale
        return (
            f"{self.too_far} frames have depth beyond {limit:.1f} m, which is kept as missing: depth_scale= of the "
            "ingest has steps for it (1000: millimetres up to 65.5 m)",
        )

    def _files(self, frame: Frame) -> list[_File]:
        files = [_File(frame, "color", lambda: frame.image_bytes or encode_color(frame.image))]
        if frame.depth is not None:
            files.append(_File(frame, "depth", lambda: self._depth(frame)))
        if (instances := frame.instances) is not None:
            files.append(_File(frame, "masks", lambda: encode_16bit(instances.labels)))
        return files

    def _write(self, file: _File) -> tuple[str, Path]:
        path = self.folder / f"{file.frame.index:08d}.{file.kind}"
        try:
            path.write_bytes(file.data())
        except OSError as error:
            raise RecordingError(
                f"{file.frame.name}: cannot be kept in {self.folder.parent} while frames come in: {error.strerror}; "
                "TMPDIR names a folder with room"
            ) from error
        return file.kind, path

    def _check_depth(self, frame: Frame) -> None:
        """A recording has one kind of depth files."""
        if frame.depth is None:
            return
        if frame.depth_bytes is not None and frame.depth_scale is None:
            raise RecordingError(f"{frame.name}: has depth_bytes but no depth_scale, units per metre of that file")
        own = (self.own_scale, "")
        kind = own if frame.depth_bytes is None else (float(frame.depth_scale or 0), frame.depth_registration)
        self.depth = self.depth or kind
        if kind != self.depth:
            raise RecordingError(f"{frame.name}: depth of {kind} units per metre, of the frames before {self.depth}")

    def _depth(self, frame: Frame) -> bytes:
        """The file of a frame's depth."""
        if frame.depth_bytes is not None:
            return frame.depth_bytes
        assert frame.depth is not None
        values = np.rint(np.nan_to_num(frame.depth, nan=0.0) * np.float32(self.own_scale))
        beyond = values > LARGEST
        if beyond.any():
            self.too_far += 1
            values[beyond] = 0
        return encode_16bit(values.astype(np.uint16))

    def _check_masks(self, frame: Frame) -> None:
        """A label is one class in all frames."""
        for label, category in ({} if frame.instances is None else frame.instances.categories).items():
            if self.categories.setdefault(int(label), category) != category:
                raise RecordingError(
                    f"{frame.name}: label {label} of its masks is {category!r}, of the frames before "
                    f"{self.categories[int(label)]!r}: a label is one class in all frames"
                )


@dataclass(frozen=True, slots=True)
class _File:
    """A file that is to be written of a frame; `data` makes it."""

    frame: Frame
    kind: str
    data: Callable[[], bytes]


def _check_instances(instances: InstanceMasks | None, name: str, size: tuple[int, int]) -> InstanceMasks | None:
    if instances is None:
        return None
    labels: npt.NDArray[Any] = np.asarray(instances.labels)
    if labels.dtype != np.uint16 or labels.shape != (size[1], size[0]):
        raise FrameError(
            f"{name}: instances.labels must be uint16 [{size[1]}, {size[0]}], not {labels.dtype} {list(labels.shape)}"
        )
    categories: Mapping[int, str] = instances.categories
    present = np.zeros(2**16, np.bool_)
    present[labels] = True
    unknown = sorted(set(np.flatnonzero(present).tolist()) - {0} - set(categories))
    if unknown:
        raise FrameError(f"{name}: instances.categories has no class for the label {unknown[0]}")
    return InstanceMasks(np.ascontiguousarray(labels), categories)
