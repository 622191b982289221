"""Poses for recordings that bring none: estimated before the plan is made, and kept with it.

All frames that could be placed have theirs in the plan, so that a run that was cut off, a worker, and a later wish for
more keyframes take them from the database. Nothing is estimated twice, and no two processes can disagree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.database.pose_records import Link, LinkKind, LinkState, PlannedPoses, PoseSource
from semdb.database.pose_sources import load_planned_poses, recording_poses
from semdb.database.store import Store
from semdb.errors import RecordingError, UsageError
from semdb.recordings.base import DroppedFrame, FrameEntry, Recording
from semdb.recordings.dropped import group_dropped
from semdb.trajectory.carried import carried_edges
from semdb.trajectory.odometry import FrameState
from semdb.trajectory.recording import RecordedTrajectory, find_recorded
from semdb.trajectory.refining import DRIFT
from semdb.trajectory.sessions import chain_links, step_covariances
from semdb.types import FloatArray

AUTO, RECORDED, ESTIMATED = "auto", "recorded", "estimated"
POSES = (RECORDED, ESTIMATED, AUTO)
PROVENANCE = "semdb trajectory"
Progress = Callable[[str, int, int], None]
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """A recording with the poses that it is ingested with, and what was estimated where they are not its own."""

    recording: Recording
    found: RecordedTrajectory | None = None  # where they were estimated now
    stored: Mapping[int, FloatArray] | None = None  # where they are those of the plan

    def planned(self, entries: Sequence[FrameEntry]) -> PlannedPoses | None:
        """What a plan of the keyframes `entries` brings; None for recorded poses."""
        if self.found is None:
            return None if self.stored is None else _grown(self.stored, entries)
        trajectory, frames = self.found.trajectory, self.found.entries
        place = {entry.index: position for position, entry in enumerate(frames)}
        chosen = [place[entry.index] for entry in entries]
        used = {frames[frame.position].index: frame for frame in trajectory.used}
        links = []
        for edge in carried_edges(trajectory, chosen):
            links.append(
                Link(
                    entries[edge.first].index,
                    entries[edge.second].index,
                    LinkKind.ODOMETRY if edge.kind.value == LinkKind.ODOMETRY else LinkKind.LOOP,
                    edge.first_from_second,
                    edge.information,
                    edge.inliers,
                    LinkState(edge.state.value),
                    edge.reason,
                    PROVENANCE,
                )
            )
        return PlannedPoses(
            upright=trajectory.up is not None,
            poses={key: one.world_from_camera for key, one in used.items() if one.world_from_camera is not None},
            covariances={key: one.covariance for key, one in used.items() if one.covariance is not None},
            links=tuple(links),
        )


def _grown(stored: Mapping[int, FloatArray], entries: Sequence[FrameEntry]) -> PlannedPoses:
    """What a stored plan brings that may have more keyframes now: steps from each of `entries` to the next.

    What was seen between these is not known any more, so they are as sure as odometry is on its way.
    """
    known = sorted(entry.index for entry in entries if entry.index in stored)
    poses = np.array([stored[index] for index in known]).reshape(-1, 4, 4)
    steps = chain_links(poses, step_covariances(poses, DRIFT))
    links = [
        Link(known[n], known[n + 1], LinkKind.ODOMETRY, relative, information, 0, LinkState.ACCEPTED, "", PROVENANCE)
        for n, (relative, information) in enumerate(zip(steps.first_from_second, steps.information, strict=True))
    ]
    return PlannedPoses(upright=False, poses=stored, links=tuple(links))


def check_poses(poses: str) -> None:
    """Raises UsageError for what is none of recorded, estimated and auto."""
    if poses not in POSES:
        raise UsageError(f"--poses {poses}: known are {', '.join(POSES)}")


def posed(
    recording: Recording,
    store: Store,
    map_name: str,
    poses: str = AUTO,
    *,
    progress: Progress | None = None,
    say: Say | None = None,
) -> Posed:
    """`recording` with the poses to ingest it with: its own, those of the plan, or ones estimated now (said).

    Raises UsageError where the plan has others than are asked for, or the map holds another recording; RecordingError
    where there are none, and where none can be estimated.
    """
    check_poses(poses)
    stored = store.find_plan(map_name, recording.name)
    if stored is not None:
        source = recording_poses(store.engine, stored.recording_id).source
        if poses not in (AUTO, source.value):
            raise UsageError(
                f"the recording {recording.name!r} of the map {map_name!r} is stored already with {source} poses: "
                "leave out --poses to go on with these, or give another name (--name)"
            )
        if source is PoseSource.RECORDED:
            return Posed(recording)
        known = load_planned_poses(store.engine, stored.recording_id)
        return Posed(with_poses(recording, known), stored=known)
    brings = any(entry.world_from_camera is not None for entry in recording.entries)
    if poses == RECORDED or (poses == AUTO and brings):
        if not brings:
            raise RecordingError(
                f"{recording.whereabouts}: brings no poses; --poses estimated finds them from its images"
            )
        return Posed(recording)
    _refuse_others(store, map_name)
    (say or _nobody)(
        f"{recording.name}: {'its own poses are left out' if brings else 'it brings no poses'}: they are estimated "
        "from images and depth"
    )
    found = find_recorded(recording, progress=progress)
    for line in told(found):
        (say or _nobody)(f"{recording.name}: {line}")
    trajectory = found.trajectory
    known = {
        found.entries[frame.position].index: frame.world_from_camera
        for frame in trajectory.used
        if frame.world_from_camera is not None
    }
    return Posed(with_poses(recording, known), found)


def with_poses(recording: Recording, poses: Mapping[int, FloatArray]) -> Recording:
    """`recording` with estimated `poses` ``[4, 4]`` by frame index in place of its own; other frames have none."""
    entries = tuple(
        replace(entry, world_from_camera=poses.get(entry.index), turn_rate=None) for entry in recording.entries
    )
    return replace(recording, entries=entries, estimated=True, world_turn=None)


def told(found: RecordedTrajectory) -> list[str]:
    """What people should know of estimated poses."""
    trajectory = found.trajectory
    up = "and which way is up is not known"
    if trajectory.up is not None:
        up = f"z is up (to {trajectory.up.sigma_deg:.1f} degrees)"
    lines = [
        f"{len(trajectory.used)} of {len(trajectory.frames)} frames have an estimated pose, "
        f"{len(trajectory.closures())} loop closures count; the world has its origin at the first keyframe, {up}"
    ]
    without = [
        DroppedFrame(f"frame {found.entries[frame.position].index}", frame.reason)
        for frame in trajectory.frames
        if not frame.placed
    ]
    lines += [f"left out without a pose: {line}" for line in group_dropped(without)]
    laid = trajectory.count(FrameState.LAID)
    if laid:
        lines.append(f"{laid} frames, which keypoints did not carry, were tracked by surfaces")
    others = trajectory.pieces[1:]
    if others:
        frames = sum(piece.frames for piece in others)
        lines.append(
            f"{frames} frames in {len(others)} other pieces, which nothing joined, are left out: "
            + ", ".join(
                f"frames {found.entries[piece.first_position].index} to {found.entries[piece.last_position].index}"
                for piece in others[:5]
            )
        )
    if not found.timed:
        lines.append("it has no times that go on from frame to frame: 30 frames a second are assumed")
    return lines


def _refuse_others(store: Store, map_name: str) -> None:
    """Before anything is computed; the plan looks again. Raises UsageError."""
    for info in store.maps():
        if info.name == map_name and info.recordings:
            raise UsageError(
                f"the map {map_name!r} holds recordings already, and where one with estimated poses lies in its frame "
                "is not known: give --align to find out, or another map (--map)"
            )


def _nobody(_line: str) -> None:
    """Nobody listens."""
