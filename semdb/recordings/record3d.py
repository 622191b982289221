"""Record3D (iPhone): ``.r3d`` archives as exported, or the folder that they unpack to.

``metadata`` is JSON: image size w, h, depth size dw, dh, K column by column, perhaps perFrameIntrinsicCoeffs (fx, fy,
cx, cy), fps, perhaps frameTimestamps, and poses (qx, qy, qz, qw, x, y, z) in ARKit's axes (x right, y up, z back) of
the image as stored, also where that is upright. ``rgbd/N.jpg`` is colour, ``N.depth`` float32 metres and ``N.conf``
bytes 0 to 2, both compressed by LZFSE.
"""

from __future__ import annotations

import math
import threading
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import FrameError, RecordingError
from semdb.files import UnusableFileError, decode_text, parse_json
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.recordings.assembly import Draft, finish
from semdb.recordings.association import parse_pose
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.cameras import with_size
from semdb.recordings.images import read_bytes
from semdb.recordings.options import BACK, ReadOptions
from semdb.recordings.own_depth import SCALE, DepthCamera, confident, in_color, resized
from semdb.types import Camera, FloatArray

METADATA = "metadata"
LIDAR = (256, 192)  # where the metadata do not say
TRUE_DEPTH = (640, 480)
LARGEST = 1 << 26  # bytes of a member of the archive


def is_record3d(path: Path) -> bool:
    """Whether a path is an ``.r3d`` archive or the folder of one."""
    if path.is_dir():
        return (path / METADATA).is_file() and (path / "rgbd").is_dir()
    return path.suffix.lower() == ".r3d"


def open_record3d(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording of Record3D; nothing is decoded. Raises RecordingError."""
    options = options or ReadOptions()
    members = _Members(path)
    metadata = _metadata(members)
    size = int(_number(members, metadata, "w")), int(_number(members, metadata, "h"))
    known = with_size(camera, size) if camera is not None else _camera(members, metadata, size)
    numbers = sorted(
        int(name[5:-4])
        for name in members.names
        if name[:5] == "rgbd/" and name[5:-4].isdecimal() and name[-4:] == ".jpg"
    )
    poses, times = metadata.get("poses"), metadata.get("frameTimestamps")
    own_cameras = None if camera is not None else _own_cameras(metadata, known)
    notes, entries, dropped = [], [], []
    if not poses:
        notes.append("metadata has no poses: the frames have no pose")
    with_depth = any(f"rgbd/{number}.depth" in members.names for number in numbers)
    if not with_depth:
        notes.append("no rgbd/N.depth: the frames have no depth")
    fps = metadata.get("fps")
    for number in numbers:
        name = f"rgbd/{number}.jpg"
        pose = _pose(poses, number, options) if poses else None
        if isinstance(pose, str):
            dropped.append(DroppedFrame(name, pose))
            continue
        if with_depth and f"rgbd/{number}.depth" not in members.names:
            dropped.append(DroppedFrame(name, "no depth"))
            continue
        entries.append(
            FrameEntry(
                index=number,
                name=name,
                timestamp_ns=_time_ns(times, fps, number),
                image_path=path,
                depth_path=path if with_depth else None,
                masks_path=None,
                world_from_camera=pose,
                camera=own_cameras[number] if own_cameras is not None and number < len(own_cameras) else None,
            )
        )
    dw, dh = metadata.get("dw"), metadata.get("dh")
    draft = Draft(
        path=path,
        name=path.resolve().name.removesuffix(".r3d"),
        format="record3d",
        total_frames=len(numbers),
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=known,
        depth_scale=SCALE,
        data=_Record3dData(members, known, (dw, dh) if isinstance(dw, int) and isinstance(dh, int) else None),
    )
    return finish(draft, camera)


class _Members:
    """Members of the archive, or files of the folder, by name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._archive: zipfile.ZipFile | None = None
        if path.is_dir():
            self.names = {METADATA} | {f"rgbd/{file.name}" for file in (path / "rgbd").iterdir()}
            return
        try:
            self._archive = zipfile.ZipFile(path)
            self.names = set(self._archive.namelist())
        except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError) as error:
            raise RecordingError(f"{path}: is no .r3d archive (a zip file), or a part of one: {error}") from error
        if METADATA not in self.names:
            raise RecordingError(f"{path}: has no member '{METADATA}': it is no export of Record3D")

    def read(self, name: str) -> bytes:
        """The bytes of a member. Raises FrameError."""
        if self._archive is None:
            return read_bytes(self.path / name)
        try:
            with self._lock:
                if self._archive.getinfo(name).file_size > LARGEST:
                    raise FrameError(f"{self.path}: {name}: is larger than any frame")
                return self._archive.read(name)
        except (
            OSError,
            KeyError,
            zipfile.BadZipFile,
            NotImplementedError,
            RuntimeError,
            ValueError,
            EOFError,
        ) as error:
            raise FrameError(f"{self.path}: {name}: cannot be read: {error}") from error
        except Exception as error:  # zlib.error and what else a damaged member ends in
            raise FrameError(f"{self.path}: {name}: is damaged: {error}") from error


class _Record3dData:
    """Images of the archive."""

    def __init__(self, members: _Members, camera: Camera, depth_size: tuple[int, int] | None) -> None:
        self._members, self._camera, self._size = members, camera, depth_size

    def color(self, entry: FrameEntry) -> RawColor:
        return RawColor(file=self._members.read(entry.name))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        camera = entry.camera or self._camera
        name = f"rgbd/{entry.index}.depth"
        data = self._unpack(name, 4)
        width, height = self._depth_size(len(data) // 4, camera, name)
        depth = np.frombuffer(data, "<f4").reshape(height, width).astype(np.float32)
        with np.errstate(invalid="ignore"):
            depth = np.where(depth > 0, depth, np.float32(np.nan))
        if f"rgbd/{entry.index}.conf" in self._members.names:
            sure = np.frombuffer(self._unpack(f"rgbd/{entry.index}.conf", 1), np.uint8)
            if sure.size != depth.size:
                raise FrameError(
                    f"{self._members.path}: {entry.name}: its confidence is of another size than its depth"
                )
            depth = confident(depth, sure.reshape(depth.shape))
        return in_color(depth, DepthCamera(resized(camera, width, height), np.eye(4)), camera)

    def _depth_size(self, pixels: int, camera: Camera, name: str) -> tuple[int, int]:
        """Width and height: as the metadata say, else those of a known sensor, upright where the image is."""
        known = [self._size] if self._size else []
        for width, height in (LIDAR, TRUE_DEPTH):
            known.append((height, width) if camera.height > camera.width else (width, height))
        for width, height in known:
            if width * height == pixels:
                return width, height
        raise FrameError(f"{self._members.path}: {name}: has {pixels} pixels, which is no known size of depth")

    def _unpack(self, name: str, item: int) -> bytes:
        data = self._members.read(name)
        try:
            import lzfse
        except ImportError as error:
            raise FrameError(
                f"{self._members.path}: depth of Record3D needs the phone extra: pip install 'semdb[phone]'"
            ) from error
        if not data.startswith(b"bvx"):
            return data  # stored as it is
        try:
            found = bytes(lzfse.decompress(data))
        except Exception as error:  # its error class is its own
            raise FrameError(f"{self._members.path}: {name}: cannot be decompressed: {error}") from error
        if not found or len(found) % item:
            raise FrameError(f"{self._members.path}: {name}: has {len(found)} bytes")
        return found


def _metadata(members: _Members) -> dict[str, Any]:
    where = f"{members.path}: {METADATA}"
    try:
        content = parse_json(decode_text(members.read(METADATA)))
    except UnusableFileError as error:
        raise RecordingError(f"{where}: {error}") from error
    except FrameError as error:
        raise RecordingError(str(error)) from error
    if not isinstance(content, dict):
        raise RecordingError(f"{where}: must be a JSON object")
    return content


def _number(members: _Members, metadata: dict[str, Any], key: str) -> float:
    value = metadata.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e5:
        raise RecordingError(f"{members.path}: {METADATA}: {key!r} must be a positive number, but is {value!r}")
    return float(value)


def _camera(members: _Members, metadata: dict[str, Any], size: tuple[int, int]) -> Camera:
    matrix = metadata.get("K")
    if not isinstance(matrix, list) or len(matrix) != 9 or not all(_finite(value) for value in matrix):
        raise RecordingError(f"{members.path}: {METADATA}: 'K' must be nine numbers")
    if min(matrix[0], matrix[4]) <= 0:
        raise RecordingError(f"{members.path}: {METADATA}: 'K' has a focal length that is not positive")
    return Camera(*size, float(matrix[0]), float(matrix[4]), float(matrix[6]), float(matrix[7]))


def _own_cameras(metadata: dict[str, Any], camera: Camera) -> list[Camera | None] | None:
    """Cameras of the frames: the focal length of a telephone changes with its focus."""
    rows = metadata.get("perFrameIntrinsicCoeffs")
    if not isinstance(rows, list):
        return None
    found: list[Camera | None] = []
    for row in rows:
        good = isinstance(row, list) and len(row) == 4 and all(_finite(value) for value in row) and min(row[:2]) > 0
        fx, fy, cx, cy = map(float, row) if good else (0.0, 0.0, 0.0, 0.0)
        found.append(Camera(camera.width, camera.height, fx, fy, cx, cy) if good else None)
    return found


def _pose(poses: Any, number: int, options: ReadOptions) -> FloatArray | str:
    row = poses[number] if isinstance(poses, Sequence) and number < len(poses) else None
    if not isinstance(row, list) or len(row) != 7:
        return "no pose"
    try:
        quat_wxyz, translation = parse_pose([str(value) for value in (*row[4:], *row[:4])], options.quaternion)
        pose = pose_from(rotation_from_quat_wxyz(quat_wxyz), translation)
    except ValueError as error:
        return f"its pose {error}"
    return options.pose(pose) if options.axes else options.pose(pose) @ BACK


def _time_ns(times: Any, fps: Any, number: int) -> int | None:
    if isinstance(times, list) and number < len(times) and _finite(times[number]):
        return round(float(times[number]) * 1e9)
    return round(number * 1e9 / float(fps)) if _finite(fps) and fps > 0 else None


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and abs(value) < 1e12


LAYOUT = Layout(
    "record3d",
    "Record3D (.r3d, or its folder with metadata and rgbd/)",
    is_record3d,
    lambda path, camera, options: [open_record3d(path, camera, options)],
    frozenset({"poses_are", "axes", "scale", "quaternion"}),
)
