"""Folders as Open3D's reconstruction system and the Redwood data sets have them.

``color/`` (or ``rgb/``, ``image/``) and ``depth/`` with numbered images, ``intrinsic.json`` (Open3D's
PinholeCameraIntrinsic, its matrix column by column) and a trajectory ``*.log``: for each frame a line of three numbers
and the four lines of a camera-to-world matrix.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import RecordingError
from semdb.files import UnusableFileError, read_json
from semdb.recordings.assembly import Draft, finish, use_camera_file
from semdb.recordings.base import Layout, Recording
from semdb.recordings.lines import read_lines
from semdb.recordings.numbered import entries_of, numbered_files
from semdb.recordings.options import ReadOptions
from semdb.recordings.poses import numbers_of, rigid_pose
from semdb.types import Camera, FloatArray

COLOR_FOLDERS = ("color", "rgb", "image")
INTRINSICS = ("intrinsic.json", "camera_intrinsic.json", "intrinsics.json")
PRIME_SENSE = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
DEPTH_SCALE = 1000.0


def is_redwood(path: Path) -> bool:
    """Whether a folder has colour and depth in folders and a trajectory or the intrinsics as Open3D writes them."""
    if not path.is_dir() or not (path / "depth").is_dir() or _color_folder(path) is None:
        return False
    return any((path / name).is_file() for name in INTRINSICS) or bool(_logs(path))


def open_redwood(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording of which the n-th pose belongs to the n-th image in order of numbers. Raises RecordingError."""
    options = options or ReadOptions()
    folder = _color_folder(path) or path / "color"
    color, depth = numbered_files(folder), numbered_files(path / "depth", (".png",))
    notes: list[str] = []
    poses = _poses(path, color, options, notes)
    known = _intrinsics(path)
    if not depth:
        notes.append("no images in depth/: the frames have no depth")
    entries, dropped = entries_of(path, color, depth or None, poses)
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="redwood",
        total_frames=len(color),
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=known,
        depth_scale=options.depth_scale or DEPTH_SCALE,
        assumed_scale="" if options.depth_scale else "Open3D's default",
    )
    if known is None and not use_camera_file(draft, camera, options, path):
        draft.known_camera = PRIME_SENSE
        draft.notes.append(
            "no intrinsic.json: taken for Open3D's default, a PrimeSense of 640x480, 525,525,319.5,239.5"
        )
    return finish(draft, camera)


def read_log(path: Path) -> list[FloatArray]:
    """The camera-to-world matrices of a ``.log``. Raises RecordingError with the line."""
    lines = read_lines(path)
    if len(lines) % 5:
        raise RecordingError(f"{path}: has {len(lines)} lines; blocks of five are needed (three numbers, a 4x4 matrix)")
    poses = []
    for start in range(0, len(lines), 5):
        try:
            poses.append(rigid_pose([numbers_of(line) for _, line in lines[start + 1 : start + 5]]))
        except ValueError as error:
            what = str(error) if "inhomogeneous" not in str(error) else "is no matrix of 4 by 4 numbers"
            raise RecordingError(f"{path}, line {lines[start][0]}: the matrix after it {what}") from error
    if not poses:
        raise RecordingError(f"{path}: has no pose")
    return poses


def _color_folder(path: Path) -> Path | None:
    return next((path / name for name in COLOR_FOLDERS if (path / name).is_dir()), None)


def _logs(path: Path) -> list[Path]:
    return sorted(path.glob("*.log")) + sorted(path.glob("scene/*.log"))


def _poses(
    path: Path, color: dict[int, Path], options: ReadOptions, notes: list[str]
) -> dict[int, FloatArray | str] | None:
    logs = _logs(path)
    if not logs:
        notes.append("no trajectory .log: the frames have no pose")
        return None
    if len(logs) > 1:
        names = ", ".join(str(log.relative_to(path)) for log in logs)
        notes.append(f"several trajectories ({names}): {logs[0].relative_to(path)} is taken")
    poses = [options.pose(pose) for pose in read_log(logs[0])]
    if len(poses) != len(color):
        notes.append(
            f"{logs[0].name}: {len(poses)} poses for {len(color)} colour images; they belong together in order"
        )
    return dict(zip(sorted(color), poses, strict=False))


def _intrinsics(path: Path) -> Camera | None:
    for name in INTRINSICS:
        file = path / name
        if not file.is_file():
            continue
        try:
            content: Any = read_json(file)
            matrix = np.reshape([float(v) for v in content["intrinsic_matrix"]], (3, 3)).T
            size = int(content["width"]), int(content["height"])
        except UnusableFileError as error:
            raise RecordingError(error.at(file)) from error
        except (ValueError, KeyError, TypeError) as error:
            raise RecordingError(
                f"{file}: must be a JSON object with width, height and the nine numbers of intrinsic_matrix "
                f"({type(error).__name__}: {error})"
            ) from error
        if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1], *size) <= 0:
            raise RecordingError(f"{file}: has a number that makes no sense")
        return Camera(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    return None


LAYOUT = Layout(
    "redwood",
    "Open3D and Redwood (color/, depth/, intrinsic.json, *.log)",
    is_redwood,
    lambda path, camera, options: [open_redwood(path, camera, options)],
    frozenset({"depth_scale", "poses_are", "axes", "scale"}),
)
