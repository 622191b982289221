"""Replica as NICE-SLAM rendered it: ``results/frame000000.jpg``, ``results/depth000000.png`` and ``traj.txt``.

Poses are world-from-camera of an OpenCV camera, 16 numbers a line. The camera stands in ``cam_params.json`` of the
folder above; depth has 6553.5 units a metre.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from semdb.errors import RecordingError
from semdb.files import UnusableFileError, read_json
from semdb.recordings.assembly import Draft, finish, use_camera_file
from semdb.recordings.association import bad_lines_note
from semdb.recordings.base import Layout, Recording
from semdb.recordings.numbered import entries_of, numbered_files
from semdb.recordings.options import ReadOptions
from semdb.recordings.poses import read_matrix_lines
from semdb.types import Camera, FloatArray

REPLICA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5)
DEPTH_SCALE = 6553.5
PARAMETERS = "cam_params.json"


def is_nice_slam(path: Path) -> bool:
    """Whether a folder has frames in ``results`` and the trajectory beside it."""
    return (path / "traj.txt").is_file() and (path / "results").is_dir()


def open_nice_slam(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording with one line of ``traj.txt`` for each frame, in order. Raises RecordingError."""
    options = options or ReadOptions()
    files = numbered_files(path / "results")
    split: dict[str, dict[int, Path]] = {"frame": {}, "depth": {}}
    for kind, found in split.items():
        names = sorted((path / "results").glob(f"{kind}*"))
        found.update({number: file for file in names for number in _number(file, kind)})
    if not split["frame"]:
        raise RecordingError(f"{path / 'results'}: has no images frame000000.jpg ({len(files)} others)")
    lines, bad = read_matrix_lines(path / "traj.txt")
    poses: dict[int, FloatArray | str] = {
        number: line if isinstance(line, str) else options.pose(line) for number, line in enumerate(lines)
    }
    known, scale = _parameters(path)
    notes = []
    if bad:
        notes.append(bad_lines_note("traj.txt", bad, "poses"))
    if not split["depth"]:
        notes.append("no results/depth*.png: the frames have no depth")
    entries, dropped = entries_of(path, split["frame"], split["depth"] or None, poses)
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="nice_slam",
        total_frames=len(split["frame"]),
        entries=entries,
        dropped=dropped,
        notes=notes,
        known_camera=known,
        depth_scale=options.depth_scale or scale,
    )
    if known is None and not use_camera_file(draft, camera, options, path, path.resolve().parent):
        draft.known_camera = REPLICA
        draft.notes.append(
            f"no {PARAMETERS}: taken for a rendering of Replica, 1200x680, f 600, {DEPTH_SCALE:g} units a metre"
        )
    return finish(draft, camera)


def _number(file: Path, kind: str) -> list[int]:
    text = file.stem.removeprefix(kind)
    return [int(text)] if text.isdecimal() and file.suffix.lower() in (".jpg", ".png", ".jpeg") else []


def _parameters(path: Path) -> tuple[Camera | None, float]:
    """Camera and depth scale of the parameter file beside or above the folder; None and Replica's without."""
    for folder in (path, path.resolve().parent):
        file = folder / PARAMETERS
        if file.is_file():
            return _read_parameters(file)
    return None, DEPTH_SCALE


def _read_parameters(file: Path) -> tuple[Camera, float]:
    try:
        content: Any = read_json(file)["camera"]
        values = {key: float(content[key]) for key in ("w", "h", "fx", "fy", "cx", "cy", "scale")}
    except UnusableFileError as error:
        raise RecordingError(error.at(file)) from error
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"{file}: must be a JSON object with 'camera': w, h, fx, fy, cx, cy, scale ({error!r})"
        ) from error
    if (
        not all(math.isfinite(value) for value in values.values())
        or min(values[k] for k in ("w", "h", "fx", "fy", "scale")) <= 0
    ):
        raise RecordingError(f"{file}: has a number that makes no sense")
    camera = Camera(int(values["w"]), int(values["h"]), values["fx"], values["fy"], values["cx"], values["cy"])
    return camera, values["scale"]


LAYOUT = Layout(
    "nice_slam",
    "Replica as NICE-SLAM has it (results/frameXXXXXX.jpg, traj.txt)",
    is_nice_slam,
    lambda path, camera, options: [open_nice_slam(path, camera, options)],
    frozenset({"depth_scale", "poses_are", "axes", "scale"}),
)
