"""Files beside frames that say what took them: ``camera.json``, and the matrices that other tools write.

Such a file is always used, whatever the layout, or the recording is refused: names of frames alone say nothing about
the camera. Sources: Open3D's PinholeCameraIntrinsic (``intrinsic_matrix``, column by column), 3DMatch's
``camera-intrinsics.txt`` (3x3 by rows), the 4x4 matrices of ScanNet's exporter, ``info.txt`` of BundleFusion.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import RecordingError
from semdb.files import UnusableFileError, fields_of, numbered_lines, parse_number, read_json, read_text
from semdb.recordings.intrinsics import depth_scale_problem
from semdb.types import Camera, FloatArray

CAMERA_FILE = "camera.json"
NAMES_SHOWN = 5
MOST_MATRIX_BYTES = 1 << 16
_NAMES = re.compile(
    r"(?:.*[-_. ])?(?:cameras?|cam|intrinsics?|calib(?:ration)?|K)(?:[-_. ].*)?"
    r"\.(?:json|txt|ya?ml|xml|ini|cfg|conf|csv)",
    re.IGNORECASE,
)
_INFO = re.compile(r"_?info\.txt")
_INFO_KEY = "m_calibrationColorIntrinsic"
_OTHER_THINGS = re.compile(r"pose|traj|extrinsic|path|imu|settings", re.IGNORECASE)
_REMEDY = f"write its intrinsics into a {CAMERA_FILE} there, or give --camera fx,fy,cx,cy"


@dataclass(frozen=True, slots=True)
class CameraFile:
    """What a file says. `camera` has a width and height of 0, `depth_scale` is None, where it does not say."""

    path: Path
    camera: Camera
    depth_scale: float | None = None


def find_camera_file(*folders: Path) -> CameraFile | None:
    """What the camera file in the first of `folders` that has one says; None where none has.

    Raises RecordingError for a file that looks like one and cannot be read, and for several, unless one of them is
    ``camera.json``.
    """
    for folder in folders:
        names = camera_file_names(folder)
        if CAMERA_FILE in names:
            return read_camera_file(folder / CAMERA_FILE)
        if len(names) > 1:
            some = ", ".join(names[:NAMES_SHOWN]) + (", ..." if len(names) > NAMES_SHOWN else "")
            raise RecordingError(f"{folder}: {some} may each be the camera of these frames: {_REMEDY}")
        if names:
            return _read_other(folder / names[0])
    return None


def camera_file_names(folder: Path) -> list[str]:
    """Names of the files in `folder` that look like intrinsics."""
    try:
        names = sorted(entry.name for entry in folder.iterdir())
    except OSError:
        return []
    return [name for name in names if _looks_like_one(folder, name)]


def _looks_like_one(folder: Path, name: str) -> bool:
    if _INFO.fullmatch(name):
        try:
            return _INFO_KEY in read_text(folder / name, MOST_MATRIX_BYTES, escape=True)
        except UnusableFileError:
            return False
    return _NAMES.fullmatch(name) is not None and _OTHER_THINGS.search(name) is None


def read_camera_file(path: Path) -> CameraFile:
    """Camera and depth scale of a ``camera.json``. Raises RecordingError that names the file and the key."""
    content = _read_object(path)
    missing = [key for key in ("width", "height", "fx", "fy", "cx", "cy") if key not in content]
    if missing and "intrinsic_matrix" not in content:
        raise RecordingError(f"{path}: {', '.join(missing)} missing")
    return _from_object(path, content)


def read_matrix(path: Path) -> FloatArray:
    """The numbers of a text file ``[rows, columns]``, however they are divided. Raises ValueError with the reason."""
    try:
        lines = numbered_lines(read_text(path, MOST_MATRIX_BYTES, escape=True))
    except UnusableFileError as error:
        raise ValueError(str(error)) from error
    rows = [[parse_number(value) for value in fields_of(line)[0]] for _, line in lines]
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError("is no matrix of numbers")
    return np.array(rows)


def _read_other(path: Path) -> CameraFile:
    """A file that is not called ``camera.json``: a matrix, or JSON with the same keys. Raises RecordingError."""
    if path.suffix.lower() == ".json":
        content = _read_object(path)
        if "intrinsic_matrix" not in content and not {"fx", "fy", "cx", "cy"} <= set(content):
            raise RecordingError(f"{path}: looks like the camera of these frames, but has no fx, fy, cx, cy: {_REMEDY}")
        return _from_object(path, content)
    try:
        if _INFO.fullmatch(path.name):
            return _from_info(path)
        if path.suffix.lower() not in (".txt", ".csv"):
            raise ValueError("is of a format that semdb does not know")
        return CameraFile(path, _from_matrix(read_matrix(path)))
    except ValueError as error:
        raise RecordingError(f"{path}: looks like the camera of these frames, but {error}: {_REMEDY}") from error


def _from_matrix(matrix: FloatArray) -> Camera:
    """The camera of a 3x3, 3x4 or 4x4 matrix, or of the numbers of a 3x3 one in a row. Raises ValueError."""
    if matrix.size == 9:
        matrix = matrix.reshape(3, 3)
    if matrix.shape not in ((3, 3), (3, 4), (4, 4)):
        raise ValueError(f"it holds {matrix.shape[0]}x{matrix.shape[1]} numbers, which are no matrix of intrinsics")
    inner = matrix[:3, :3]
    if inner[0, 2] == 0 and inner[1, 2] == 0:
        inner = inner.T  # written column by column
    others = np.array([inner[0, 1], inner[1, 0], inner[2, 0], inner[2, 1], inner[2, 2] - 1, *matrix[:3, 3:].ravel()])
    if np.abs(others).max() > 1e-3:
        raise ValueError("its matrix is not that of a pinhole camera (fx 0 cx, 0 fy cy, 0 0 1)")
    if not (inner[0, 0] > 0 and inner[1, 1] > 0):
        raise ValueError("its focal lengths are not positive")
    return Camera(0, 0, float(inner[0, 0]), float(inner[1, 1]), float(inner[0, 2]), float(inner[1, 2]))


def _from_info(path: Path) -> CameraFile:
    """Lines ``m_key = value``, matrices 4x4 by rows. Raises ValueError where colour and depth differ."""
    lines = numbered_lines(read_text(path, MOST_MATRIX_BYTES, escape=True))
    values = {key.strip(): value.strip() for key, _, value in (line.partition("=") for _, line in lines)}

    def matrix(kind: str) -> FloatArray:
        return np.array([parse_number(part) for part in values.get(f"m_calibration{kind}Intrinsic", "").split()])

    def size(kind: str) -> tuple[float, ...]:
        return tuple(parse_number(values.get(f"m_{kind}{side}", "0")) for side in ("Width", "Height"))

    colour, depth = matrix("Color"), matrix("Depth")
    if colour.shape != (16,):
        raise ValueError(f"{_INFO_KEY} is no matrix of 4x4 numbers")
    if size("color") != size("depth") or (len(depth) and not np.allclose(colour, depth)):
        raise ValueError("colour and depth have cameras of their own there, so depth is not registered to colour")
    pinhole = _from_matrix(colour.reshape(4, 4))
    width, height = (int(value) for value in size("color"))
    scale = parse_number(values.get("m_depthShift", "0")) or None
    if scale is not None and depth_scale_problem(scale):
        raise ValueError(str(depth_scale_problem(scale)))
    return CameraFile(path, replace(pinhole, width=width, height=height), scale)


def _read_object(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except UnusableFileError as error:
        raise RecordingError(error.at(path)) from error
    if not isinstance(content, dict):
        raise RecordingError(f"{path}: must be a JSON object with width, height, fx, fy, cx, cy")
    return content


def _from_object(path: Path, content: dict[str, Any]) -> CameraFile:
    width, height = (_number(path, key, content.get(key, 0)) for key in ("width", "height"))
    if width != int(width) or height != int(height) or ("width" in content and min(width, height) < 1):
        raise RecordingError(f"{path}: 'width' and 'height' must be positive whole numbers")
    if "intrinsic_matrix" in content:
        pinhole = _from_columns(path, content["intrinsic_matrix"])
    else:
        focal = [_number(path, key, content[key], positive=True) for key in ("fx", "fy")]
        centre = [_number(path, key, content[key]) for key in ("cx", "cy")]
        pinhole = Camera(0, 0, focal[0], focal[1], centre[0], centre[1])
    distortion = content.get("distortion") or []
    if not isinstance(distortion, list) or len(distortion) not in (0, 4, 5):
        raise RecordingError(f"{path}: 'distortion' must be a list of k1, k2, p1, p2 and perhaps k3")
    values = tuple(_number(path, "distortion", value) for value in distortion)
    camera = Camera(int(width), int(height), pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, values)
    if content.get("depth_scale") is None:
        return CameraFile(path, camera)
    scale = _number(path, "depth_scale", content["depth_scale"], positive=True)
    problem = depth_scale_problem(scale)
    if problem:
        raise RecordingError(f"{path}: {problem}")
    return CameraFile(path, camera, scale)


def _from_columns(path: Path, values: Any) -> Camera:
    """Open3D's matrix: nine numbers, column by column."""
    if not isinstance(values, list) or len(values) != 9:
        raise RecordingError(f"{path}: 'intrinsic_matrix' must be a list of nine numbers, column by column")
    try:
        return _from_matrix(np.array([_number(path, "intrinsic_matrix", value) for value in values]).reshape(3, 3).T)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def _number(path: Path, key: str, value: object, *, positive: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise RecordingError(f"{path}: {key!r} must be a finite number, but is {repr(value)[:60]}")
    if positive and value <= 0:
        raise RecordingError(f"{path}: {key!r} must be positive, but is {value!r}")
    return float(value)
