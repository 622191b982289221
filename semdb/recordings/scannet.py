"""ScanNet: ``.sens`` files (version 4) where they lie, and folders extracted from them.

A ``.sens`` file is a header (version, sensor name, intrinsics and extrinsics of both cameras as 4x4 float32,
compressions, sizes, depth units a metre, number of frames), then for each frame a camera-to-world matrix, two times in
microseconds, two sizes and two compressed images. Poses that were lost are -inf. Colour and depth have cameras of their
own and sizes of their own.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from semdb.errors import FrameError, RecordingError
from semdb.files import UnusableFileError, open_regular
from semdb.geometry import invert_pose
from semdb.recordings.assembly import Draft, finish
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.camera_files import read_matrix
from semdb.recordings.images import decode_16bit, read_bytes, scaled_depth
from semdb.recordings.numbered import entries_of, numbered_files
from semdb.recordings.options import ReadOptions
from semdb.recordings.own_depth import DepthCamera, in_color
from semdb.recordings.poses import rigid_pose
from semdb.shown import number
from semdb.types import Camera, FloatArray

VERSION = 4
JPEG, PNG = 2, 1  # compression of colour
ZLIB, RAW = 1, 0  # of depth
DEPTH_SCALE = 1000.0
LARGEST_SIDE = 16384
INTRINSIC_COLOR, INTRINSIC_DEPTH = "intrinsic_color.txt", "intrinsic_depth.txt"
EXTRINSIC_COLOR, EXTRINSIC_DEPTH = "extrinsic_color.txt", "extrinsic_depth.txt"


@dataclass(frozen=True, slots=True, eq=False)
class SensHeader:
    """What stands before the frames. `first` is the position of the first frame in the file."""

    camera: Camera
    depth: DepthCamera
    color_compression: int
    depth_compression: int
    depth_scale: float
    frames: int
    first: int


@dataclass(frozen=True, slots=True)
class SensFrame:
    """Where the images of a frame lie in the file."""

    color_at: int
    color_bytes: int
    depth_bytes: int


def is_sens(path: Path) -> bool:
    """Whether a path is a ``.sens`` file, or a folder with one."""
    return (path.is_file() and path.suffix.lower() == ".sens") or (path.is_dir() and len(_sens_files(path)) == 1)


def is_scannet_folder(path: Path) -> bool:
    """Whether a folder has frames extracted from a ``.sens``."""
    return path.is_dir() and all((path / name).is_dir() for name in ("color", "depth", "pose"))


def open_sens(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording that is one ``.sens`` file; nothing is decoded. Raises RecordingError."""
    options = options or ReadOptions()
    file = path if path.is_file() else _sens_files(path)[0]
    notes: list[str] = []
    entries, dropped, frames = [], [], {}
    with _open(file) as stream:
        header = _read_header(stream, file)
        size = file.stat().st_size
        for index in range(header.frames):
            found = _read_frame(stream, size)
            if found is None:
                notes.append(
                    f"the file ends in frame {index} of {header.frames} (truncated; copy it again): the frames before "
                    "it are read"
                )
                break
            matrix, time_us, place = found
            name = f"frame {index}"
            frames[index] = place
            try:
                pose = options.pose(rigid_pose(matrix))
            except ValueError as error:
                reason = "its pose was lost" if not np.isfinite(matrix).all() else f"its pose {error}"
                dropped.append(DroppedFrame(name, reason))
                continue
            entries.append(
                FrameEntry(index, name, time_us * 1000, file, file if place.depth_bytes else None, None, pose)
            )
    scale = options.depth_scale or header.depth_scale
    draft = Draft(
        path=path,
        name=file.stem if path.is_file() else path.resolve().name,
        format="scannet",
        total_frames=header.frames,
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=header.camera,
        depth_scale=scale,
        data=_SensData(file, header, frames, scale, camera),
    )
    return finish(draft, camera)


def open_scannet_folder(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A folder with ``color/``, ``depth/``, ``pose/`` and ``intrinsic/``. Raises RecordingError."""
    options = options or ReadOptions()
    color, depth = numbered_files(path / "color"), numbered_files(path / "depth", (".png",))
    poses: dict[int, FloatArray | str] = {
        number: _folder_pose(file, options) for number, file in numbered_files(path / "pose", (".txt",)).items()
    }
    entries, dropped = entries_of(path, color, depth or None, poses or None)
    notes = []
    if not depth:
        notes.append("no images in depth/: the frames have no depth")
    if not poses:
        notes.append("no files in pose/: the frames have no pose")
    color_size = _size_of(entries, [entry.image_path for entry in entries])
    known = _matrix_camera(path / "intrinsic" / INTRINSIC_COLOR, color_size)
    scale = options.depth_scale or DEPTH_SCALE
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="scannet",
        total_frames=len(color),
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=known,
        depth_scale=scale,
        assumed_scale="" if options.depth_scale else "that of ScanNet",
    )
    if depth:
        depth_size = _size_of(entries, [entry.depth_path for entry in entries if entry.depth_path])
        own = _matrix_camera(path / "intrinsic" / INTRINSIC_DEPTH, depth_size)
        turn = _extrinsic(path / "intrinsic" / EXTRINSIC_COLOR), _extrinsic(path / "intrinsic" / EXTRINSIC_DEPTH)
        draft.data = _FolderData(DepthCamera(own, invert_pose(turn[0]) @ turn[1]), camera or known, scale, color_size)
        if camera is not None and not camera.width:
            draft.known_camera = Camera(*color_size, *(getattr(known, k) for k in ("fx", "fy", "cx", "cy")))
    return finish(draft, camera)


class _SensData:
    """Images of a ``.sens`` file, read where they lie."""

    def __init__(
        self, file: Path, header: SensHeader, frames: dict[int, SensFrame], scale: float, camera: Camera | None
    ) -> None:
        self._file, self._header, self._frames, self._scale = file, header, frames, scale
        known = header.camera
        self._camera = (
            known
            if camera is None
            else Camera(known.width, known.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)
        )

    def color(self, entry: FrameEntry) -> RawColor:
        place = self._frames[entry.index]
        if self._header.color_compression not in (JPEG, PNG):
            raise FrameError(f"{self._file}: colour of compression {self._header.color_compression} cannot be read")
        return RawColor(file=self._read(place.color_at, place.color_bytes))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        place, camera = self._frames[entry.index], self._header.depth.camera
        data = self._read(place.color_at + place.color_bytes, place.depth_bytes)
        wanted = camera.width * camera.height * 2
        if self._header.depth_compression == ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, wanted)
            except zlib.error as error:
                raise FrameError(f"{self._file}: {entry.name}: depth is damaged: {error}") from error
        elif self._header.depth_compression != RAW:
            raise FrameError(f"{self._file}: depth of compression {self._header.depth_compression} cannot be read")
        if len(data) != wanted:
            raise FrameError(f"{self._file}: {entry.name}: depth has {len(data)} bytes instead of {wanted}")
        values = np.frombuffer(data, "<u2").reshape(camera.height, camera.width)
        return in_color(scaled_depth(np.ascontiguousarray(values), self._scale), self._header.depth, self._camera)

    def _read(self, at: int, count: int) -> bytes:
        try:
            with self._file.open("rb") as stream:
                stream.seek(at)
                return stream.read(count)
        except OSError as error:
            raise FrameError(f"{self._file}: cannot be read: {error.strerror}") from error


class _FolderData:
    """Images of an extracted folder: depth has a camera of its own."""

    def __init__(self, own: DepthCamera, camera: Camera, scale: float, size: tuple[int, int]) -> None:
        self._own, self._scale = own, scale
        self._camera = Camera(*size, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)

    def color(self, entry: FrameEntry) -> RawColor:
        return RawColor(file=read_bytes(entry.image_path))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        if entry.depth_path is None:
            return None
        size = self._own.camera.width, self._own.camera.height
        values = decode_16bit(read_bytes(entry.depth_path), str(entry.depth_path), size)
        return in_color(scaled_depth(values, self._scale), self._own, self._camera)


def _sens_files(path: Path) -> list[Path]:
    return sorted(path.glob("*.sens"))


def _open(file: Path) -> BinaryIO:
    try:
        return open_regular(file)
    except UnusableFileError as error:
        raise RecordingError(error.at(file)) from error


def _read_header(stream: BinaryIO, file: Path) -> SensHeader:
    try:
        (version,) = struct.unpack("<I", stream.read(4))
        if version != VERSION:
            raise RecordingError(f"{file}: is of .sens version {version}; version {VERSION} can be read")
        (length,) = struct.unpack("<Q", stream.read(8))
        if length > 4096:
            raise RecordingError(f"{file}: is no .sens file: the name of its sensor has {length} letters")
        stream.read(length)
        matrices = [np.frombuffer(stream.read(64), "<f4").reshape(4, 4).astype(np.float64) for _ in range(4)]
        color_kind, depth_kind, *sizes = struct.unpack("<iiIIII", stream.read(24))
        (scale,) = struct.unpack("<f", stream.read(4))
        (frames,) = struct.unpack("<Q", stream.read(8))
    except (struct.error, ValueError) as error:
        raise RecordingError(f"{file}: the file ends in its header (truncated; copy it again)") from error
    if not all(0 < side <= LARGEST_SIDE for side in sizes):
        raise RecordingError(
            f"{file}: says that its images have {sizes[0]}x{sizes[1]} and {sizes[2]}x{sizes[3]} pixels"
        )
    if not (np.isfinite(scale) and scale > 0):
        raise RecordingError(f"{file}: says that depth has {scale} units a metre")
    color, depth = (
        _camera_of(matrices[i], (sizes[j], sizes[j + 1]), f"{file}: the intrinsics of {what}")
        for i, j, what in ((0, 0, "colour"), (2, 2, "depth"))
    )
    turns = [_rigid_or_identity(matrices[i]) for i in (1, 3)]
    own = DepthCamera(depth, invert_pose(turns[0]) @ turns[1])
    return SensHeader(color, own, color_kind, depth_kind, float(scale), frames, stream.tell())


def _read_frame(stream: BinaryIO, size: int) -> tuple[FloatArray, int, SensFrame] | None:
    """Pose as stored, time in microseconds and place of the next frame; None where the file ends before its end."""
    head = stream.read(96)
    if len(head) < 96:
        return None
    matrix = np.frombuffer(head[:64], "<f4").reshape(4, 4).astype(np.float64)
    time_us, _, color_bytes, depth_bytes = struct.unpack("<QQQQ", head[64:])
    at = stream.tell()
    if at + color_bytes + depth_bytes > size:
        return None
    stream.seek(color_bytes + depth_bytes, io.SEEK_CUR)
    return matrix, time_us, SensFrame(at, color_bytes, depth_bytes)


def _camera_of(matrix: FloatArray, size: tuple[int, int], what: str) -> Camera:
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise RecordingError(
            f"{what} make no sense: fx {number(fx)}, fy {number(fy)}, cx {number(cx)}, cy {number(cy)}"
        )
    return Camera(size[0], size[1], float(fx), float(fy), float(cx), float(cy))


def _rigid_or_identity(matrix: FloatArray) -> FloatArray:
    try:
        return rigid_pose(matrix)
    except ValueError:
        return np.eye(4)


def _folder_pose(file: Path, options: ReadOptions) -> FloatArray | str:
    try:
        return options.pose(rigid_pose(read_matrix(file)))
    except ValueError as error:
        return "its pose was lost" if "finite" in str(error) else f"pose/{file.name}: {error}"


def _matrix_camera(file: Path, size: tuple[int, int]) -> Camera:
    return _camera_of(_read_matrix(file), size, str(file))


def _read_matrix(file: Path) -> FloatArray:
    try:
        matrix = read_matrix(file)
    except ValueError as error:
        raise RecordingError(f"{file}: must have the numbers of a 4x4 matrix ({error})") from error
    if matrix.shape not in ((4, 4), (3, 3), (3, 4)):
        raise RecordingError(f"{file}: must have the numbers of a 4x4 matrix, but is {matrix.shape}")
    return matrix


def _extrinsic(file: Path) -> FloatArray:
    return _rigid_or_identity(_read_matrix(file)) if file.is_file() else np.eye(4)


def _size_of(entries: list[FrameEntry], files: list[Path]) -> tuple[int, int]:
    """Width and height of the first image that can be read."""
    from semdb.recordings.images import inspect_file

    reason = "there is none"
    for file in files:
        try:
            return inspect_file(file).size
        except FrameError as error:
            reason = f"{file}: {error}"
    raise RecordingError(f"no image of {len(entries)} can be read: {reason}")


_TAKES = frozenset({"depth_scale", "poses_are", "axes", "scale"})
SENS = Layout(
    "scannet", "ScanNet (.sens)", is_sens, lambda path, camera, options: [open_sens(path, camera, options)], _TAKES
)
FOLDER = Layout(
    "scannet",
    "ScanNet's extracted folders (color/, depth/, pose/, intrinsic/)",
    is_scannet_folder,
    lambda path, camera, options: [open_scannet_folder(path, camera, options)],
    _TAKES,
)
