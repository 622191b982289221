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
from semdb.recordings.assembly import Draft, finish, no_usable_frame, use_camera_file
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, Recording
from semdb.recordings.camera_files import read_matrix
from semdb.recordings.cameras import SEVEN_SCENES_COLOR, SEVEN_SCENES_DEPTH_SCALE
from semdb.recordings.focus import is_wanted
from semdb.recordings.options import ReadOptions
from semdb.recordings.poses import rigid_pose
from semdb.recordings.registration import DEPTH_FROM_COLOR, REGISTRATION_7SCENES
from semdb.types import Camera, FloatArray

FRAME_FILE = re.compile(r"frame-([0-9]+)\.(color\.png|color\.jpg|color\.jpeg|depth\.png|pose\.txt)")
SEQUENCE = re.compile(r"seq-?\d+")


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

    Others name frames likewise: where a camera file lies beside them, depth and poses are of that camera.
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
        depth_scale=SEVEN_SCENES_DEPTH_SCALE,
        assumed_scale="that of 7-Scenes",
    )
    _set_camera(draft, path, camera, options)
    has_depth = any("depth" in parts for parts in files.values())
    has_poses = any("pose" in parts for parts in files.values())
    if not has_depth:
        draft.notes.append("no frame-*.depth.png: the frames have no depth")
    if not has_poses:
        draft.notes.append("no frame-*.pose.txt: the frames have no pose")
    for number, parts in sorted(files.items()):
        if not is_wanted(parts.get("color", ""), len(draft.entries)):
            continue
        entry = _entry(draft, number, parts, has_depth, has_poses, options)
        if isinstance(entry, DroppedFrame):
            draft.dropped.append(entry)
        else:
            draft.entries.append(entry)
    if not draft.entries:
        raise no_usable_frame(draft)
    return finish(draft, camera)


def read_pose(path: Path) -> FloatArray:
    """The 4x4 matrix of a ``pose.txt``, its rotation projected to SO(3). Raises ValueError with the reason."""
    matrix = read_matrix(path)
    if matrix.shape in ((3, 4), (1, 12)):  # the last row says nothing
        matrix = np.vstack([matrix.reshape(3, 4), (0, 0, 0, 1)])
    if matrix.size != 16:
        raise ValueError("is no matrix of 4 by 4 numbers")
    return rigid_pose(matrix.reshape(4, 4))


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


def _set_camera(draft: Draft, path: Path, camera: Camera | None, options: ReadOptions) -> None:
    """A camera file beside the frames, or of the scene (3DMatch), takes the place of all that 7-Scenes' devices are."""
    scene = (path.resolve().parent,) if SEQUENCE.fullmatch(path.resolve().name) else ()
    if use_camera_file(draft, camera, options, path, *scene):
        draft.depth_registration = ""
        return
    own = "" if camera is not None else "colour camera 525,525,320,240, "
    draft.assumed.append(
        f"camera: 7-Scenes', by the names of the files: {own}depth camera 585,585,320,240, whose pose the files hold "
        "and which is registered to colour; where other cameras took the frames, put a camera.json beside them"
    )


def _entry(
    draft: Draft, number: int, parts: dict[str, str], has_depth: bool, has_poses: bool, options: ReadOptions
) -> FrameEntry | DroppedFrame:
    path = draft.path
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
            pose = options.pose(read_pose(path / parts["pose"]))
            if draft.depth_registration:  # the files hold the depth camera's
                pose = pose @ DEPTH_FROM_COLOR
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
    frozenset({"depth_scale", "poses_are", "axes", "scale"}),
)
