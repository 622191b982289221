"""kapture 1.1: ``sensors/`` with sensors, rigs, trajectories and records as text between commas, and records_data.

Poses are device-from-world, quaternion first; a rig's sensors have sensor-from-rig. ``.depth`` files are raw
little-endian float32 metres of the size of their sensor. Times are whole numbers of no certain unit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semdb.errors import FrameError, RecordingError
from semdb.files import parse_number
from semdb.geometry import invert_pose, pose_error, pose_from, rotation_from_quat_wxyz
from semdb.recordings.assembly import Draft, finish
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.colmap_files import HALF, MODELS, lens_of
from semdb.recordings.images import decode_color, read_bytes
from semdb.recordings.lens import Lens, Straightener, as_camera
from semdb.recordings.lines import read_lines
from semdb.recordings.options import ReadOptions
from semdb.recordings.own_depth import SCALE, DepthCamera, as_raw, in_color
from semdb.types import Camera, FloatArray

CAMERA, DEPTH = "camera", "depth"
CLOSE = (1e-4, 0.01)  # metres and degrees within which two sensors are at one place


@dataclass(frozen=True, slots=True)
class Sensor:
    """A camera or depth sensor with its lens."""

    kind: str
    lens: Lens


@dataclass(frozen=True, slots=True)
class _Record:
    time: int
    device: str
    path: str


def is_kapture(path: Path) -> bool:
    """Whether a folder is a data set of kapture."""
    return (path / "sensors" / "sensors.txt").is_file()


def open_kapture(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording of the images of all cameras, in order of time and sensor. Raises RecordingError."""
    options = options or ReadOptions()
    folder = path / "sensors"
    notes: list[str] = []
    sensors = _sensors(folder / "sensors.txt", notes)
    rigs = _rigs(folder / "rigs.txt")
    poses = _trajectories(folder / "trajectories.txt", options)
    color = [record for record in _records(folder / "records_camera.txt") if record.device in sensors]
    depth = [record for record in _records(folder / "records_depth.txt") if record.device in sensors]
    data = folder / "records_data"
    there = [record for record in color if (data / record.path).is_file()]
    contents = f"{len(sensors)} sensors, {len(poses)} poses, {len(color)} records of images, {len(depth)} of depth"
    if not there:
        raise RecordingError(f"{path}: none of the {len(color)} images is in {data}; it holds {contents}")
    usable = [record for record in depth if (data / record.path).is_file()]
    if not usable:
        notes.append("no depth files that are listed and there: the frames have no depth")
    if not poses:
        notes.append("no poses in trajectories.txt: the frames have no pose")
    by_time: dict[int, list[_Record]] = {}
    for record in usable:
        by_time.setdefault(record.time, []).append(record)
    entries, dropped, sources = [], [], {}
    cameras: dict[str, tuple[Camera, Straightener | None]] = {}
    for index, record in enumerate(sorted(color, key=lambda item: (item.time, item.device))):
        if record.device not in cameras:
            own, straight, note = as_camera(sensors[record.device].lens)
            cameras[record.device] = own, straight
            notes += [note] if note else []
        pose, reason = _pose_of(record, poses, rigs)
        if poses and pose is None:
            dropped.append(DroppedFrame(record.path, reason))
            continue
        if pose is not None:
            pose = options.pose(pose)
        source = _depth_of(record, by_time.get(record.time, ()), sensors, rigs)
        if usable and source is None:
            dropped.append(DroppedFrame(record.path, "no depth of the same time"))
            continue
        sources[index] = source
        own = cameras[record.device][0]
        place = data / source[0].path if source else None
        entries.append(FrameEntry(index, record.path, None, data / record.path, place, None, pose, camera=own))
    straighteners = {name: found[1] for name, found in cameras.items()}
    devices = {index: record.device for index, record in enumerate(sorted(color, key=lambda r: (r.time, r.device)))}
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="kapture",
        total_frames=len(color),
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=entries[0].camera if entries else None,
        depth_scale=SCALE,
        data=_KaptureData(sources, sensors, devices, straighteners),
        contents=(contents,),
    )
    if camera is not None and draft.known_camera is not None:
        known = draft.known_camera
        draft.known_camera = Camera(
            known.width, known.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion
        )
    return finish(draft, camera)


class _KaptureData:
    """Images, and depth as raw float32."""

    def __init__(
        self,
        sources: dict[int, tuple[_Record, FloatArray] | None],
        sensors: dict[str, Sensor],
        devices: dict[int, str],
        straight: dict[str, Straightener | None],
    ) -> None:
        self._sources, self._sensors, self._devices, self._straight = sources, sensors, devices, straight

    def color(self, entry: FrameEntry) -> RawColor:
        file = read_bytes(entry.image_path)
        straight = self._straight.get(self._devices[entry.index])
        if straight is None:
            return RawColor(file=file)
        return RawColor(pixels=straight.color(decode_color(file, str(entry.image_path))))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        source = self._sources.get(entry.index)
        if source is None or entry.depth_path is None:
            return None
        record, color_from_depth = source
        lens = self._sensors[record.device].lens
        data = read_bytes(entry.depth_path)
        if len(data) != 4 * lens.width * lens.height:
            raise FrameError(
                f"{entry.depth_path}: has {len(data)} bytes, but {lens.width}x{lens.height} float32 have "
                f"{4 * lens.width * lens.height}"
            )
        depth = np.frombuffer(data, "<f4").reshape(lens.height, lens.width).astype(np.float32)
        with np.errstate(invalid="ignore"):
            depth = np.where(depth > 0, depth, np.float32(np.nan))
        camera = entry.camera
        own = self._sensors[self._devices[entry.index]].lens
        if lens == own and np.array_equal(color_from_depth, np.eye(4)) and self._straight.get(record.device) is None:
            return as_raw(depth)
        if camera is None:
            return None
        return in_color(depth, DepthCamera(as_camera(lens)[0], color_from_depth), camera)


def _rows(path: Path, least: int) -> Iterable[tuple[int, list[str]]]:
    """Lines of at least `least` values. Raises RecordingError with the line."""
    if not path.is_file():
        return
    for number, line in read_lines(path):
        values = [value.strip() for value in line.split(",")]
        if len(values) < least:
            raise RecordingError(f"{path}, line {number}: needs {least} values between commas, but has {len(values)}")
        yield number, values


def _sensors(path: Path, notes: list[str]) -> dict[str, Sensor]:
    found: dict[str, Sensor] = {}
    for number, values in _rows(path, 3):
        if values[2] not in (CAMERA, DEPTH):
            continue
        try:
            if values[3] not in MODELS:
                raise ValueError(f"camera model {values[3]!r} is not known")
            lens = lens_of(
                values[3],
                int(parse_number(values[4])),
                int(parse_number(values[5])),
                [parse_number(value) for value in values[6:]],
            )
        except (ValueError, IndexError) as error:
            notes.append(f"{path.name} line {number}: sensor {values[0]}: {error}: left out")
            continue
        # kapture's pixels begin at their corner as COLMAP's do in its own models, but its RGB-D data sets give OpenCV's
        cx, cy = lens.cx + HALF, lens.cy + HALF
        found[values[0]] = Sensor(
            values[2], Lens(lens.width, lens.height, lens.fx, lens.fy, cx, cy, lens.model, lens.coefficients)
        )
    if not any(sensor.kind == CAMERA for sensor in found.values()):
        raise RecordingError(f"{path}: names no camera whose model is known")
    return found


def _rigs(path: Path) -> dict[str, list[tuple[str, FloatArray]]]:
    """Rigs by sensor: the rig and sensor_from_rig."""
    found: dict[str, list[tuple[str, FloatArray]]] = {}
    for number, values in _rows(path, 9):
        try:
            found.setdefault(values[1], []).append((values[0], _matrix(values[2:9])))
        except ValueError as error:
            raise RecordingError(f"{path}, line {number}: {error}") from error
    return found


def _trajectories(path: Path, options: ReadOptions) -> dict[tuple[int, str], FloatArray]:
    """device_from_world by time and device."""
    found: dict[tuple[int, str], FloatArray] = {}
    for number, values in _rows(path, 9):
        try:
            found[int(values[0]), values[1]] = _matrix(values[2:9])
        except ValueError as error:
            raise RecordingError(f"{path}, line {number}: {error}") from error
    return found


def _records(path: Path) -> list[_Record]:
    found = []
    for number, values in _rows(path, 3):
        try:
            found.append(_Record(int(values[0]), values[1], ",".join(values[2:])))
        except ValueError as error:
            raise RecordingError(f"{path}, line {number}: {values[0]!r} is no time") from error
    return found


def _matrix(values: list[str]) -> FloatArray:
    numbers = [parse_number(value) for value in values]
    if not np.isfinite(numbers).all():
        raise ValueError("has a number that is not finite")
    return pose_from(rotation_from_quat_wxyz(numbers[:4]), numbers[4:])


def _pose_of(
    record: _Record, poses: dict[tuple[int, str], FloatArray], rigs: dict[str, list[tuple[str, FloatArray]]]
) -> tuple[FloatArray | None, str]:
    """``world_from_camera`` of a record: of its sensor, or of a rig that it is part of."""
    own = poses.get((record.time, record.device))
    if own is not None:
        return invert_pose(own), ""
    for rig, sensor_from_rig in rigs.get(record.device, ()):
        found = poses.get((record.time, rig))
        if found is not None:
            return invert_pose(np.asarray(sensor_from_rig @ found)), ""
    return None, f"no pose of {record.device} at {record.time}"


def _depth_of(
    record: _Record,
    depths: Iterable[_Record],
    sensors: dict[str, Sensor],
    rigs: dict[str, list[tuple[str, FloatArray]]],
) -> tuple[_Record, FloatArray] | None:
    """The depth of the same time and rig, that which is registered to colour first, and color_from_depth."""
    found: list[tuple[bool, str, _Record, FloatArray]] = []
    own = dict(rigs.get(record.device, ()))
    for depth in depths:
        if depth.device == record.device:
            pose = np.eye(4)
        else:
            joint = [(own[rig], pose) for rig, pose in rigs.get(depth.device, ()) if rig in own]
            if not joint:
                continue
            pose = np.asarray(joint[0][0] @ invert_pose(joint[0][1]))
        distance, angle = pose_error(pose, np.eye(4))
        together = distance < CLOSE[0] and angle < CLOSE[1]
        registered = together and sensors[depth.device].lens == sensors[record.device].lens
        found.append((not registered, depth.device, depth, np.eye(4) if together else pose))
    if not found:
        return None
    best = min(found, key=lambda item: item[:2])
    return best[2], best[3]


LAYOUT = Layout(
    "kapture",
    "kapture (sensors/sensors.txt)",
    is_kapture,
    lambda path, camera, options: [open_kapture(path, camera, options)],
    frozenset({"poses_are", "axes", "scale"}),
)
