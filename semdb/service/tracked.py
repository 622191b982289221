"""Frames of a session to poses, by the tracker of the library."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from semdb.api import Database
from semdb.door.tracked import Tracked
from semdb.errors import UsageError
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.recordings.arrays import as_camera
from semdb.recordings.images import decode_color, decode_depth, header_of
from semdb.recordings.intrinsics import depth_scale_problem
from semdb.service.cameras import Live
from semdb.service.instances import frame_with
from semdb.service.problems import Problem, scrubbed
from semdb.service.state import with_notes
from semdb.service.values import tracked_dict
from semdb.types import FloatArray, Frame

ANEW = "the camera is looked for anew: no frame of it came for too long, or those before came to another process"


@dataclass(frozen=True, slots=True)
class Common:
    """What the frames of a session have in common; it stands in the signed id of the session."""

    id: str
    who: str
    map: str
    camera: str | None = None
    like: str | None = None
    depth_scale: float | None = None
    categories: str | None = None


@dataclass(frozen=True, slots=True)
class FrameGiven:
    """One frame: its files, and what is said of it alone."""

    image: bytes
    depth: bytes | None = None
    instances: bytes | None = None
    categories: str | None = None
    camera: str | None = None
    depth_scale: float | None = None
    name: str | None = None
    time_s: float | None = None
    frame_index: int | None = None
    timestamp_ns: int | None = None
    odometry: FloatArray | None = None

    @property
    def taken_s(self) -> float | None:
        """The time of the frame in seconds, where it is said."""
        if self.time_s is not None or self.timestamp_ns is None:
            return self.time_s
        return self.timestamp_ns / 1e9

    def key(self) -> bytes | None:
        """The same for a frame that is sent once more; None where it brings no time."""
        if self.taken_s is None:
            return None
        return hashlib.blake2b(self.image, key=repr(self.taken_s).encode()).digest()


def open_tracker(database: Database, live: Live, common: Common) -> None:
    """Begins to track. Raises SemdbError, Problem 422."""
    if live.tracker is None:
        if common.like is not None and not database.has_recording(common.like, common.map):
            raise Problem(422, f"like: there is no recording {common.like!r} in the map")
        live.tracker = database.tracker(common.map, camera=common.camera, like=common.like)


def track(database: Database, live: Live, common: Common, given: FrameGiven) -> dict[str, Any]:
    """The answer for a frame, for a thread of a pool; for the frame of the last answer that one. Raises SemdbError."""
    with live.running:
        key = given.key()
        if live.last is not None and key is not None and live.last[0] == key:
            return live.last[1]
        anew = not live.opened and live.tracker is None
        open_tracker(database, live, common)
        answer, notes = with_notes(_asking(live, common, given))
        live.frames += 1
        notes = [ANEW, *notes] if anew else notes
        own = {"frame_index": given.frame_index, "timestamp_ns": given.timestamp_ns, "frames": live.frames}
        found = tracked_dict(answer, notes=[scrubbed(line) for line in notes]) | own
        live.last = key, found
        live.saw(common.map, found)
        return found


def _asking(live: Live, common: Common, given: FrameGiven) -> Callable[[], Tracked]:
    tracker = live.tracker
    assert tracker is not None

    def ask() -> Tracked:
        image, depth = _image_of(common, given)
        more: dict[str, Any] = {"time_s": given.taken_s, "odometry": given.odometry, "name": given.name}
        return tracker.update(image, depth=depth, **more)

    return ask


def _image_of(common: Common, given: FrameGiven) -> tuple[bytes | Frame, Any]:
    """The image and its depth as a tracker takes them: as they came, or decoded where the frame says more of itself."""
    scale = given.depth_scale if given.depth_scale is not None else common.depth_scale
    if scale is not None and (problem := depth_scale_problem(scale)) is not None:
        raise UsageError(problem)
    camera, name = given.camera or common.camera, given.name or "image"
    if given.instances is not None:
        categories = given.categories or common.categories
        if categories is None:
            raise Problem(422, "instances and categories go together")
        found = frame_with(
            given.image, given.depth, given.instances, categories, camera=camera, depth_scale=scale, name=name
        )
        return found, None
    depth: Any = given.depth
    if given.depth is not None and scale is not None:
        depth = decode_depth(given.depth, f"depth of {name}", scale, header_of(given.image, name).size)
    if given.camera is None:
        return given.image, depth
    pixels = decode_color(given.image, name)
    own = as_camera(given.camera, (pixels.shape[1], pixels.shape[0]))
    return Frame(0, name, None, pixels, None, own, None), depth


def pose_of(numbers: list[float]) -> FloatArray:
    """A pose ``[4, 4]`` of x, y, z, qw, qx, qy, qz, or of its 16 numbers row by row. Raises Problem 422."""
    wanted = Problem(422, "odometry: x,y,z,qw,qx,qy,qz is needed, or a matrix of 16 numbers, row by row")
    if len(numbers) not in (7, 16) or not all(map(math.isfinite, numbers)):
        raise wanted
    values = np.array(numbers, np.float64)
    if len(numbers) == 16:
        return values.reshape(4, 4)
    if abs(np.linalg.norm(values[3:]) - 1) > 1e-3:
        raise wanted
    return pose_from(rotation_from_quat_wxyz(values[3:] / np.linalg.norm(values[3:])), values[:3])


def numbers_of(text: str) -> list[float]:
    """Numbers that commas divide. Raises Problem 422."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise Problem(422, "odometry: numbers that commas divide are needed") from None
