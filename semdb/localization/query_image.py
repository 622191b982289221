"""A query image with all that must be known of it: its camera, its depth, its masks. Nothing is guessed silently."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.recordings import open_recordings, read_depth_image, read_query_image
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.cameras import with_size
from semdb.types import Camera, Float32Array, FloatArray, ImageArray, InstanceMasks

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class QueryImage:
    """`world_from_camera` is the true pose where the image belongs to a recording that has one: for pictures only."""

    path: Path
    image: ImageArray
    camera: Camera
    depth: Float32Array | None
    instances: InstanceMasks | None
    world_from_camera: FloatArray | None


@dataclass(frozen=True, slots=True)
class LikeCamera:
    """A camera to take for images without one, its depth scale, and where it comes from."""

    camera: Camera
    depth_scale: float | None
    origin: str


class QueryReader:
    """Reads query images.

    The camera is, in this order, `camera` (from ``--camera``), that of `like` (from ``--like``), that of the
    recording on disk that the image belongs to, `known` when all the map's keyframes have one camera of that size.
    """

    def __init__(
        self,
        *,
        camera: Camera | None = None,
        like: LikeCamera | None = None,
        known: Sequence[Camera] = (),
        say: Say | None = None,
    ) -> None:
        self._camera = camera
        self._like = like
        self._known = tuple(known)
        self._say = say or (lambda line: None)
        self._said: set[str] = set()
        self._recordings: dict[Path, tuple[Recording, dict[Path, FrameEntry]] | None] = {}

    def read(self, path: Path, depth_path: Path | None = None) -> QueryImage:
        """The image at `path` with depth from `depth_path`, which must be registered to it and of its size.

        Raises FrameError for a file that cannot be read or whose camera is not known.
        """
        image = read_query_image(path)
        size = (image.shape[1], image.shape[0])
        found = self._find_in_recording(path)
        camera, depth_scale = self._camera_of(path, size, found)
        depth = None
        if depth_path is not None:
            if depth_scale is None:
                raise UsageError(
                    f"the depth scale of {depth_path} is not known: name a recording like it with --like RECORDING"
                )
            depth = read_depth_image(depth_path, depth_scale, size)
        instances, pose = None, None
        if found is not None:
            recording, entry = found
            pose = entry.world_from_camera
            instances = recording.read_instances(entry)
        return QueryImage(path, image, camera, depth, instances, pose)

    def _camera_of(
        self, path: Path, size: tuple[int, int], found: tuple[Recording, FrameEntry] | None
    ) -> tuple[Camera, float | None]:
        like_scale = None if self._like is None else self._like.depth_scale
        scale = like_scale or (found[0].depth_scale if found else None)
        if self._camera is not None:
            return with_size(self._camera, size), scale
        if self._like is not None:
            self._check_size(self._like.camera, size, path, self._like.origin)
            return self._like.camera, scale
        if found is not None:
            self._tell(f"camera of the images: that of the recording {found[0].path} they belong to")
            self._check_size(found[0].camera, size, path, str(found[0].path))
            return found[0].camera, scale
        fitting = {camera for camera in self._known if (camera.width, camera.height) == size}
        if len(fitting) == 1:
            self._tell("camera of the images: that of the map's keyframes (--camera or --like name another)")
            return fitting.pop(), scale
        raise FrameError(
            f"the camera of {path} ({size[0]}x{size[1]}) is not known: give --camera fx,fy,cx,cy[,k1,k2,p1,p2,k3], "
            "or --like RECORDING"
        )

    def _check_size(self, camera: Camera, size: tuple[int, int], path: Path, origin: str) -> None:
        if (camera.width, camera.height) != size:
            raise FrameError(
                f"{path} is {size[0]}x{size[1]}, but the camera of {origin} is {camera.width}x{camera.height}: "
                "give --camera fx,fy,cx,cy"
            )

    def _find_in_recording(self, path: Path) -> tuple[Recording, FrameEntry] | None:
        """The recording around an image (its folder, or the one above) and the image's entry in it."""
        absolute = path.resolve()
        for folder in (absolute.parent, absolute.parent.parent):
            if folder not in self._recordings:
                self._recordings[folder] = _open_or_none(folder)
            found = self._recordings[folder]
            if found is not None and absolute in found[1]:
                return found[0], found[1][absolute]
        return None

    def _tell(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._say(line)


def _open_or_none(folder: Path) -> tuple[Recording, dict[Path, FrameEntry]] | None:
    """The one recording in `folder` with its frames by the path of their image; None where there is none."""
    try:
        recordings = open_recordings(folder)
    except RecordingError:
        return None
    if len(recordings) != 1:
        return None
    return recordings[0], {entry.image_path.resolve(): entry for entry in recordings[0].entries}
