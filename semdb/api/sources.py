"""What can be ingested: folders and URLs, recordings that are open, frames from memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from typing import Any

from semdb.database.ids import check_name
from semdb.errors import UsageError
from semdb.ingestion.estimation import AUTO, check_poses
from semdb.ingestion.run import IngestOptions, Progress, open_all
from semdb.recordings.arrays import CameraLike, as_camera, check_depth_scale
from semdb.recordings.base import Recording
from semdb.recordings.memory import check_frame, recording_of
from semdb.recordings.options import AS_THE_FORMAT_SAYS, ReadOptions
from semdb.settings import Settings
from semdb.types import Frame


def camera_text(camera: CameraLike) -> str:
    """A camera as ``--camera`` takes it: its numbers, without its size. Raises UsageError."""
    if isinstance(camera, str):
        return camera
    found = as_camera(camera)
    numbers = (found.fx, found.fy, found.cx, found.cy, *found.distortion)
    return ",".join(repr(float(number)) for number in numbers)


def ingest_options(
    map_name: str | None,
    name: str | None,
    keyframes: int | None,
    stride: int | None,
    camera: CameraLike | None,
    reading: ReadOptions | None,
    depth_scale: float | None = None,
    *,
    check: bool = True,
    poses: str = AUTO,
) -> IngestOptions:
    """The options of an ingest. Raises UsageError for a camera, scale or kind of poses that is none."""
    check_poses(poses)
    reading = reading or AS_THE_FORMAT_SAYS
    if depth_scale is not None:
        reading = replace(reading, depth_scale=check_depth_scale(depth_scale))
    text = None if camera is None else camera_text(camera)
    return IngestOptions(map_name, name, keyframes, stride, text, reading, check=check, poses=poses)


@contextmanager
def open_source(
    source: Any,
    settings: Settings,
    options: IngestOptions,
    progress: Progress | None,
    check: Callable[[IngestOptions, bool], None],
) -> Iterator[list[Recording]]:
    """The recordings of a `source`, while the context lasts. Raises UsageError for what is none, RecordingError.

    `check` is told whether the first of frames from memory has masks, before the others are asked for.
    """
    if isinstance(source, str | PathLike):
        source = [source]
    if isinstance(source, Recording):
        _refuse("a recording that is open", camera=options.camera, **options.reading.given())
        yield [source if options.name is None else replace(source, name=options.name)]
    elif isinstance(source, Sequence) and source and all(isinstance(path, str | PathLike) for path in source):
        yield open_all([str(path) for path in source], settings, options, progress)
    elif isinstance(source, Iterable):
        others = {key: value for key, value in options.reading.given().items() if key != "depth_scale"}
        _refuse("frames, which bring all of that", camera=options.camera, **others)
        if options.name is None:
            raise UsageError("frames from memory are a recording that needs a name: give name=")
        name = check_name("recording", options.name)
        frames = _frames(source, lambda first: check(options, first.instances is not None))
        with recording_of(
            frames, name, depth_scale=options.reading.depth_scale, progress=_told(name, progress)
        ) as recording:
            yield [recording]
    else:
        raise UsageError(f"a folder, several, or an iterable of frames can be ingested, not {type(source).__name__}")


def _frames(source: Iterable[Any], check: Callable[[Frame], None]) -> Iterator[Frame]:
    """The frames, the first of them checked before it is given."""
    for number, frame in enumerate(source):
        if number == 0:
            if not isinstance(frame, Frame):
                check_frame(frame)  # says what a frame is
            check(frame)
        yield frame


def _told(name: str, progress: Progress | None) -> Any:
    if progress is None:
        return None
    return lambda done, total: progress(f"reading frames of {name}", done, total)


def _refuse(what: str, **given: object) -> None:
    for name, value in given.items():
        if value is not None:
            raise UsageError(f"{name}= is not for {what}: leave it out")
