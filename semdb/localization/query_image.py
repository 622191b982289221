"""A query image with all that must be known of it: its camera, its depth, its masks. Nothing is guessed silently."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.recordings import decode_color, decode_depth, open_recordings, read_depth_image, read_query_image
from semdb.recordings.arrays import as_depth, as_image, check_depth_scale
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.cameras import with_size
from semdb.recordings.memory import check_frame
from semdb.types import Camera, Float32Array, FloatArray, Frame, ImageArray, InstanceMasks

Say = Callable[[str], None]
PathText = str | PathLike[str]
Image = PathText | bytes | npt.NDArray[Any] | Frame  # bytes are those of a file
Depth = PathText | bytes | npt.NDArray[Any]
KEPT = 16  # recordings whose lists of frames are remembered


@dataclass(frozen=True, slots=True, eq=False)
class QueryImage:
    """`name` is the path of a file, or what the image in memory is to be called.

    `world_from_camera` is the true pose where the image belongs to a recording that has one: for pictures only.
    Of a frame of a recording `frame_index` is its number, `timestamp_ns` its time where the recording has times.
    """

    name: str
    image: ImageArray
    camera: Camera
    depth: Float32Array | None
    instances: InstanceMasks | None
    world_from_camera: FloatArray | None
    frame_index: int | None = None
    timestamp_ns: int | None = None


@dataclass(frozen=True, slots=True)
class LikeCamera:
    """A camera to take for images without one, its depth scale, and where it comes from."""

    camera: Camera
    depth_scale: float | None
    origin: str


class RecordingsOnDisk:
    """The recordings that images lie in, each opened once, and again when its folders have changed. Thread-safe."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._kept: OrderedDict[Path, tuple[object, tuple[Recording, dict[Path, FrameEntry]] | None]] = OrderedDict()
        self._like: tuple[object, LikeCamera] | None = None

    def around(self, path: Path) -> tuple[Recording, FrameEntry] | None:
        """The recording around an image (its folder, or the one above) and the image's entry in it."""
        absolute = path.resolve()
        for folder in (absolute.parent, absolute.parent.parent):
            found = self._open(folder, (_changed(folder), _changed(absolute.parent)))
            if found is not None and absolute in found[1]:
                return found[0], found[1][absolute]
        return None

    def camera_like(self, path: Path) -> LikeCamera:
        """The camera of the recording at `path`, of the first one where there are several. Raises RecordingError."""
        state = path, _changed(path)
        with self._turn:
            if self._like is None or self._like[0] != state:
                recording = open_recordings(path)[0]
                self._like = state, LikeCamera(recording.camera, recording.depth_scale, str(recording.path))
            return self._like[1]

    def _open(self, folder: Path, state: object) -> tuple[Recording, dict[Path, FrameEntry]] | None:
        with self._turn:
            known = self._kept.get(folder)
            if known is None or known[0] != state:
                known = self._kept[folder] = state, _open_or_none(folder)
            self._kept.move_to_end(folder)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return known[1]


class QueryReader:
    """Makes query images of files, arrays and frames.

    The camera is, in this order, `camera` (from ``--camera``), that of a frame, that of `like` (from ``--like``), that
    of the recording on disk that the image belongs to, `known` when all the map's keyframes have one camera of that
    size. Depth has `depth_scale` units per metre, or those of `like`, or of the recording; floats in memory are metres.
    With `nominal` an image without depth whose camera is not known gets that of a usual lens, for where nothing is
    measured.
    """

    def __init__(
        self,
        *,
        camera: Camera | None = None,
        like: LikeCamera | None = None,
        known: Callable[[], Sequence[Camera]] = tuple,
        depth_scale: float | None = None,
        on_disk: RecordingsOnDisk | None = None,
        say: Say | None = None,
        nominal: bool = False,
    ) -> None:
        self._nominal = nominal
        self._camera = camera
        self._like = like
        self._known = known
        self._depth_scale = check_depth_scale(depth_scale)
        self._on_disk = on_disk or RecordingsOnDisk()
        self._say = say or (lambda line: None)
        self._said: set[str] = set()

    def read(
        self, image: Image, depth: Depth | None = None, name: str | None = None, number: int | None = None
    ) -> QueryImage:
        """The `image`, with `depth` that must be registered to it and of its size.

        `name` is of one in memory; without, it is called by its `number`.

        Raises FrameError for what cannot be read, or whose camera is not known, UsageError for depth of unknown units.
        """
        if isinstance(image, Frame):
            return self._of_frame(image, depth, name)
        if isinstance(image, str | PathLike):
            return self._of_file(Path(image), depth)
        name = name or ("image" if number is None else f"image {number}")
        pixels = decode_color(image, name) if isinstance(image, bytes) else as_image(image, name)
        size = (pixels.shape[1], pixels.shape[0])
        camera, scale = self._camera_of(name, size, None, "camera=(fx, fy, cx, cy), or like=RECORDING")
        return QueryImage(name, pixels, camera, self._read_depth(depth, name, size, scale), None, None)

    def _of_file(self, path: Path, depth: Depth | None) -> QueryImage:
        image = read_query_image(path)
        size = (image.shape[1], image.shape[0])
        found = self._on_disk.around(path)
        way_out = "--camera fx,fy,cx,cy[,k1,k2,p1,p2,k3], or --like RECORDING"
        camera, scale = self._camera_of(str(path), size, found, way_out)
        depth_image = self._read_depth(depth, str(path), size, scale)
        instances, pose, index, time = None, None, None, None
        if found is not None:
            recording, entry = found
            pose, index, time = entry.world_from_camera, entry.index, entry.timestamp_ns
            instances = recording.read_instances(entry)
        return QueryImage(str(path), image, camera, depth_image, instances, pose, index, time)

    def _of_frame(self, given: Frame, depth: Depth | None, name: str | None) -> QueryImage:
        frame = check_frame(given)
        size = (frame.image.shape[1], frame.image.shape[0])
        camera = frame.camera if self._camera is None else with_size(self._camera, size)
        scale = self._depth_scale or (None if self._like is None else self._like.depth_scale)
        found = frame.depth if depth is None else self._read_depth(depth, frame.name, size, scale)
        return QueryImage(
            name or frame.name,
            frame.image,
            camera,
            found,
            frame.instances,
            frame.world_from_camera,
            frame.index,
            frame.timestamp_ns,
        )

    def _read_depth(
        self, depth: Depth | None, name: str, size: tuple[int, int], scale: float | None
    ) -> Float32Array | None:
        """Metres ``[H, W]``; `scale` is that of files and integers."""
        if depth is None:
            return None
        if isinstance(depth, str | PathLike):
            if scale is None:
                raise UsageError(
                    f"the depth scale of {depth} is not known: name a recording like it with --like RECORDING"
                )
            return read_depth_image(Path(depth), scale, size)
        name = f"depth of {name}"
        if isinstance(depth, bytes):
            if scale is None:
                raise UsageError(f"the scale of the {name} is not known: give depth_scale=, units per metre, or like=")
            return decode_depth(depth, name, scale, size)
        whole = np.issubdtype(np.asarray(depth).dtype, np.integer)
        return as_depth(depth, name, size, scale if whole else self._depth_scale)

    def _camera_of(
        self, name: str, size: tuple[int, int], found: tuple[Recording, FrameEntry] | None, way_out: str
    ) -> tuple[Camera, float | None]:
        like_scale = None if self._like is None else self._like.depth_scale
        scale = self._depth_scale or like_scale or (found[0].depth_scale if found else None)
        if self._camera is not None:
            return with_size(self._camera, size), scale
        if self._like is not None:
            _check_size(self._like.camera, size, name, self._like.origin)
            return self._like.camera, scale
        if found is not None:
            self._tell(f"camera of the images: that of the recording {found[0].path} they belong to")
            own = found[0].camera_of(found[1])
            _check_size(own, size, name, str(found[0].path))
            return own, scale
        fitting = {camera for camera in self._known() if (camera.width, camera.height) == size}
        if len(fitting) == 1:
            self._tell("camera of the images: that of the map's keyframes (--camera or --like name another)")
            return fitting.pop(), scale
        if self._nominal:
            return Camera(*size, size[0], size[0], (size[0] - 1) / 2, (size[1] - 1) / 2), scale
        raise FrameError(f"the camera of {name} ({size[0]}x{size[1]}) is not known: give {way_out}")

    def _tell(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._say(line)


def _check_size(camera: Camera, size: tuple[int, int], name: str, origin: str) -> None:
    if (camera.width, camera.height) != size:
        raise FrameError(
            f"{name} is {size[0]}x{size[1]}, but the camera of {origin} is {camera.width}x{camera.height}: "
            "give --camera fx,fy,cx,cy"
        )


def _changed(folder: Path) -> int:
    """When names in a folder last changed; 0 where that cannot be known."""
    try:
        return folder.stat().st_mtime_ns
    except OSError:
        return 0


def _open_or_none(folder: Path) -> tuple[Recording, dict[Path, FrameEntry]] | None:
    """The one recording in `folder` with its frames by the path of their image; None where there is none."""
    try:
        recordings = open_recordings(folder)
    except RecordingError:
        return None
    if len(recordings) != 1:
        return None
    return recordings[0], {entry.image_path.resolve(): entry for entry in recordings[0].entries}
