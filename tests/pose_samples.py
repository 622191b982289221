"""Made-up estimated poses and links for tests of the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from semdb.database.pose_records import Link, LinkKind, LinkState, PlannedPoses
from semdb.database.store import Store
from semdb.types import FloatArray
from tests.database_samples import MODELS, description, plan, pose, record

FRAMES = (0, 3, 7, 12, 20)


def information(seed: int) -> FloatArray:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return np.asarray(root @ root.T + 6 * np.eye(6))


def link(first: int, second: int, kind: LinkKind = LinkKind.LOOP, state: LinkState = LinkState.ACCEPTED) -> Link:
    reason = "" if state is LinkState.ACCEPTED else "contradicts 41 of 42"
    return Link(first, second, kind, pose(first - second), information(first + second), 40, state, reason, "made up")


def planned_poses(frames: Sequence[int] = FRAMES) -> PlannedPoses:
    links = [link(a, b, LinkKind.ODOMETRY) for a, b in pairwise(frames)]
    links += [link(frames[0], frames[-1]), link(frames[1], frames[-1], state=LinkState.CONTRADICTED)]
    return PlannedPoses(
        upright=True,
        poses={frame: pose(100 + frame) for frame in frames},
        covariances={frame: information(frame) / 1e6 for frame in frames},
        links=tuple(links),
    )


def fill_estimated(
    store: Store, map_name: str = "estimated", name: str = "own", frames: Sequence[int] = FRAMES, *, leave: int = 0
) -> tuple[int, int, list[int]]:
    """A recording with estimated poses, but for the last `leave` keyframes. Ids of map, recording and keyframes."""
    poses = planned_poses(frames)
    map_id = store.ensure_map(map_name)
    planned = store.plan_recording(map_id, replace(plan(name, frames), poses=poses), MODELS)
    ids = [write(store, planned.recording_id, frame) for frame in frames[: len(frames) - leave]]
    store.finish_recording(planned.recording_id)
    return map_id, planned.recording_id, ids


def write(store: Store, recording_id: int, frame: int) -> int:
    """Stores a keyframe at its estimated pose."""
    made = replace(record(frame, description(300 + frame)), world_from_camera=pose(100 + frame))
    return store.write_keyframe(recording_id, made).keyframe_id
