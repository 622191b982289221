"""The trajectory of a recording on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from semdb.errors import RecordingError, UsageError
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features.surf_features import SurfFeatures
from semdb.perception.protocols import Encoder
from semdb.recordings.base import FrameEntry, Recording
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.result import Trajectory
from semdb.trajectory.run import find_trajectory
from semdb.types import Float32Array, FloatArray, ImageArray

ASSUMED_RATE_HZ = 30.0  # of recordings without times: frame indexes count frames of a camera

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTrajectory:
    """A trajectory with the frames of the recording that it is of; `timed` says whether these have times."""

    trajectory: Trajectory
    entries: tuple[FrameEntry, ...]
    timed: bool


def find_recorded(
    recording: Recording,
    *,
    every: int = 1,
    encoder: Encoder | None = None,
    options: TrajectoryOptions | None = None,
    progress: Progress | None = None,
) -> RecordedTrajectory:
    """The trajectory of every `every`-th usable frame of `recording`, whatever poses it has itself.

    Without an `encoder` places are told by GIST, which needs no model file. Raises UsageError for an `every` below 1,
    RecordingError for a recording without depth, or without a frame that can be placed.
    """
    if every < 1:
        raise UsageError(f"every must be at least 1, but is {every}")
    entries = recording.entries[::every]
    if not any(entry.depth_path is not None for entry in entries):
        raise RecordingError(
            f"{recording.whereabouts}: no frame has depth, and without depth no trajectory is found: images alone do "
            "not say how large a room is"
        )
    options = options or TrajectoryOptions()

    def read(position: int) -> tuple[ImageArray, Float32Array | None]:
        entry = entries[position]
        return recording.read_image(entry), recording.read_depth(entry)

    times_s, timed = times_of(entries)
    found = find_trajectory(
        read,
        [recording.camera_of(entry) for entry in entries],
        times_s,
        SurfFeatures(max_keypoints=options.max_keypoints),
        encoder or GistEncoder(),
        options,
        progress,
    )
    if not found.used:
        raise RecordingError(f"{recording.whereabouts}: no frame can be placed; the first: {found.frames[0].reason}")
    return RecordedTrajectory(found, entries, timed)


def times_of(entries: tuple[FrameEntry, ...]) -> tuple[FloatArray, bool]:
    """Seconds since the first frame ``[n]``, and whether the recording says them; else 30 frames a second.

    Times that do not go on from frame to frame say nothing of how the camera moved.
    """
    stamps = [entry.timestamp_ns for entry in entries]
    known = [stamp for stamp in stamps if stamp is not None]
    if len(known) == len(stamps) and all(before < after for before, after in pairwise(known)):
        return np.array([stamp - known[0] for stamp in known], np.float64) / 1e9, True
    indexes = np.array([entry.index for entry in entries], np.float64)
    return (indexes - indexes[:1]) / ASSUMED_RATE_HZ, False
