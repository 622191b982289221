"""Every kind of recording that semdb knows, in the order in which they are tried."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

from semdb.errors import RecordingError, RecordingUnavailableError, UsageError
from semdb.recordings import (
    colmap_model,
    icl_nuim,
    icl_povray,
    kapture,
    nice_slam,
    polycam,
    record3d,
    redwood,
    ros_bag,
    rtabmap,
    scannet,
    seven_scenes,
    stray_scanner,
    tum,
)
from semdb.recordings.base import Layout, Recording
from semdb.recordings.depth_camera import take_depth_camera
from semdb.recordings.intrinsics import depth_scale_problem
from semdb.recordings.options import ReadOptions, option_of
from semdb.types import Camera

LAYOUTS: tuple[Layout, ...] = (
    icl_nuim.LAYOUT,
    icl_povray.LAYOUT,
    tum.LAYOUT,
    seven_scenes.LAYOUT,
    stray_scanner.LAYOUT,
    record3d.LAYOUT,
    polycam.LAYOUT,
    scannet.SENS,
    scannet.FOLDER,
    nice_slam.LAYOUT,
    redwood.LAYOUT,
    ros_bag.LAYOUT,
    rtabmap.LAYOUT,
    kapture.LAYOUT,
    colmap_model.LAYOUT,
)
CHILDREN_LOOKED_AT = 200
PARENTS_LOOKED_AT = 3
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
EVERYWHERE = frozenset({"up"})


def find_layout(path: Path) -> Layout | None:
    """The layout of a folder or file that is there; None where no reader knows it."""
    return next((layout for layout in LAYOUTS if layout.matches(path)), None)


def open_with(layout: Layout, path: Path, camera: Camera | None, options: ReadOptions) -> list[Recording]:
    """Opens `path`. Raises UsageError for an option that means nothing to this layout, RecordingError."""
    foreign = sorted(set(options.given()) - layout.takes - EVERYWHERE)
    if foreign:
        names = ", ".join(option_of(name) for name in foreign)
        fitting = [option_of(field.name) for field in fields(ReadOptions) if field.name in layout.takes | EVERYWHERE]
        raise UsageError(f"{path}: {names} means nothing to a recording of format {layout.name}; it takes {fitting}")
    if options.depth_scale is not None and (problem := depth_scale_problem(options.depth_scale)):
        raise UsageError(f"--depth-scale: {problem}")
    found = layout.open(path, camera, options)
    for recording in found:
        recording.reading, recording.takes = options, layout.takes
        set_upright(recording)
        if options.depth_camera is not None:
            take_depth_camera(recording, options.depth_camera)
    return found


def set_upright(recording: Recording) -> None:
    """Turns the world of a recording so that what its reading says is up becomes z. Raises UsageError."""
    poses = [entry.world_from_camera for entry in recording.entries if entry.world_from_camera is not None]
    turn = recording.world_turn = recording.reading.turn(poses)
    if turn is not None:
        recording.entries = tuple(
            entry
            if entry.world_from_camera is None
            else replace(entry, world_from_camera=turn @ entry.world_from_camera)
            for entry in recording.entries
        )


def not_a_recording(path: Path) -> RecordingError:
    """The error for what no reader knows, with what may have been meant."""
    known = f"known are: {'; '.join(layout.about for layout in LAYOUTS)}"
    around = next(
        (parent for parent in path.absolute().parents[:PARENTS_LOOKED_AT] if _looks_like_recording(parent)), None
    )
    if around is not None:
        return RecordingError(f"{path}: is no recording itself, but lies in one: {around}")
    if path.is_file():
        if path.suffix.lower() in IMAGES:
            return RecordingError(
                f"{path}: is an image and no recording; `semdb localize` and `semdb show` take images"
            )
        return RecordingError(f"{path}: is a file that no reader knows; {known}")
    children = sorted(path.iterdir())
    if not children:
        return RecordingUnavailableError(f"{path}: the folder is empty; {known}")  # or nothing is mounted there
    inside = [child.name for child in children[:CHILDREN_LOOKED_AT] if _looks_like_recording(child)]
    if inside:
        return RecordingError(f"{path}: is no recording itself, but these in it are: {', '.join(inside[:10])}")
    if (path / "depth.txt").exists() or (path / "groundtruth.txt").exists():
        return RecordingError(f"{path / 'rgb.txt'}: the file is missing; the TUM layout needs it")
    return RecordingError(f"{path}: is no recording that semdb knows; {known}")


def _looks_like_recording(path: Path) -> bool:
    try:
        return find_layout(path) is not None
    except OSError:
        return False
