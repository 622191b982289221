"""Images, and what is known of them on this side, as the files and fields of a request."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, UsageError
from semdb.localization.on_disk import LikeCamera, RecordingsOnDisk
from semdb.localization.query_image import Depth, Image
from semdb.names import storable
from semdb.recordings.arrays import as_depth, as_image, check_depth_scale
from semdb.recordings.images import encode_16bit, encode_color, header_of, read_bytes, scaled_depth
from semdb.recordings.memory import DEPTH_SCALE, LARGEST, check_frame
from semdb.types import Camera, Float32Array, Frame, InstanceMasks

MILLIMETRES = 1000.0
LONGEST_NAME = 255
NONE_MEASURED = 0


@dataclass(frozen=True, slots=True)
class Sent:
    """One image as it is sent: `name` is what the answer calls it here."""

    name: str
    image: bytes
    depth: bytes | None = None
    depth_scale: float | None = None
    camera: str | None = None
    instances: bytes | None = None
    categories: str | None = None
    frame_index: int | None = None
    timestamp_ns: int | None = None

    def files(self) -> dict[str, Any]:
        """The files of the form."""
        found = {"image": self.image, "depth": self.depth, "instances": self.instances}
        return {name: (name, data, "application/octet-stream") for name, data in found.items() if data is not None}

    def fields(self) -> dict[str, str]:
        """The fields of the form."""
        found: dict[str, object] = {
            "name": storable(self.name)[-LONGEST_NAME:],
            "camera": self.camera,
            "depth_scale": None if self.depth_scale is None else repr(float(self.depth_scale)),
            "categories": self.categories,
            "frame_index": self.frame_index,
            "timestamp_ns": self.timestamp_ns,
        }
        return {name: str(value) for name, value in found.items() if value is not None}


def camera_text(camera: Camera) -> str:
    """The numbers of a camera with all their digits."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    return ",".join(repr(float(number)) for number in numbers)


@dataclass
class ImageReader:
    """Reads images as `semdb.localization.query_image.QueryReader` does, as far as this side knows what it needs.

    `like` is the camera of a recording that is here; one that the service has is asked for by `like_there`. Without
    both, and without a recording around an image, the service takes the camera of the map's keyframes.
    """

    say: Callable[[str], None]
    on_disk: RecordingsOnDisk
    camera: Camera | None = None
    like: LikeCamera | None = None
    like_there: Callable[[], Camera] | None = None
    depth_scale: float | None = None
    paths: Collection[Path] = ()

    def __post_init__(self) -> None:
        self.depth_scale = check_depth_scale(self.depth_scale)
        self._said: set[str] = set()

    def read(
        self, image: Image, depth: Depth | None = None, name: str | None = None, number: int | None = None
    ) -> Sent:
        """The `image` and its `depth`. Raises FrameError for what cannot be read, UsageError."""
        if isinstance(image, Frame):
            return self._of_frame(image, depth, name)
        if isinstance(image, str | PathLike):
            return self._of_file(Path(image), depth)
        name = name or ("image" if number is None else f"image {number}")
        if isinstance(image, bytes):
            return self._of_bytes(image, name, depth)
        pixels = as_image(image, name)
        size = (pixels.shape[1], pixels.shape[0])
        scale = self.depth_scale or (None if self.like is None else self.like.depth_scale)
        found, scale = self._depth(depth, name, size, scale)
        return Sent(name, encode_color(pixels), found, scale, self._camera_of(name, size))

    def tell(self, line: str) -> None:
        """Says a line once."""
        if line not in self._said:
            self._said.add(line)
            self.say(line)

    def _of_bytes(self, data: bytes, name: str, depth: Depth | None) -> Sent:
        size = header_of(data, name).size
        scale = self.depth_scale or (None if self.like is None else self.like.depth_scale)
        found, scale = self._depth(depth, name, size, scale)
        return Sent(name, data, found, scale, self._camera_of(name, size))

    def _of_file(self, path: Path, depth: Depth | None) -> Sent:
        """A file; where it belongs to a recording that is here, with what that says of it."""
        data, name = read_bytes(path), str(path)
        around = self.on_disk.around(path, self.paths, self.tell)
        if around is None:
            return self._of_bytes(data, name, depth)
        recording, entry = around
        size = header_of(data, name).size
        camera = self._camera_of(name, size)
        if camera is None and self.like_there is None:
            self.tell(f"camera of the images: that of the recording {recording.path} they belong to")
            self._tell_assumed(str(recording.path), recording.assumed)
            own = recording.camera_of(entry)
            check_size(own, size, name, str(recording.path))
            camera = camera_text(own)
        like_scale = None if self.like is None else self.like.depth_scale
        scale = self.depth_scale or like_scale or (None if self.like_there is not None else recording.depth_scale)
        found, scale = self._depth(depth, name, size, scale)
        labels, categories = self._instances(recording.read_instances(entry))
        if labels is not None and camera is None and self.like_there is not None:
            camera = camera_text(self.like_there())
        return Sent(
            name,
            data,
            found,
            scale,
            camera,
            labels,
            categories,
            frame_index=entry.index,
            timestamp_ns=entry.timestamp_ns,
        )

    def _of_frame(self, given: Frame, depth: Depth | None, name: str | None) -> Sent:
        frame = check_frame(given)
        name = name or frame.name
        size = (frame.image.shape[1], frame.image.shape[0])
        scale = self.depth_scale or (None if self.like is None else self.like.depth_scale)
        given_depth = self._depth(depth, name, size, scale)
        if depth is None and frame.depth is not None:
            given_depth = self._in_steps(frame.depth, name, frame.depth_scale)
        labels, categories = self._instances(frame.instances)
        camera = camera_text(frame.camera if self.camera is None else self.camera)
        return Sent(
            *(name, encode_color(frame.image), *given_depth, camera, labels, categories),
            frame_index=frame.index,
            timestamp_ns=frame.timestamp_ns,
        )

    def _camera_of(self, name: str, size: tuple[int, int]) -> str | None:
        """The camera that was said, or that of `like`; None leaves it to the service."""
        if self.camera is not None:
            return camera_text(self.camera)
        if self.like is None:
            return None
        self._tell_assumed(self.like.origin, self.like.assumed)
        check_size(self.like.camera, size, name, self.like.origin)
        return camera_text(self.like.camera)

    def _tell_assumed(self, origin: str, assumed: Collection[str]) -> None:
        for line in assumed:
            if not line.startswith("poses"):
                self.tell(f"{origin}: {line}")

    def _depth(
        self, depth: Depth | None, name: str, size: tuple[int, int], scale: float | None
    ) -> tuple[bytes | None, float | None]:
        """A 16-bit PNG and its units per metre; None of these where the service knows them by `like`."""
        if depth is None:
            return None, None
        if isinstance(depth, str | PathLike | bytes):
            named = depth if isinstance(depth, str | PathLike) else f"depth of {name}"
            if scale is None and self.like_there is None:
                raise UsageError(
                    f"the depth scale of {named} is not known: give --depth-scale N (depth_scale=), units per metre, "
                    "or name a recording like it with --like RECORDING (like=)"
                )
            return (depth if isinstance(depth, bytes) else read_bytes(Path(depth))), scale
        whole = np.issubdtype(np.asarray(depth).dtype, np.integer)
        if whole and np.asarray(depth).dtype == np.uint16 and not isinstance(depth, np.ma.MaskedArray):
            if scale is not None or self.like_there is None:
                as_depth(depth, f"depth of {name}", size, scale)  # says what is wrong with it
            return encode_16bit(np.asarray(depth, np.uint16)), scale
        metres = as_depth(depth, f"depth of {name}", size, scale if whole else self.depth_scale)
        return self._in_steps(metres, name, scale)

    def _in_steps(self, metres: Float32Array, name: str, scale: float | None) -> tuple[bytes, float]:
        """Metres as 16-bit values: exactly where a usual scale holds them, else in steps, which is said."""
        for units in dict.fromkeys(filter(None, (scale, DEPTH_SCALE, MILLIMETRES))):
            values = in_units(metres, units)
            if values is not None and np.array_equal(scaled_depth(values, units), metres, equal_nan=True):
                return encode_16bit(values), units
        for units in (DEPTH_SCALE, MILLIMETRES):
            values = in_units(metres, units)
            if values is not None:
                break
        else:
            units = MILLIMETRES
            near = np.where(metres * units <= LARGEST, metres, np.float32(np.nan))
            values = in_units(near, units)
        assert values is not None
        self.tell(f"depth is sent in steps of {1000 / units:g} mm up to {LARGEST / units:.1f} m (first that of {name})")
        return encode_16bit(values), units

    def _instances(self, masks: InstanceMasks | None) -> tuple[bytes | None, str | None]:
        if masks is None:
            return None, None
        named = {str(label): category for label, category in masks.categories.items()}
        return encode_16bit(np.asarray(masks.labels, np.uint16)), json.dumps(named)


def in_units(metres: Float32Array, units: float) -> npt.NDArray[np.uint16] | None:
    """Depth ``[H, W]`` in steps, 0 where nothing was measured; None where 16 bits do not hold it."""
    with np.errstate(invalid="ignore"):
        values = np.rint(np.where(np.isfinite(metres) & (metres > 0), metres.astype(np.float64) * units, NONE_MEASURED))
    return None if values.size and values.max() > LARGEST else values.astype(np.uint16)


def check_size(camera: Camera, size: tuple[int, int], name: str, origin: str) -> None:
    """Raises FrameError for a camera of another size than the image."""
    if (camera.width, camera.height) != size:
        raise FrameError(
            f"{name} is {size[0]}x{size[1]}, but the camera of {origin} is {camera.width}x{camera.height}: "
            "give --camera fx,fy,cx,cy"
        )
