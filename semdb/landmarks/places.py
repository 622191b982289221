"""Registration place by place: keyframes that are far from each other have nothing to agree on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.memo import Arrays, Forgetful, Memo, name_of, remembered
from semdb.landmarks.options import RegisterOptions
from semdb.landmarks.register import Registered, registered
from semdb.types import FloatArray, Int64Array

POSES = "poses"  # kind of what is remembered


def places_of(centres: FloatArray, apart: float) -> list[Int64Array]:
    """Rows of `centres` ``[n, 3]`` by place: chains of centres no farther than `apart` from the next; by first row."""
    count = len(centres)
    pairs = cKDTree(centres).query_pairs(apart, output_type="ndarray") if count else np.empty((0, 2), np.int64)
    joined = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    number, place = connected_components(joined, directed=False)
    order = np.argsort(place, kind="stable")
    found = np.split(order, np.searchsorted(place[order], np.arange(1, number))) if count else []
    return sorted((np.asarray(rows, np.int64) for rows in found), key=lambda rows: int(rows[0]))


def registered_by_place(
    lifted: Sequence[LiftedKeyframe],
    options: RegisterOptions | None = None,
    memo: Memo | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Registered:
    """As `registered`, each place for itself; one whose keyframes are those of before is remembered."""
    options, memo = options or RegisterOptions(), memo or Forgetful()
    poses = np.array([frame.world_from_camera for frame in lifted], np.float64).reshape(-1, 4, 4)
    apart = np.full(len(poses), np.nan)
    done = 0
    for rows in places_of(poses[:, :3, 3], options.farthest_m):
        mine = [lifted[row] for row in rows.tolist()]

        def compute(mine: Sequence[LiftedKeyframe] = mine) -> Arrays:
            found = registered(mine, options)
            return {"poses": found.poses, "apart": found.apart}

        named = all(frame.name for frame in mine)
        name = name_of(options, [(frame.name, frame.world_from_camera) for frame in mine]) if named else ""
        found = remembered(memo, POSES, name, compute) if named else compute()
        poses[rows], apart[rows] = found["poses"], found["apart"]
        done += len(rows)
        if progress is not None:
            progress(done, len(lifted))
    return Registered(poses, apart)


def agreed(
    lifted: Sequence[LiftedKeyframe], options: RegisterOptions, memo: Memo, unknown: float
) -> list[LiftedKeyframe]:
    """Keyframes where their depths agree; `unknown` is how far apart those are that have no neighbour."""
    found = registered_by_place(lifted, options, memo)
    moved = []
    for frame, pose, off in zip(lifted, found.poses, found.apart, strict=True):
        apart = unknown if np.isnan(off) else float(off)
        key = name_of(frame.name, pose, apart) if frame.name else ""
        moved.append(replace(frame, world_from_camera=pose, apart=apart, key=key))
    return moved
