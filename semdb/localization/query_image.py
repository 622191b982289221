"""A query image with all that must be known of it: its camera, its depth, its masks. Nothing is guessed silently."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.database.records import UsedCamera
from semdb.errors import FrameError, UsageError
from semdb.localization.on_disk import LikeCamera, RecordingsOnDisk
from semdb.localization.query_scale import (
    reduced_camera,
    reduction_of,
    smaller_camera,
    smaller_image,
    smaller_values,
    times_finer,
)
from semdb.recordings import decode_color, decode_depth, read_depth_image
from semdb.recordings.arrays import as_depth, as_image, check_depth_scale
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.cameras import with_size
from semdb.recordings.images import header_of, orientation_of, read_bytes, remark_on_color, remark_on_depth
from semdb.recordings.intrinsics import camera_doubts, camera_problem, depth_scale_problem
from semdb.recordings.memory import check_frame
from semdb.shown import camera_numbers
from semdb.types import Camera, Float32Array, FloatArray, Frame, ImageArray, InstanceMasks

Say = Callable[[str], None]
PathText = str | PathLike[str]
Image = PathText | bytes | npt.NDArray[Any] | Frame  # bytes are those of a file
Depth = PathText | bytes | npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class _WayOut:
    """How whoever asks says what is not known."""

    camera: str
    map: str


_IN_MEMORY = _WayOut("camera=(fx, fy, cx, cy), or like=RECORDING", "map=")
_IN_FILES = _WayOut("--camera fx,fy,cx,cy[,k1,k2,p1,p2,k3], or --like RECORDING", "--map")


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


class QueryReader:
    """Makes query images of files, arrays and frames.

    The camera is, in this order, `camera` (from ``--camera``), that of a frame, that of `like` (from ``--like``), that
    of the recording on disk that the image belongs to, `known` when all the map's keyframes have one camera of that
    size; `used` says whose these are where there are several. Depth has `depth_scale` units per metre, or those of
    `like`, or of the recording; floats in memory are metres. An image that is larger than the map's, and finer, comes
    at their scale (see `query_scale`). `paths` are the files that will be read, where they are known before. With
    `nominal` an image without depth whose camera is not known gets that of a usual lens, for where nothing is measured.
    """

    def __init__(
        self,
        *,
        camera: Camera | None = None,
        like: LikeCamera | None = None,
        known: Callable[[], Sequence[Camera]] = tuple,
        used: Callable[[], Sequence[UsedCamera]] = tuple,
        depth_scale: float | None = None,
        on_disk: RecordingsOnDisk | None = None,
        paths: Collection[Path] = (),
        say: Say | None = None,
        nominal: bool = False,
    ) -> None:
        self._nominal = nominal
        self._camera = camera
        self._like = like
        self._known = known
        self._used = used
        self._cameras: Sequence[Camera] | None = None  # those, once asked for
        self._paths = paths
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
        if isinstance(image, bytes):
            return self._of_bytes(image, name, depth, None, _IN_MEMORY)
        pixels = as_image(image, name)
        size = (pixels.shape[1], pixels.shape[0])
        camera, scale = self._camera_of(name, size, None, _IN_MEMORY)
        found = self._read_depth(depth, name, size, scale)
        return self._at_scale_of_map(QueryImage(name, pixels, camera, found, None, None))

    def _of_file(self, path: Path, depth: Depth | None) -> QueryImage:
        data = read_bytes(path)
        found = self._on_disk.around(path, self._paths, self.tell)
        return self._of_bytes(data, str(path), depth, found, _IN_FILES)

    def _of_bytes(
        self, data: bytes, name: str, depth: Depth | None, found: tuple[Recording, FrameEntry] | None, way_out: _WayOut
    ) -> QueryImage:
        """A file in memory. A large JPEG is made smaller while it is decoded, so that it takes no more memory."""
        header = header_of(data, name)
        camera, scale = self._camera_of(name, header.size, found, way_out)
        depth_image = self._read_depth(depth, name, header.size, scale)
        instances, pose, index, time = None, None, None, None
        if found is not None:
            recording, entry = found
            pose, index, time = entry.world_from_camera, entry.index, entry.timestamp_ns
            instances = recording.read_instances(entry)
        if header.bits == 16 and header.channels == 1:
            self.tell(f"{name} has one channel of 16 bits, as depth images have; it is taken for a grey image")
        if orientation_of(data) > 1:
            self.tell(
                f"{name} has an orientation mark, which is not applied: intrinsics belong to the pixels as stored"
            )
        reduction = reduction_of(times_finer(camera, self._map_cameras())) if header.kind == "jpeg" else 1
        image = decode_color(data, name, reduction)
        expected = camera if reduction == 1 else reduced_camera(camera, reduction)
        if image.shape[:2] != (expected.height, expected.width):
            raise FrameError(
                f"{name}: has {image.shape[1]}x{image.shape[0]} pixels, but its header says "
                f"{header.width}x{header.height}"
            )
        if reduction > 1 and depth_image is not None:
            depth_image = np.asarray(smaller_values(depth_image, expected, reduction), dtype=np.float32)
        query = QueryImage(name, image, expected, depth_image, instances, pose, index, time)
        return self._at_scale_of_map(query, camera)

    def _of_frame(self, given: Frame, depth: Depth | None, name: str | None) -> QueryImage:
        frame = check_frame(given)
        size = (frame.image.shape[1], frame.image.shape[0])
        camera = frame.camera if self._camera is None else with_size(self._camera, size)
        self._check_camera(camera, name or frame.name)
        scale = self._depth_scale or (None if self._like is None else self._like.depth_scale)
        found = frame.depth if depth is None else self._read_depth(depth, frame.name, size, scale)
        return self._at_scale_of_map(
            QueryImage(
                name or frame.name,
                frame.image,
                camera,
                found,
                frame.instances,
                frame.world_from_camera,
                frame.index,
                frame.timestamp_ns,
            )
        )

    def _at_scale_of_map(self, query: QueryImage, original: Camera | None = None) -> QueryImage:
        """The query no finer than the map's images; `original` is its camera before its file was made smaller."""
        original = original or query.camera
        times = times_finer(original, self._map_cameras())
        found = at_scale(query, times * math.sqrt(query.camera.fx * query.camera.fy / (original.fx * original.fy)))
        if times > 1:
            self.tell(
                f"{query.name} ({original.width}x{original.height}) is localized at {found.camera.width}x"
                f"{found.camera.height}, the scale of the map's images"
            )
        remarks = [remark_on_color(found.image), None if found.depth is None else remark_on_depth(found.depth)]
        for remark in filter(None, remarks):
            self.tell(f"{query.name}: {remark}")
        return found

    def _map_cameras(self) -> Sequence[Camera]:
        if self._cameras is None:
            self._cameras = self._known()
        return self._cameras

    def _check_camera(self, camera: Camera, name: str) -> None:
        problem = camera_problem(camera)
        if problem is not None:
            raise FrameError(f"{name}: its camera makes no sense: {problem}")
        for doubt in camera_doubts(camera):
            self.tell(f"camera of {name}: {doubt}")

    def _read_depth(
        self, depth: Depth | None, name: str, size: tuple[int, int], scale: float | None
    ) -> Float32Array | None:
        """Metres ``[H, W]``; `scale` is that of files and integers."""
        if depth is None:
            return None
        if isinstance(depth, str | PathLike):
            if scale is None:
                raise UsageError(
                    f"the depth scale of {depth} is not known: give --depth-scale N, units per metre, or name a "
                    "recording like it with --like RECORDING"
                )
            _check_scale(scale)
            return read_depth_image(Path(depth), scale, size)
        name = f"depth of {name}"
        if isinstance(depth, bytes):
            if scale is None:
                raise UsageError(f"the scale of the {name} is not known: give depth_scale=, units per metre, or like=")
            _check_scale(scale)
            return decode_depth(depth, name, scale, size)
        whole = np.issubdtype(np.asarray(depth).dtype, np.integer)
        return as_depth(depth, name, size, scale if whole else self._depth_scale)

    def _camera_of(
        self, name: str, size: tuple[int, int], found: tuple[Recording, FrameEntry] | None, way_out: _WayOut
    ) -> tuple[Camera, float | None]:
        like_scale = None if self._like is None else self._like.depth_scale
        scale = self._depth_scale or like_scale or (found[0].depth_scale if found else None)
        if self._camera is not None:
            camera = with_size(self._camera, size)
            self._check_camera(camera, name)
            return camera, scale
        if self._like is not None:
            self._tell_assumed(self._like.origin, self._like.assumed)
            _check_size(self._like.camera, size, name, self._like.origin)
            return self._like.camera, scale
        if found is not None:
            self.tell(f"camera of the images: that of the recording {found[0].path} they belong to")
            self._tell_assumed(str(found[0].path), found[0].assumed)
            own = found[0].camera_of(found[1])
            _check_size(own, size, name, str(found[0].path))
            return own, scale
        fitting = {camera for camera in self._map_cameras() if (camera.width, camera.height) == size}
        if len(fitting) == 1:
            self.tell("camera of the images: that of the map's keyframes (--camera or --like name another)")
            return fitting.pop(), scale
        if self._nominal:
            return Camera(*size, size[0], size[0], (size[0] - 1) / 2, (size[1] - 1) / 2), scale
        raise FrameError(f"the camera of {name} ({size[0]}x{size[1]}) is not known: {self._why_unknown(size, way_out)}")

    def _why_unknown(self, size: tuple[int, int], way_out: _WayOut) -> str:
        """What keyframes say of cameras, and how to choose."""
        if not self._map_cameras():
            return f"give {way_out.camera}"
        fitting = [one for one in self._used() if (one.camera.width, one.camera.height) == size]
        took: dict[str, list[UsedCamera]] = {}
        for one in fitting:
            took.setdefault(camera_numbers(one.camera), []).append(one)
        if len(took) < 2:
            sizes = sorted({f"{camera.width}x{camera.height}" for camera in self._map_cameras()})
            return f"the keyframes' images are {', '.join(sizes[:3])}; give {way_out.camera}"
        texts = [
            f"{text} (recording {of[0].recording!r} in map {of[0].map!r}"
            + f", {len(of) - 1} more" * (len(of) > 1)
            + ")"
            for text, of in took.items()
        ]
        by_map = len({one.map for one in fitting}) > 1
        choose = f"choose the map ({way_out.map}), or give {way_out.camera}" if by_map else f"give {way_out.camera}"
        more = f", and {len(texts) - 3} more" if len(texts) > 3 else ""
        return f"keyframes of that size have {len(texts)} cameras, {', '.join(texts[:3])}{more}: {choose}"

    def _tell_assumed(self, origin: str, assumed: Sequence[str]) -> None:
        for line in assumed:
            if not line.startswith("poses"):  # which are only drawn
                self.tell(f"{origin}: {line}")

    def tell(self, line: str) -> None:
        """Says a line to whoever asks, once."""
        if line not in self._said:
            self._said.add(line)
            self._say(line)


def at_scale(query: QueryImage, times: float) -> QueryImage:
    """The query with `times` fewer rows and columns, intrinsics, depth and masks with it; itself for 1."""
    if times == 1:
        return query
    camera = smaller_camera(query.camera, times)
    instances = query.instances
    if instances is not None:
        labels = np.asarray(smaller_values(instances.labels, camera), dtype=np.uint16)
        instances = InstanceMasks(labels, instances.categories)
    depth = None if query.depth is None else np.asarray(smaller_values(query.depth, camera), dtype=np.float32)
    image = smaller_image(query.image, camera)
    return replace(query, image=image, camera=camera, depth=depth, instances=instances)


def frame_at_scale(frame: Frame, known: Sequence[Camera]) -> Frame:
    """A frame as a query of a map whose images `known` took: no finer than these; itself where it is not larger."""
    times = times_finer(frame.camera, known)
    if times == 1:
        return frame
    query = at_scale(QueryImage(frame.name, frame.image, frame.camera, frame.depth, frame.instances, None), times)
    return replace(frame, image=query.image, camera=query.camera, depth=query.depth, instances=query.instances)


def _check_scale(scale: float) -> None:
    problem = depth_scale_problem(scale)
    if problem is not None:
        raise UsageError(problem)


def _check_size(camera: Camera, size: tuple[int, int], name: str, origin: str) -> None:
    if (camera.width, camera.height) != size:
        raise FrameError(
            f"{name} is {size[0]}x{size[1]}, but the camera of {origin} is {camera.width}x{camera.height}: "
            "give --camera fx,fy,cx,cy"
        )
