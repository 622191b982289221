"""TUM RGB-D layout, and recordings of one's own or synthetic ones that follow it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from semdb.errors import RecordingError
from semdb.files import MissingFileError, UnusableFileError, read_json
from semdb.names import written
from semdb.recordings.assembly import Draft, finish, use_camera_file
from semdb.recordings.association import (
    ASSOCIATIONS,
    MAX_TIME_DIFFERENCE_NS,
    TimedFile,
    Trajectory,
    backwards,
    bad_lines_note,
    has_times,
    nearest_pairs,
    pose_at,
    read_associations,
    read_file_list,
    read_trajectory,
    turn_rate_at,
)
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, Recording
from semdb.recordings.cameras import TUM_DEPTH_SCALE, tum_camera
from semdb.recordings.focus import is_wanted
from semdb.recordings.options import REVERSED, ReadOptions
from semdb.shown import measure
from semdb.storable_names import name_problem
from semdb.types import Camera

_LABEL = re.compile(r"[0-9]{1,9}")
LIMIT_MS = MAX_TIME_DIFFERENCE_NS / 1e6


def is_tum(path: Path) -> bool:
    """Whether a folder has TUM's list of colour images, or one of pairs of images with times."""
    if not path.is_dir():
        return False
    return (path / "rgb.txt").exists() or ((path / ASSOCIATIONS).exists() and has_times(path / ASSOCIATIONS))


def open_tum(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording with ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``; with ``masks/`` it is a synthetic one.

    The camera is, in this order: the one given, ``camera.json``, the one that the folder's name stands for, ROS'
    default (noted). Depth is associated within 20 ms and poses are interpolated; frames without are dropped, but
    a recording without ``depth.txt`` or ``groundtruth.txt`` has all its frames without them (noted).
    Raises RecordingError.
    """
    options = options or ReadOptions()
    name = path.resolve().name
    listed = "rgb.txt" if (path / "rgb.txt").exists() else ASSOCIATIONS
    pairs: list[TimedFile] | None = None
    if listed == ASSOCIATIONS:
        files, pairs, bad = read_associations(path / listed)
    else:
        files, bad = read_file_list(path / listed)
    draft = Draft(
        path=path,
        name=name,
        format="tum",
        total_frames=len(files) + len(bad),
        entries=[],
        dropped=[DroppedFrame(f"{listed} line {line.line}", line.reason) for line in bad],
        depth_scale=TUM_DEPTH_SCALE,
        assumed_scale="that of TUM RGB-D",
    )
    colour = _sorted_by_time(files, listed, draft.notes)
    depth = _read_depth_list(path, pairs, draft.notes, options)
    trajectory = _read_poses(path, draft.notes, options, [file.time_ns for file in files])
    draft.categories = read_categories(path)
    if draft.categories is not None:
        draft.format = "synthetic"
    _set_camera(draft, path, name, camera, options)
    _associate(draft, listed, colour, depth, trajectory)
    return finish(draft, camera)


def read_categories(path: Path) -> dict[int, str] | None:
    """Class name of each mask label (``masks/classes.json``); None where there is no folder ``masks``."""
    if not (path / "masks").exists():
        return None
    file = path / "masks" / "classes.json"
    try:
        content = read_json(file)
    except MissingFileError as error:
        raise RecordingError(f'{file}: the file is missing; it names the labels: {{"1": "chair", ...}}') from error
    except UnusableFileError as error:
        raise RecordingError(error.at(file)) from error
    if not isinstance(content, dict):
        raise RecordingError(f'{file}: must be a JSON object {{"1": "chair", ...}}')
    categories = {}
    for key, value in content.items():
        if not _LABEL.fullmatch(key) or not 1 <= int(key) <= 65535 or not isinstance(value, str):
            raise RecordingError(f"{file}: key {key[:40]!r} must be a label from 1 to 65535 with a class name as text")
        if value != written(value):
            raise RecordingError(f"{file}: the class name of label {key} is no text: {value!r}")
        if (problem := name_problem(value)) is not None:
            raise RecordingError(f"{file}: the class name {value[:60]!r} of label {key} {problem}: change it there")
        categories[int(key)] = value
    return categories


def _sorted_by_time(files: list[TimedFile], list_name: str, notes: list[str]) -> list[TimedFile]:
    ordered = sorted(files, key=lambda file: file.time_ns)  # stable: of equal times the first line stays first
    if ordered != files:
        notes.append(f"{list_name}: times are not in ascending order; sorted")
    return ordered


def _read_depth_list(
    path: Path, pairs: list[TimedFile] | None, notes: list[str], options: ReadOptions
) -> list[TimedFile] | None:
    """Depth images in order of time, of `pairs` where the list of colour images names them too."""
    if pairs is None and not os.path.lexists(path / "depth.txt"):  # a link to nothing is named when it is read
        notes.append("no depth.txt: the frames have no depth")
        return None
    listed = "depth.txt" if pairs is None else ASSOCIATIONS
    files, bad = read_file_list(path / listed) if pairs is None else (pairs, [])
    if bad:
        notes.append(bad_lines_note(listed, bad, "times or names"))
    if options.depth_offset_ms:
        shift = round(options.depth_offset_ms * 1e6)
        files = [replace(file, time_ns=file.time_ns + shift) for file in files]
    ordered = _sorted_by_time(files, listed, notes)
    unique = [file for i, file in enumerate(ordered) if i == 0 or file.time_ns != ordered[i - 1].time_ns]
    if len(unique) < len(ordered):
        notes.append(f"{listed}: {len(ordered) - len(unique)} repeated time(s); the first image of each is kept")
    return unique


def _read_poses(path: Path, notes: list[str], options: ReadOptions, times_ns: Sequence[int]) -> Trajectory | None:
    if not os.path.lexists(path / "groundtruth.txt"):
        notes.append("no groundtruth.txt: the frames have no pose")
        return None
    trajectory, pose_notes = read_trajectory(path / "groundtruth.txt", options, times_ns)
    notes += pose_notes
    return backwards(trajectory, times_ns) if options.times == REVERSED else trajectory


def _set_camera(draft: Draft, path: Path, name: str, camera: Camera | None, options: ReadOptions) -> None:
    if use_camera_file(draft, camera, options, path):
        return
    draft.known_camera, note = tum_camera(name)
    if camera is None and note:
        draft.notes.append(note)
        draft.assumed.append(note)
    elif camera is None:
        draft.assumed.append(f"camera: that of the Kinect which the folder's name {name!r} stands for")


def _associate(
    draft: Draft,
    listed: str,
    colour: list[TimedFile],
    depth: list[TimedFile] | None,
    trajectory: Trajectory | None,
) -> None:
    """Fills `draft` with the frames that have all the recording has, and drops the others."""
    kept: list[tuple[int, TimedFile]] = []
    for index, file in enumerate(colour):
        if kept and kept[-1][1].time_ns == file.time_ns:
            draft.dropped.append(
                DroppedFrame(file.name, f"same time as {kept[-1][1].name} ({listed} line {file.line})")
            )
        else:
            kept.append((index, file))
    partner: list[int | None] = [None] * len(kept)
    gaps = np.zeros(len(kept), dtype=np.int64)
    if depth is not None:
        times = np.array([file.time_ns for _, file in kept], dtype=np.int64)
        partner, gaps = nearest_pairs(times, np.array([file.time_ns for file in depth], dtype=np.int64))
    for (index, file), match, gap in zip(kept, partner, gaps.tolist(), strict=True):
        if not is_wanted(file.name, len(draft.entries)):
            continue
        if depth is not None and match is None:
            reason = f"no depth image within {LIMIT_MS:g} ms (the nearest: {_milliseconds(gap)} ms)"
            draft.dropped.append(DroppedFrame(file.name, reason))
            continue
        pose, turn_rate = None, None
        if trajectory is not None:
            pose, pose_gap = pose_at(trajectory, file.time_ns)
            if pose is None:
                reason = f"no pose within {LIMIT_MS:g} ms (the nearest: {_milliseconds(pose_gap)} ms)"
                draft.dropped.append(DroppedFrame(file.name, reason))
                continue
            turn_rate = turn_rate_at(trajectory, file.time_ns)
        draft.entries.append(
            FrameEntry(
                index=index,
                name=file.name,
                timestamp_ns=file.time_ns,
                image_path=draft.path / file.name,
                depth_path=draft.path / depth[match].name if depth is not None and match is not None else None,
                masks_path=None if draft.categories is None else draft.path / "masks" / f"{Path(file.name).stem}.png",
                world_from_camera=pose,
                turn_rate=turn_rate,
            )
        )


def _milliseconds(gap_ns: int) -> str:
    return measure(gap_ns / 1e6, 1, unless=(0.0, LIMIT_MS))


LAYOUT = Layout(
    "tum",
    "TUM RGB-D (rgb.txt, depth.txt, groundtruth.txt)",
    is_tum,
    lambda path, camera, options: [open_tum(path, camera, options)],
    frozenset(
        {
            "depth_scale",
            "poses_are",
            "axes",
            "scale",
            "quaternion",
            "time_offset_ms",
            "depth_offset_ms",
            "times",
            "depth_camera",
        }
    ),
)
