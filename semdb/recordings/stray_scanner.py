"""Stray Scanner (iPhone with LiDAR): ``rgb.mp4``, ``odometry.csv``, ``camera_matrix.csv``, ``depth/``, ``confidence/``.

Depth is 16-bit millimetres of 256x192 over the same view as the video; confidence is 0 to 2. One line of
``odometry.csv`` (``timestamp, frame, x, y, z, qx, qy, qz, qw``) for each frame of the video: camera-to-world, already
in OpenCV's axes, in ARKit's world with y up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semdb.errors import FrameError, RecordingError
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.recordings.assembly import Draft, finish
from semdb.recordings.association import parse_pose, parse_time_ns
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.cameras import with_size
from semdb.recordings.images import decode_gray, read_bytes, scaled_depth
from semdb.recordings.lines import read_lines
from semdb.recordings.numbered import numbered_files
from semdb.recordings.options import ReadOptions
from semdb.recordings.own_depth import DepthCamera, confident, in_color, resized
from semdb.recordings.poses import numbers_of
from semdb.recordings.video import Video
from semdb.types import Camera

DEPTH_SCALE = 1000.0
VIDEO, ODOMETRY, INTRINSICS = "rgb.mp4", "odometry.csv", "camera_matrix.csv"


def is_stray_scanner(path: Path) -> bool:
    """Whether a folder is an export of Stray Scanner."""
    return (path / ODOMETRY).is_file() and (path / INTRINSICS).is_file()


def open_stray_scanner(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording with the video's frames. Raises RecordingError."""
    options = options or ReadOptions()
    depth = numbered_files(path / "depth", (".png",))
    confidence = numbered_files(path / "confidence", (".png",))
    notes = [] if depth else ["no images in depth/: the frames have no depth"]
    if depth and not confidence:
        notes.append("no images in confidence/: all depth is taken for good")
    entries, dropped, total = _frames(path, depth, options)
    video = Video(path / VIDEO)
    try:
        size = video.size
    except FrameError as error:
        raise RecordingError(str(error)) from error
    known = with_size(camera, size) if camera is not None else _camera(path / INTRINSICS, size)
    scale = options.depth_scale or DEPTH_SCALE
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="stray_scanner",
        total_frames=total,
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=known,
        depth_scale=scale,
        assumed_scale="" if options.depth_scale else "that of Stray Scanner",
        data=_StrayData(video, confidence, known, scale),
    )
    return finish(draft, camera)


class _StrayData:
    """Frames of the video, and depth of its own size."""

    def __init__(self, video: Video, confidence: dict[int, Path], camera: Camera, scale: float) -> None:
        self._video, self._confidence, self._camera, self._scale = video, confidence, camera, scale

    def color(self, entry: FrameEntry) -> RawColor:
        return RawColor(pixels=self._video.frame(entry.index))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        if entry.depth_path is None:
            return None
        values = decode_gray(read_bytes(entry.depth_path), str(entry.depth_path))
        if values.dtype != np.uint16:
            raise FrameError(f"{entry.depth_path}: depth needs one channel of 16 bits")
        metres = scaled_depth(values, self._scale)
        file = self._confidence.get(entry.index)
        if file is not None:
            sure = decode_gray(read_bytes(file), str(file))
            if sure.shape != metres.shape:
                raise FrameError(f"{file}: is of another size than the depth it is about")
            metres = confident(metres, sure.astype(np.uint8))
        own = resized(self._camera, metres.shape[1], metres.shape[0])
        return in_color(metres, DepthCamera(own, np.eye(4)), self._camera)


def _frames(
    path: Path, depth: dict[int, Path], options: ReadOptions
) -> tuple[list[FrameEntry], list[DroppedFrame], int]:
    entries, dropped = [], []
    lines = [(number, line) for number, line in read_lines(path / ODOMETRY) if not line.lower().startswith("timestamp")]
    seen: set[int] = set()
    for number, line in lines:
        values = [value.strip() for value in line.split(",")]
        name = f"{ODOMETRY} line {number}"
        try:
            if len(values) < 9:
                raise ValueError(f"needs timestamp, frame, x, y, z, qx, qy, qz, qw, but has {len(values)} values")
            if not values[1].isdecimal():
                raise ValueError(f"{values[1][:40]!r} is no frame number")
            index = int(values[1])
            quat_wxyz, translation = parse_pose(values[2:9], options.quaternion)
            time_ns = parse_time_ns(values[0])
        except ValueError as error:
            dropped.append(DroppedFrame(name, str(error)))
            continue
        name = f"frame {index}"
        if index in seen:
            dropped.append(DroppedFrame(name, "same frame number as an earlier line"))
        elif depth and index not in depth:
            dropped.append(DroppedFrame(name, "no depth image"))
        else:
            pose = options.pose(pose_from(rotation_from_quat_wxyz(quat_wxyz), translation))
            entries.append(FrameEntry(index, name, time_ns, path / VIDEO, depth.get(index), None, pose))
        seen.add(index)
    return entries, dropped, len(lines)


def _camera(file: Path, size: tuple[int, int]) -> Camera:
    rows = []
    for number, line in read_lines(file):
        try:
            rows.append(numbers_of(line))
        except ValueError as error:
            raise RecordingError(f"{file}, line {number}: {error}") from error
    if [len(row) for row in rows] != [3, 3, 3] or not np.isfinite(rows).all() or min(rows[0][0], rows[1][1]) <= 0:
        raise RecordingError(f"{file}: must have the nine numbers of the intrinsics, three a line")
    return Camera(*size, rows[0][0], rows[1][1], rows[0][2], rows[1][2])


LAYOUT = Layout(
    "stray_scanner",
    "Stray Scanner (rgb.mp4, odometry.csv, depth/)",
    is_stray_scanner,
    lambda path, camera, options: [open_stray_scanner(path, camera, options)],
    frozenset({"depth_scale", "poses_are", "axes", "scale", "quaternion"}),
)
