"""7-Scenes layout: ``frame-XXXXXX.color.(png|jpg)``, ``.depth.png``, ``.pose.txt`` in one folder per sequence.

``pose.txt`` is the pose of the depth camera. Frames get the pose of the colour camera, and depth is registered to
the colour image when it is decoded (`semdb.recordings.registration`).
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from semdb.errors import RecordingError
from semdb.geometry import pose_from, project_to_so3
from semdb.recordings.assembly import Draft, finish, no_usable_frame
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, Recording
from semdb.recordings.cameras import SEVEN_SCENES_COLOR, SEVEN_SCENES_DEPTH_SCALE
from semdb.recordings.options import ReadOptions
from semdb.recordings.registration import DEPTH_FROM_COLOR, REGISTRATION_7SCENES
from semdb.types import Camera, FloatArray

FRAME_FILE = re.compile(r"frame-(\d+)\.(color\.png|color\.jpg|color\.jpeg|depth\.png|pose\.txt)")
SEQUENCE = re.compile(r"seq-?\d+")
ROTATION_TOLERANCE = 0.02  # published poses are off by up to 4e-4


def is_seven_scenes(path: Path) -> bool:
    """Whether a folder holds frames of one sequence."""
    return any(FRAME_FILE.fullmatch(entry.name) for entry in os.scandir(path))


def find_sequences(path: Path) -> list[Path]:
    """Folders ``seq-XX`` with frames below a scene folder, in order of their names."""
    folders = (Path(entry.path) for entry in os.scandir(path) if SEQUENCE.fullmatch(entry.name) and entry.is_dir())
    return sorted(folder for folder in folders if is_seven_scenes(folder))


def sequence_name(path: Path) -> str:
    """``<scene>-seq-01`` for a folder seq-01, else the folder's name."""
    folder = path.resolve()
    return f"{folder.parent.name}-{folder.name}" if SEQUENCE.fullmatch(folder.name) else folder.name


def open_seven_scenes(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """One sequence of 7-Scenes. `camera`, when given, is the colour camera; the depth camera stays the known one.

    Frames have no times (`timestamp_ns` None). Frames without colour, depth or pose, or with a pose that is no
    rigid motion, are dropped; where no frame at all has depth (or a pose), all are kept without (noted).
    Raises RecordingError.
    """
    options = options or ReadOptions()
    files = _list_frames(path)
    draft = Draft(
        path=path,
        name=sequence_name(path),
        format="seven_scenes",
        total_frames=len(files),
        entries=[],
        dropped=[],
        depth_registration=REGISTRATION_7SCENES,
        known_camera=SEVEN_SCENES_COLOR,
        depth_scale=options.depth_scale or SEVEN_SCENES_DEPTH_SCALE,
    )
    has_depth = any("depth" in parts for parts in files.values())
    has_poses = any("pose" in parts for parts in files.values())
    if not has_depth:
        draft.notes.append("no frame-*.depth.png: the frames have no depth")
    if not has_poses:
        draft.notes.append("no frame-*.pose.txt: the frames have no pose and cannot become keyframes")
    for number, parts in sorted(files.items()):
        entry = _entry(path, number, parts, has_depth, has_poses, options)
        if isinstance(entry, DroppedFrame):
            draft.dropped.append(entry)
        else:
            draft.entries.append(entry)
    if not draft.entries:
        raise no_usable_frame(draft)
    return finish(draft, camera)


def read_pose(path: Path) -> FloatArray:
    """The 4x4 matrix of a ``pose.txt``, its rotation projected to SO(3). Raises ValueError with the reason."""
    try:
        rows = [
            [float(value) for value in line.split()] for line in path.read_text("utf-8").splitlines() if line.strip()
        ]
    except FileNotFoundError as error:
        raise ValueError("the file is missing") from error
    except OSError as error:
        raise ValueError(f"the file cannot be read: {error.strerror}") from error
    except ValueError as error:  # also what is no text
        raise ValueError("has something that is no number") from error
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise ValueError("is no matrix of 4 by 4 numbers")
    matrix = np.array(rows)
    if not np.isfinite(matrix).all():
        raise ValueError("has a number that is not finite")
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise ValueError("is no rigid motion: its last row is not 0 0 0 1")
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(rotation) <= 0:
        raise ValueError(f"is no rotation (R^T R differs from the identity by {off:.2g})")
    return pose_from(project_to_so3(rotation), matrix[:3, 3])


def _list_frames(path: Path) -> dict[int, dict[str, str]]:
    """File names by frame number and kind (color, depth, pose)."""
    files: dict[int, dict[str, str]] = {}
    for entry in sorted(os.scandir(path), key=lambda item: item.name, reverse=True):  # of two colour files, the png
        match = FRAME_FILE.fullmatch(entry.name)
        if match:
            files.setdefault(int(match.group(1)), {})[match.group(2).split(".")[0]] = entry.name
    if not files:
        raise RecordingError(f"{path}: no files frame-XXXXXX.color.png, .depth.png, .pose.txt")
    return files


def _entry(
    path: Path, number: int, parts: dict[str, str], has_depth: bool, has_poses: bool, options: ReadOptions
) -> FrameEntry | DroppedFrame:
    name = parts.get("color") or f"frame-{number:06d}"
    if "color" not in parts:
        return DroppedFrame(name, f"no colour image (only {', '.join(sorted(parts.values()))})")
    if has_depth and "depth" not in parts:
        return DroppedFrame(name, "no depth image")
    pose = None
    if has_poses:
        if "pose" not in parts:
            return DroppedFrame(name, "no pose.txt")
        try:
            pose = options.pose(read_pose(path / parts["pose"])) @ DEPTH_FROM_COLOR
        except ValueError as error:
            return DroppedFrame(name, f"{parts['pose']}: {error}")
    depth_path = path / parts["depth"] if "depth" in parts else None
    return FrameEntry(number, name, None, path / parts["color"], depth_path, None, pose)


def _open(path: Path, camera: Camera | None, options: ReadOptions) -> list[Recording]:
    sequences = [path] if is_seven_scenes(path) else find_sequences(path)
    return [open_seven_scenes(sequence, camera, options) for sequence in sequences]


LAYOUT = Layout(
    "seven_scenes",
    "7-Scenes (frame-XXXXXX.color.png, or folders seq-XX of them)",
    lambda path: path.is_dir() and (is_seven_scenes(path) or bool(find_sequences(path))),
    _open,
    frozenset({"depth_scale", "poses_are", "axes"}),
)
