"""RTAB-Map's databases: nodes with colour, depth and calibration, and the poses of the optimised map.

``Node.pose`` is odometry, which drifts; the optimised poses lie in ``Admin``. Both are of the robot's base, and the
calibration has the pose of each camera in it. Images of several cameras stand side by side in one.
"""

from __future__ import annotations

import contextlib
import sqlite3
import struct
import threading
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, RecordingError
from semdb.files import UnusableFileError, check_place
from semdb.recordings.assembly import Draft, finish
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.cameras import with_size
from semdb.recordings.images import decode_any, decode_color, scaled_depth
from semdb.recordings.lens import as_camera
from semdb.recordings.options import ReadOptions
from semdb.recordings.own_depth import DepthCamera, as_raw, in_color, resized
from semdb.recordings.poses import rigid_pose
from semdb.recordings.rtabmap_calibration import NodeCamera, parse_calibration
from semdb.recordings.rvl import decode_rvl
from semdb.types import Camera, Float32Array, FloatArray

TABLES = {"Node", "Data", "Admin", "Link"}
BEGINNING = 1 << 16  # bytes, in which the statements that made the tables stand
OLDEST = (0, 11, 10)  # since when images lie in Data as they do now
RVL = b"DEPTHRVL"
MILLIMETRES = 1000.0


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the images of a frame lie: the node, and the part of the image that is this camera's."""

    node: int
    part: int
    parts: int


def is_rtabmap(path: Path) -> bool:
    """Whether a file is a database of RTAB-Map, or was one before it was damaged."""
    if not path.is_file() or path.suffix.lower() != ".db":
        return False
    try:
        connection = _connect(path)
        try:
            rows = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        finally:
            connection.close()
    except sqlite3.DatabaseError:
        return _was_rtabmap(path)
    except (sqlite3.Error, OSError):
        return False
    return {str(row[0]) for row in rows} >= TABLES


def _was_rtabmap(path: Path) -> bool:
    """Whether a file that SQLite refuses begins as RTAB-Map's do."""
    try:
        with path.open("rb") as file:
            start = file.read(BEGINNING)
    except OSError:
        return False
    return start.startswith(b"SQLite format 3\0") and all(f"TABLE {name}".encode() in start for name in TABLES)


def open_rtabmap(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording of the nodes that have an image; nothing is decoded. Raises RecordingError."""
    options = options or ReadOptions()
    try:
        return _open(path, camera, options)
    except sqlite3.Error as error:
        raise RecordingError(f"{path}: cannot be read as a database of RTAB-Map: {error}") from error


def _open(path: Path, camera: Camera | None, options: ReadOptions) -> Recording:
    connection = _connect(path)
    notes: list[str] = []
    version = _version(connection, path)
    optimised = _optimised(connection, path)
    rows = connection.execute(
        "SELECT Node.id, map_id, stamp, pose, length(image), length(depth), calibration FROM Node JOIN Data ON "
        "Node.id = Data.id WHERE weight IS NULL OR weight <> -1 ORDER BY Node.id"
    ).fetchall()
    if not rows:
        raise RecordingError(f"{path}: RTAB-Map {version}: has no nodes with data")
    session = Counter(row[1] for row in rows).most_common(1)[0][0]
    if not optimised:
        notes.append(_odometry_note(connection))
    entries: list[FrameEntry] = []
    dropped: list[DroppedFrame] = []
    places: dict[int, _Place] = {}
    cameras: dict[bytes, tuple[list[NodeCamera], list[tuple[Camera, str | None]]]] = {}
    total = 0
    most = _most_cameras({row[6] or b"" for row in rows})
    for node, map_id, stamp, blob, image_size, depth_size, calibration in rows:
        name = f"node {node}"
        total += 1
        if not image_size:
            dropped.append(DroppedFrame(name, "no image"))
            continue
        try:
            known = cameras.get(calibration or b"")
            if known is None:
                own = parse_calibration(calibration or b"")
                known = cameras[calibration or b""] = own, [_camera_of(item) for item in own]
            base = optimised[node] if optimised and node in optimised else _pose(blob)
        except ValueError as error:
            dropped.append(DroppedFrame(name, str(error)))
            continue
        if optimised and node not in optimised:
            dropped.append(DroppedFrame(name, "is not in the optimised map"))
            continue
        if not optimised and map_id != session:
            dropped.append(DroppedFrame(name, f"is of session {map_id}, whose poses are in another frame"))
            continue
        parts = len(known[0])
        total += parts - 1
        for part, (item, (found, note)) in enumerate(zip(*known, strict=True)):
            index = node * most + part
            places[index] = _Place(node, part, parts)
            if note and note not in notes:
                notes.append(note)
            entries.append(
                FrameEntry(
                    index=index,
                    name=name if parts == 1 else f"{name} camera {part}",
                    timestamp_ns=_time_ns(stamp),
                    image_path=path,
                    depth_path=path if depth_size else None,
                    masks_path=None,
                    world_from_camera=options.pose(np.asarray(base @ item.base_from_camera)),
                    camera=found,
                )
            )
    usual = Counter(entry.camera for entry in entries if entry.camera).most_common(1)
    known_camera = usual[0][0] if usual else None
    if camera is not None and known_camera is not None:
        known_camera = with_size(camera, (known_camera.width, known_camera.height))
    if entries and not any(entry.depth_path for entry in entries):
        notes.append("no depth images: the frames have no depth")
    draft = Draft(
        path=path,
        name=path.resolve().stem,
        format="rtabmap",
        total_frames=total,
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=known_camera,
        depth_scale=options.depth_scale or MILLIMETRES,
        assumed_scale="" if options.depth_scale else "that of RTAB-Map",
        data=_RtabmapData(path, connection, places, known_camera, options.depth_scale or MILLIMETRES),
        contents=_contents(connection, version, optimised),
    )
    return finish(draft, camera)


def _odometry_note(connection: sqlite3.Connection) -> str:
    """What is said of a database that was never optimised: its loop closures are not made use of."""
    closures = connection.execute(
        "SELECT count(*) FROM Link WHERE type BETWEEN 1 AND 4 AND from_id < to_id"
    ).fetchone()[0]
    unused = f", and the {closures} loop closure(s) in Link are not used" if closures else ""
    return (
        f"no optimised poses (Admin.opt_poses): poses are the robot's odometry, which drifts{unused}; opened and "
        "closed once in rtabmap the database has them"
    )


def _most_cameras(calibrations: set[bytes]) -> int:
    """How many cameras a node has at most: nodes may differ, and frames' numbers may not meet."""
    most = 1
    for calibration in calibrations:
        with contextlib.suppress(ValueError):  # said of each node
            most = max(most, len(parse_calibration(calibration)))
    return most


class _RtabmapData:
    """Images of the database."""

    def __init__(
        self, path: Path, connection: sqlite3.Connection, places: dict[int, _Place], camera: Camera | None, scale: float
    ) -> None:
        self._path, self._connection, self._places, self._camera, self._scale = path, connection, places, camera, scale
        self._lock = threading.Lock()

    def color(self, entry: FrameEntry) -> RawColor:
        place = self._places[entry.index]
        file = self._blob("image", place.node)
        if place.parts == 1:
            return RawColor(file=file)
        pixels = decode_color(file, f"{self._path}: {entry.name}")
        return RawColor(pixels=np.ascontiguousarray(_part(pixels, place)))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        place, camera = self._places[entry.index], entry.camera or self._camera
        name = f"{self._path}: depth of {entry.name}"
        data = self._blob("depth", place.node)
        values, png = decode_depth_blob(data, name)
        own = _part(values, place)
        if camera is None:
            return None
        metres = (
            own.astype(np.float32) if own.dtype == np.float32 else scaled_depth(np.ascontiguousarray(own), self._scale)
        )
        height, width = own.shape
        if (width, height) == (camera.width, camera.height):
            if own.dtype == np.float32:
                return as_raw(metres)
            return RawDepth(np.ascontiguousarray(own), self._scale, png if place.parts == 1 else None)
        return in_color(metres, DepthCamera(resized(camera, width, height), np.eye(4)), camera)

    def _blob(self, column: str, node: int) -> bytes:
        try:
            with self._lock:
                row = self._connection.execute(f"SELECT {column} FROM Data WHERE id = ?", (node,)).fetchone()
        except sqlite3.Error as error:
            raise FrameError(f"{self._path}: node {node}: cannot be read: {error}") from error
        if row is None or not isinstance(row[0], bytes):
            raise FrameError(f"{self._path}: node {node}: has no {column}")
        return row[0]


def decode_depth_blob(data: bytes, name: str) -> tuple[npt.NDArray[Any], bytes | None]:
    """Depth as uint16 millimetres or float32 metres ``[H, W]``, and the file where it is a PNG of 16 bits.

    Raises FrameError that begins with `name`.
    """
    if data.startswith(RVL):
        if len(data) < len(RVL) + 8:
            raise FrameError(f"{name}: has only {len(data)} bytes")
        columns, rows = struct.unpack_from("<II", data, len(RVL))
        try:
            return decode_rvl(data[len(RVL) + 8 :], columns, rows), None
        except ValueError as error:
            raise FrameError(f"{name}: {error}") from error
    image = decode_any(data, name)
    if image.ndim == 2 and image.dtype == np.uint16:
        return image, data
    if image.ndim == 3 and image.shape[2] == 4 and image.dtype == np.uint8:  # the bytes of float32
        metres: Float32Array = np.ascontiguousarray(image).view("<f4")[..., 0].astype(np.float32)
        with np.errstate(invalid="ignore"):
            return np.where(metres > 0, metres, np.float32(np.nan)), None
    raise FrameError(f"{name}: is no depth image: it is of {image.dtype} with {image.shape} values (a right image?)")


def _camera_of(item: NodeCamera) -> tuple[Camera, str | None]:
    """The camera, and a note where it is not exact. Raises ValueError for a lens that semdb has no model of."""
    camera, straightener, note = as_camera(item.lens)
    if straightener is not None:
        raise ValueError("its lens is a wide fisheye: export rectified images from RTAB-Map")
    return camera, note


def _part(image: npt.NDArray[Any], place: _Place) -> npt.NDArray[Any]:
    width = image.shape[1] // place.parts
    return image[:, place.part * width : (place.part + 1) * width]


def _pose(blob: Any) -> FloatArray:
    """A pose of 12 float32. Raises ValueError with the reason."""
    if not isinstance(blob, bytes) or len(blob) != 48:
        raise ValueError("has no pose")
    return rigid_pose(np.frombuffer(blob, "<f4").astype(np.float64).reshape(3, 4))


def _optimised(connection: sqlite3.Connection, path: Path) -> dict[int, FloatArray]:
    """Poses of the optimised map by node; empty where there are none. Raises RecordingError for what cannot be read."""
    columns = {str(row[1]) for row in connection.execute("PRAGMA table_info(Admin)")}
    if not columns >= {"opt_ids", "opt_poses"}:
        return {}
    row = connection.execute("SELECT opt_ids, opt_poses FROM Admin LIMIT 1").fetchone()
    if row is None or not row[0] or not row[1]:
        return {}
    try:
        ids = np.frombuffer(_unpacked(row[0]), "<i4")
        poses = np.frombuffer(_unpacked(row[1]), "<f4").astype(np.float64).reshape(-1, 3, 4)
        if len(ids) != len(poses):
            raise ValueError(f"{len(ids)} ids for {len(poses)} poses")
        return {int(node): rigid_pose(pose) for node, pose in zip(ids, poses, strict=True)}
    except (ValueError, zlib.error, struct.error) as error:
        raise RecordingError(f"{path}: the optimised poses in Admin cannot be read: {error}") from error


def _unpacked(blob: bytes) -> bytes:
    """A matrix that RTAB-Map compressed: zlib, then rows, columns and type as int32."""
    if len(blob) < 12:
        raise ValueError("is too short")
    rows, columns, _ = struct.unpack("<3i", blob[-12:])
    if not 0 <= rows * columns <= 1 << 26:
        raise ValueError(f"has {rows}x{columns} values")
    return zlib.decompressobj().decompress(blob[:-12], rows * columns * 4 + 1)


def _version(connection: sqlite3.Connection, path: Path) -> str:
    row = connection.execute("SELECT version FROM Admin LIMIT 1").fetchone()
    version = str(row[0]) if row and row[0] else "?"
    numbers = tuple(int(part) for part in version.split(".") if part.isdecimal())
    if version != "?" and numbers and numbers < OLDEST:
        raise RecordingError(
            f"{path}: was written by RTAB-Map {version}; what is read is {'.'.join(map(str, OLDEST))} and newer: "
            "open it with a newer rtabmap, which converts it"
        )
    return version


def _contents(connection: sqlite3.Connection, version: str, optimised: dict[int, FloatArray]) -> tuple[str, ...]:
    lines = [f"RTAB-Map {version}, {len(optimised)} optimised poses"]
    for table in ("Node", "Link", "Feature", "Word"):
        count = connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
        lines.append(f"{table}: {count}")
    return tuple(lines)


def _time_ns(stamp: Any) -> int | None:
    return round(stamp * 1e9) if isinstance(stamp, int | float) and 0 < stamp < 9e9 else None


def _connect(path: Path) -> sqlite3.Connection:
    """Read only, also while RTAB-Map has it open, or where nothing may be written beside it."""
    try:
        check_place(path)
    except UnusableFileError as error:
        raise RecordingError(error.at(path)) from error
    address = f"{path.absolute().as_uri()}?mode=ro"
    connection = sqlite3.connect(address, uri=True, check_same_thread=False, timeout=5)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError:
        connection.close()
        connection = sqlite3.connect(f"{address}&immutable=1", uri=True, check_same_thread=False)
    return connection


LAYOUT = Layout(
    "rtabmap",
    "RTAB-Map (.db)",
    is_rtabmap,
    lambda path, camera, options: [open_rtabmap(path, camera, options)],
    frozenset({"depth_scale", "poses_are", "axes", "scale"}),
)
