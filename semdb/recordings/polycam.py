"""Polycam's raw data (iPhone with LiDAR, developer mode): ``keyframes/`` with images, cameras, depth and confidence.

Files of a keyframe are named by its time in microseconds. ``cameras/*.json`` has the intrinsics and t_00 to t_23, the
camera-to-world matrix in ARKit's axes. The ``corrected_`` folders, where Polycam has written them, hold optimised poses
and undistorted images and are taken. Depth is 16-bit millimetres, smaller than the image; confidence 0, 127 or 255.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import FrameError, RecordingError
from semdb.files import UnusableFileError, read_json
from semdb.recordings.assembly import Draft, finish
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.images import decode_gray, read_bytes, scaled_depth
from semdb.recordings.numbered import numbered_files
from semdb.recordings.options import BACK, ReadOptions
from semdb.recordings.own_depth import DepthCamera, confident, in_color, resized
from semdb.recordings.poses import rigid_pose
from semdb.types import Camera, FloatArray

DEPTH_SCALE = 1000.0
KEYFRAMES = "keyframes"


def is_polycam(path: Path) -> bool:
    """Whether a folder is raw data of Polycam."""
    folder = path / KEYFRAMES
    return any(
        (folder / f"{kind}cameras").is_dir() and (folder / f"{kind}images").is_dir() for kind in ("corrected_", "")
    )


def open_polycam(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording with Polycam's keyframes in order of time; their index is the position. Raises RecordingError."""
    options = options or ReadOptions()
    folder, notes = path / KEYFRAMES, []
    kind = "corrected_" if _has_files(folder, "corrected_") else ""
    if not kind:
        notes.append("no corrected_cameras/ and corrected_images/: poses and images as ARKit had them, not optimised")
    color = numbered_files(folder / f"{kind}images", (".jpg", ".jpeg", ".png"))
    described = numbered_files(folder / f"{kind}cameras", (".json",))
    depth, confidence = (numbered_files(folder / name, (".png",)) for name in ("depth", "confidence"))
    if not depth:
        notes.append("no images in depth/: the frames have no depth")
    entries, dropped = [], []
    for index, (time_us, image) in enumerate(sorted(color.items())):
        name = image.relative_to(path).as_posix()
        if time_us not in described:
            dropped.append(DroppedFrame(name, f"no {kind}cameras/{image.stem}.json"))
            continue
        if depth and time_us not in depth:
            dropped.append(DroppedFrame(name, "no depth image"))
            continue
        try:
            own, pose = _read_camera(described[time_us], options)
        except ValueError as error:
            dropped.append(DroppedFrame(name, f"{described[time_us].name}: {error}"))
            continue
        entries.append(FrameEntry(index, name, time_us * 1000, image, depth.get(time_us), None, pose, camera=own))
    if not color:
        raise RecordingError(f"{folder / f'{kind}images'}: has no images")
    scale = options.depth_scale or DEPTH_SCALE
    usual = entries[0].camera if entries else None
    known = (
        usual
        if camera is None or usual is None
        else Camera(
            camera.width or usual.width,
            camera.height or usual.height,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            camera.distortion,
        )
    )
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="polycam",
        total_frames=len(color),
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=known,
        depth_scale=scale,
        assumed_scale="" if options.depth_scale else "that of Polycam",
        data=_PolycamData(confidence, known, scale),
    )
    return finish(draft, camera)


class _PolycamData:
    """Images, and depth of its own size."""

    def __init__(self, confidence: dict[int, Path], camera: Camera | None, scale: float) -> None:
        self._confidence, self._camera, self._scale = confidence, camera, scale

    def color(self, entry: FrameEntry) -> RawColor:
        return RawColor(file=read_bytes(entry.image_path))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        camera = entry.camera or self._camera
        if entry.depth_path is None or camera is None:
            return None
        values = decode_gray(read_bytes(entry.depth_path), str(entry.depth_path))
        if values.dtype != np.uint16:
            raise FrameError(f"{entry.depth_path}: depth needs one channel of 16 bits")
        metres = scaled_depth(values, self._scale)
        file = self._confidence.get((entry.timestamp_ns or 0) // 1000)
        if file is not None:
            sure = decode_gray(read_bytes(file), str(file))
            if sure.shape != metres.shape:
                raise FrameError(f"{file}: is of another size than the depth it is about")
            metres = confident(metres, (sure.astype(np.int32) // 127).astype(np.uint8))
        own = resized(camera, metres.shape[1], metres.shape[0])
        return in_color(metres, DepthCamera(own, np.eye(4)), camera)


def _has_files(folder: Path, kind: str) -> bool:
    return all(
        (folder / f"{kind}{name}").is_dir() and any((folder / f"{kind}{name}").iterdir())
        for name in ("cameras", "images")
    )


def _read_camera(file: Path, options: ReadOptions) -> tuple[Camera, FloatArray]:
    """Intrinsics and pose of a keyframe. Raises ValueError with the reason."""
    try:
        content: Any = read_json(file)
    except UnusableFileError as error:
        raise ValueError(f"cannot be read as JSON ({error})") from error
    keys = ["width", "height", "fx", "fy", "cx", "cy", *(f"t_{row}{column}" for row in range(3) for column in range(4))]
    if not isinstance(content, dict):
        raise ValueError("must be a JSON object")
    values: dict[str, float] = {}
    for key in keys:
        value = content.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{key!r} must be a finite number, but is {value!r}")
        values[key] = float(value)
    if min(values[key] for key in keys[:4]) <= 0:
        raise ValueError("has a size or a focal length that is not positive")
    width, height, fx, fy, cx, cy = (values[key] for key in keys[:6])
    pose = rigid_pose(np.reshape([values[key] for key in keys[6:]], (3, 4)))
    turned = options.pose(pose) if options.axes else np.asarray(options.pose(pose) @ BACK)
    return Camera(int(width), int(height), fx, fy, cx, cy), turned


LAYOUT = Layout(
    "polycam",
    "Polycam's raw data (keyframes/)",
    is_polycam,
    lambda path, camera, options: [open_polycam(path, camera, options)],
    frozenset({"depth_scale", "poses_are", "axes", "scale"}),
)
