"""ICL-NUIM in its TUM-compatible PNG layout.

The data set was rendered in a left-handed world with y up: its camera has x right, y up, z forward, which is why
its page gives fy = -480. The TUM-compatible PNGs are stored top row first like any other image, and
``*.gt.freiburg`` holds the left-handed poses. With F = diag(1, -1, 1, 1), a pixel back-projected with fy = +480
is F times the point in the renderer's camera, and the mirrored world F X is right-handed, so the pose of an
OpenCV camera is F P F: the signs of ty, qx and qz change. Without it depth images of two frames do not meet.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from semdb.errors import RecordingError
from semdb.files import fields_of, without_comment
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.recordings.assembly import Draft, finish, use_camera_file
from semdb.recordings.association import (
    ASSOCIATIONS,
    bad_lines_note,
    decimal_commas_note,
    has_times,
    parse_pose,
)
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, Recording
from semdb.recordings.cameras import ICL_NUIM, TUM_DEPTH_SCALE
from semdb.recordings.lines import BadLine, read_lines
from semdb.recordings.options import ReadOptions
from semdb.recordings.poses import numbers_of, rigid_pose
from semdb.types import Camera, FloatArray

POSES = "*.gt.freiburg"
MATRICES = "*.gt.sim"  # the same poses as 3x4 matrices, three lines each, numbered from 1
NUMBER = re.compile(r"[0-9]{1,9}")
FRAME = re.compile(r"[0-9]{1,9}(\.0*)?")
FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def is_icl_nuim(path: Path) -> bool:
    """Whether a folder has ICL-NUIM's poses, or its associations without TUM's lists."""
    if not path.is_dir():
        return False
    if any(path.glob(POSES)) or any(path.glob(MATRICES)):
        return True
    return (path / ASSOCIATIONS).exists() and not (path / "rgb.txt").exists() and not has_times(path / ASSOCIATIONS)


def open_icl_nuim(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording with ``rgb/N.png``, ``depth/N.png``, ``associations.txt`` and one ``*.gt.freiburg``.

    Frames have no times (`timestamp_ns` None): the format numbers them. Frames without a pose (the data set has
    none for frame 0) are dropped. Without ``associations.txt`` the images are paired by number.
    Raises RecordingError.
    """
    options = options or ReadOptions()
    rows, dropped = _read_associations(path) if (path / ASSOCIATIONS).is_file() else _list_images(path)
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="icl_nuim",
        total_frames=len(rows) + len(dropped),
        entries=[],
        dropped=dropped,
        known_camera=ICL_NUIM,
        depth_scale=TUM_DEPTH_SCALE,
        assumed_scale="that of ICL-NUIM",
    )
    if not use_camera_file(draft, camera, options, path) and camera is None:
        draft.assumed.append("camera: that of ICL-NUIM, 481.2,480,319.5,239.5")
    if [row[0] for row in rows] != sorted(row[0] for row in rows):
        draft.notes.append(f"{ASSOCIATIONS}: frame numbers are not in ascending order; sorted")
    poses = _read_poses(path, draft.notes, options)
    if poses is not None:
        source = POSES if any(path.glob(POSES)) else f"{MATRICES}, numbered from 1,"
        draft.assumed.append(f"poses: {source} is left-handed with y up, as ICL-NUIM's, and is mirrored")
    used: dict[int, str] = {}
    for index, (number, depth_name, colour_name) in enumerate(sorted(rows, key=lambda row: row[0])):
        if number in used:
            draft.dropped.append(DroppedFrame(colour_name, f"same frame number as {used[number]}"))
            continue
        used[number] = colour_name
        if poses is not None and number not in poses:
            draft.dropped.append(DroppedFrame(colour_name, f"no pose for frame {number} in the ground truth"))
            continue
        pose = None if poses is None else poses[number]
        draft.entries.append(FrameEntry(index, colour_name, None, path / colour_name, path / depth_name, None, pose))
    return finish(draft, camera)


def pose_from_icl(pose: FloatArray) -> FloatArray:
    """World-from-camera of an OpenCV camera in the mirrored (right-handed, y down) world of a renderer's `pose`."""
    return np.asarray(FLIP_Y @ pose @ FLIP_Y)


def _read_associations(path: Path) -> tuple[list[tuple[int, str, str]], list[DroppedFrame]]:
    """Rows of (frame number, depth name, colour name), and the lines that cannot be used."""
    rows: list[tuple[int, str, str]] = []
    bad: list[BadLine] = []
    for line_number, line in read_lines(path / ASSOCIATIONS):
        parts = without_comment(line).replace(",", " ").split()
        if len(parts) == 4 and NUMBER.fullmatch(parts[0]) and NUMBER.fullmatch(parts[2]):
            # the colour image decides the number; the order of the two columns differs between copies
            colour_first = "rgb" in parts[1] and "depth" in parts[3]
            colour, depth = (1, 3) if colour_first else (3, 1)
            rows.append((int(parts[colour - 1]), parts[depth], parts[colour]))
        else:
            bad.append(BadLine(line_number, "needs 'N depth/N.png N rgb/N.png'"))
    if not rows:
        where = f", line {bad[0].line}: {bad[0].reason}" if bad else ": lists no image"
        raise RecordingError(f"{path / ASSOCIATIONS}{where}")
    return rows, [DroppedFrame(f"{ASSOCIATIONS} line {line.line}", line.reason) for line in bad]


def _list_images(path: Path) -> tuple[list[tuple[int, str, str]], list[DroppedFrame]]:
    colour = sorted((int(file.stem), file.name) for file in (path / "rgb").glob("*.png") if NUMBER.fullmatch(file.stem))
    if not colour:
        raise RecordingError(f"{path}: neither {ASSOCIATIONS} nor images rgb/N.png; ICL-NUIM's PNG layout has both")
    return [(number, f"depth/{name}", f"rgb/{name}") for number, name in colour], []


def _read_poses(path: Path, notes: list[str], options: ReadOptions) -> dict[int, FloatArray] | None:
    files = sorted(path.glob(POSES))
    if not files and any(path.glob(MATRICES)):
        return _read_matrices(path, options)
    if not files:
        notes.append(f"no {POSES}: the frames have no pose")
        return None
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise RecordingError(f"{path}: several ground truths ({names}); keep the one of this recording")
    poses: dict[int, FloatArray] = {}
    bad: list[BadLine] = []
    repeated, commas = 0, False
    for line_number, line in read_lines(files[0]):
        values, has_commas = fields_of(line)
        commas |= has_commas
        try:
            if not FRAME.fullmatch(values[0]):
                raise ValueError(f"{values[0][:40]!r} is no frame number")
            quat_wxyz, translation = parse_pose(values[1:], options.quaternion)
        except ValueError as error:
            bad.append(BadLine(line_number, str(error)))
            continue
        number = int(values[0].split(".")[0])
        repeated += number in poses
        pose = options.pose(pose_from(rotation_from_quat_wxyz(quat_wxyz), translation))
        poses.setdefault(number, pose_from_icl(pose))
    if not poses:
        where = f", line {bad[0].line}: {bad[0].reason}" if bad else ": has no pose"
        raise RecordingError(f"{files[0]}{where}; lines of 'N tx ty tz qx qy qz qw' are needed")
    if bad:
        notes.append(bad_lines_note(files[0].name, bad, "poses"))
    if commas:
        notes.append(decimal_commas_note(files[0].name))
    if repeated:
        notes.append(f"{files[0].name}: {repeated} repeated frame number(s); the first pose of each is kept")
    return poses


def _read_matrices(path: Path, options: ReadOptions) -> dict[int, FloatArray]:
    """Poses of the one ``*.gt.sim``: blocks of three lines of four numbers, from frame 1 on. Raises RecordingError."""
    files = sorted(path.glob(MATRICES))
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise RecordingError(f"{path}: several ground truths ({names}); keep the one of this recording")
    rows = []
    for number, line in read_lines(files[0]):
        try:
            rows.append(numbers_of(line))
            if len(rows[-1]) != 4:
                raise ValueError(f"has {len(rows[-1])} numbers instead of four")
        except ValueError as error:
            raise RecordingError(f"{files[0]}, line {number}: {error}") from error
    if not rows or len(rows) % 3:
        raise RecordingError(f"{files[0]}: has {len(rows)} lines; three lines of a 3x4 matrix are needed for each pose")
    poses = {}
    for number, start in enumerate(range(0, len(rows), 3), start=1):
        try:
            poses[number] = pose_from_icl(options.pose(rigid_pose(rows[start : start + 3])))
        except ValueError as error:
            raise RecordingError(f"{files[0]}: pose {number} {error}") from error
    return poses


LAYOUT = Layout(
    "icl_nuim",
    "ICL-NUIM (associations.txt, *.gt.freiburg or *.gt.sim)",
    is_icl_nuim,
    lambda path, camera, options: [open_icl_nuim(path, camera, options)],
    frozenset({"depth_scale", "poses_are", "axes", "scale", "quaternion"}),
)
