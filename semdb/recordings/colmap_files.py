"""Models of COLMAP, text and binary: cameras, images (poses are camera-from-world) and, where asked for, 3D points.

Source: COLMAP's documentation of its output format. The centre of its first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from semdb.errors import RecordingError
from semdb.files import UnusableFileError, open_regular, parse_number, read_text, split_lines
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.recordings.lens import Lens
from semdb.recordings.lines import read_lines
from semdb.types import FloatArray

# name -> number in binary files, how many parameters, and what they are
MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "FOV": (7, ("fx", "fy", "cx", "cy", "omega")),
    "SIMPLE_RADIAL_FISHEYE": (8, ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": (9, ("f", "cx", "cy", "k1", "k2")),
    "THIN_PRISM_FISHEYE": (10, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
}
BY_NUMBER = {number: name for name, (number, _) in MODELS.items()}
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
HALF = 0.5
LONGEST_NAME = 4096


@dataclass(frozen=True, slots=True, eq=False)
class ModelImage:
    """An image of a model: `camera_from_world` ``[4, 4]`` in the model's units."""

    image_id: int
    name: str
    camera_id: int
    camera_from_world: FloatArray
    points: int  # observations with a 3D point


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """A model: lenses by camera id, images by id, and how many 3D points there are and their mean error in pixels."""

    lenses: dict[int, Lens]
    images: dict[int, ModelImage]
    points: int
    mean_error: float


def model_folder(path: Path) -> Path | None:
    """The folder at or below `path` that holds a model; None where there is none."""
    for name in (".", "sparse/0", "sparse", "0", "colmap/sparse/0", "model"):
        folder = path / name
        for suffix in (".bin", ".txt"):
            if (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file():
                return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """The model in `folder`; of text and binary the binary, as COLMAP does. Raises RecordingError."""
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    if not binary:
        lenses = _text_cameras(folder / "cameras.txt")
        images = _text_images(folder / "images.txt")
        points, error = _text_points(folder / "points3D.txt")
        return ColmapModel(lenses, images, points, error)
    lenses = _binary_cameras(folder / "cameras.bin")
    images = _binary_images(folder / "images.bin")
    points, error = _binary_points(folder / "points3D.bin")
    return ColmapModel(lenses, images, points, error)


def lens_of(name: str, width: int, height: int, values: list[float]) -> Lens:
    """The lens of a COLMAP camera model. Raises ValueError with the reason."""
    if name not in MODELS:
        raise ValueError(f"camera model {name!r} is not known; known are {', '.join(MODELS)}")
    names = MODELS[name][1]
    if len(values) != len(names):
        raise ValueError(f"camera model {name} has {len(names)} parameters, not {len(values)}")
    if name in ("FOV", "THIN_PRISM_FISHEYE"):
        raise ValueError(f"camera model {name} is not read: undistort the images with COLMAP first")
    p = dict(zip(names, values, strict=True))
    fx, fy = p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0))
    if not np.isfinite(values).all() or min(fx, fy) <= 0 or not (0 < width < 65536 and 0 < height < 65536):
        raise ValueError(f"camera {width}x{height} with fx {fx:g} makes no sense")
    cx, cy = p["cx"] - HALF, p["cy"] - HALF
    if name in FISHEYE:
        coefficients = tuple(p.get(key, 0.0) for key in ("k1", "k2", "k3", "k4"))
        return Lens(width, height, fx, fy, cx, cy, "fisheye", coefficients)
    coefficients = tuple(p.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    while coefficients and not coefficients[-1]:
        coefficients = coefficients[:-1]
    if 0 < len(coefficients) < 4:
        coefficients = (*coefficients, *(0.0 for _ in range(4 - len(coefficients))))
    return Lens(width, height, fx, fy, cx, cy, "radial" if coefficients else "pinhole", coefficients)


def _text_cameras(path: Path) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    for number, line in read_lines(path):
        parts = line.split()
        try:
            lens = lens_of(parts[1], int(parts[2]), int(parts[3]), [parse_number(value) for value in parts[4:]])
            lenses[int(parts[0])] = lens
        except (ValueError, IndexError) as error:
            raise RecordingError(f"{path}, line {number}: {error}") from error
    return lenses


def _text_images(path: Path) -> dict[int, ModelImage]:
    """Two lines for each image; the second, of points, may be empty, so lines are not read by `read_lines`."""
    try:
        text = read_text(path, escape=True)
    except UnusableFileError as error:
        raise RecordingError(error.at(path)) from error
    lines = [(number, line) for number, line in enumerate(split_lines(text), 1) if not line.startswith("#")]
    while lines and not lines[0][1].strip():
        lines.pop(0)
    images: dict[int, ModelImage] = {}
    for (number, line), points in zip(lines[::2], [*lines[1::2], (0, "")], strict=False):
        if not line.strip():
            continue
        parts = line.split(maxsplit=9)
        try:
            if len(parts) < 10:
                raise ValueError("needs IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
            pose = _pose([parse_number(value) for value in parts[1:8]])
            seen = points[1].split()[2::3]
            image = ModelImage(int(parts[0]), parts[9].strip(), int(parts[8]), pose, sum(p != "-1" for p in seen))
        except ValueError as error:
            raise RecordingError(f"{path}, line {number}: {error}") from error
        images[image.image_id] = image
    return images


def _text_points(path: Path) -> tuple[int, float]:
    if not path.is_file():
        return 0, float("nan")
    errors = []
    for number, line in read_lines(path):
        try:
            errors.append(parse_number(line.split()[7]))
        except (ValueError, IndexError) as error:
            raise RecordingError(f"{path}, line {number}: is no 3D point") from error
    return len(errors), float(np.mean(errors)) if errors else float("nan")


def _pose(values: list[float]) -> FloatArray:
    if not np.isfinite(values).all():
        raise ValueError("has a number that is not finite")
    return pose_from(rotation_from_quat_wxyz(values[:4]), values[4:])


def _binary_cameras(path: Path) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    with _open(path) as stream:
        for _ in range(_count(stream, path, 24)):
            camera_id, model, width, height = struct.unpack("<IiQQ", _exact(stream, 24, path))
            name = BY_NUMBER.get(model, f"number {model}")
            count = len(MODELS[name][1]) if name in MODELS else 0
            values = struct.unpack(f"<{count}d", _exact(stream, 8 * count, path))
            try:
                lenses[camera_id] = lens_of(name, width, height, list(values))
            except ValueError as error:
                raise RecordingError(f"{path}: camera {camera_id}: {error}") from error
    return lenses


def _binary_images(path: Path) -> dict[int, ModelImage]:
    images: dict[int, ModelImage] = {}
    with _open(path) as stream:
        for _ in range(_count(stream, path, 73)):
            image_id, *values, camera_id = struct.unpack("<I7dI", _exact(stream, 64, path))
            name = _name(stream, path)
            (points,) = struct.unpack("<Q", _exact(stream, 8, path))
            if points > 1 << 28:
                raise RecordingError(f"{path}: image {image_id} says that it has {points} points")
            seen = np.frombuffer(_exact(stream, 24 * points, path), "<i8").reshape(-1, 3)[:, 2]
            try:
                pose = _pose(list(values))
            except ValueError as error:
                raise RecordingError(f"{path}: image {image_id}: {error}") from error
            images[image_id] = ModelImage(image_id, name, camera_id, pose, int((seen != -1).sum()))
    return images


def _binary_points(path: Path) -> tuple[int, float]:
    if not path.is_file():
        return 0, float("nan")
    errors = []
    with _open(path) as stream:
        for _ in range(_count(stream, path, 51)):
            *_, error, track = struct.unpack("<Q3d3BdQ", _exact(stream, 51, path))
            _exact(stream, 8 * min(track, 1 << 40), path)
            errors.append(error)
    return len(errors), float(np.mean(errors)) if errors else float("nan")


def _open(path: Path) -> BinaryIO:
    try:
        return open_regular(path)
    except UnusableFileError as error:
        raise RecordingError(error.at(path)) from error


def _count(stream: BinaryIO, path: Path, least: int) -> int:
    """The number of records that a file says it has. Raises RecordingError where it is too short for so many."""
    (count,) = struct.unpack("<Q", _exact(stream, 8, path))
    if count * least > path.stat().st_size:
        raise RecordingError(f"{path}: says that it has {count} records, but is too short for them (truncated)")
    return int(count)


def _exact(stream: BinaryIO, count: int, path: Path) -> bytes:
    if count > path.stat().st_size:
        raise RecordingError(f"{path}: the file ends too early (truncated); copy it again")
    data = stream.read(count)
    if len(data) < count:
        raise RecordingError(f"{path}: the file ends too early (truncated); copy it again")
    return data


def _name(stream: BinaryIO, path: Path) -> str:
    name = bytearray()
    while (letter := _exact(stream, 1, path)) != b"\0":
        name += letter
        if len(name) > LONGEST_NAME:
            raise RecordingError(f"{path}: has a name of more than {LONGEST_NAME} letters")
    return name.decode(errors="surrogateescape")
