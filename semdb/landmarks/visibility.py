"""For each pair of a sighting and a keyframe: visible, occluded or seen through, and whose mask lies there."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose, transform_points
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.looked import Looked, Reach
from semdb.landmarks.memo import Memo
from semdb.landmarks.options import SeeOptions
from semdb.threads import cores, each
from semdb.types import Float32Array, FloatArray, Int64Array, IntArray

_AT_ONCE = 16  # keyframes, between two words of progress
IN_VIEW, VISIBLE, OCCLUDED, THROUGH, UNKNOWN = range(5)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """All sightings of a map that have a place, by keyframe and number in it. `n` of them."""

    keyframe: Int64Array  # [n]
    label: Int64Array  # [n] in the grid of its keyframe: number in the keyframe + 1
    points: Float32Array  # [n, k, 3] world, the first `count` of them
    count: IntArray  # [n]
    centre: FloatArray  # [n, 3] of the sphere about the points
    radius: FloatArray  # [n]
    low: FloatArray  # [n, 3] of the box along the axes of the map
    high: FloatArray  # [n, 3]

    def __len__(self) -> int:
        return len(self.keyframe)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Pairs of a sighting and a keyframe that has it in view, by sighting and keyframe; `p` pairs, `t` overlaps."""

    sighting: Int64Array  # [p]
    keyframe: Int64Array  # [p]
    seen: IntArray  # [p, 5] in view, visible, occluded, seen through, without depth
    overlap_pair: Int64Array  # [t] row of the pair
    overlap_label: Int64Array  # [t] label in the keyframe's grid, 0 the background
    overlap: IntArray  # [t, 2] visible points there, points not far behind it


def collect(lifted: Sequence[LiftedKeyframe]) -> Sightings:
    """The sightings that have a place."""
    keyframe, label, points = [], [], []
    for number, frame in enumerate(lifted):
        for k, found in enumerate(frame.points):
            if len(found):
                keyframe.append(number)
                label.append(k + 1)
                points.append(transform_points(frame.world_from_camera, found).astype(np.float32))
    n = len(points)
    packed = np.zeros((n, max((len(found) for found in points), default=0), 3), np.float32)
    low, high = np.zeros((n, 3)), np.zeros((n, 3))
    for row, found in enumerate(points):
        packed[row, : len(found)] = found
        low[row], high[row] = found.min(axis=0), found.max(axis=0)
    return Sightings(
        np.array(keyframe, np.int64),
        np.array(label, np.int64),
        packed,
        np.array([len(found) for found in points], np.int32),
        (low + high) / 2,
        np.linalg.norm(high - low, axis=1) / 2,
        low,
        high,
    )


def look(
    lifted: Sequence[LiftedKeyframe],
    sightings: Sightings,
    see: SeeOptions,
    progress: Callable[[int, int], None] | None = None,
    memo: Memo | None = None,
) -> Views:
    """Looks every sighting up in every keyframe that may have it in view, and not beyond all that it measured."""
    reach = Reach(lifted, sightings.keyframe, (sightings.centre, sightings.radius), see)
    known = None
    if memo is not None and all(frame.name for frame in lifted):
        known = Looked(lifted, sightings.keyframe, see, memo)

    def one(number: int) -> tuple[np.ndarray, ...]:
        def compute(chosen: Int64Array) -> tuple[np.ndarray, ...]:
            return _look_in(number, lifted[number], sightings, chosen, see)

        within = reach.of(number)
        return compute(within) if known is None else known.look_in(number, within, compute)

    parts: list[tuple[np.ndarray, ...]] = []
    for start in range(0, len(lifted), _AT_ONCE):
        numbers = range(start, min(start + _AT_ONCE, len(lifted)))
        parts += each(one, numbers, cores())
        if progress is not None:
            progress(len(parts), len(lifted))
    return _joined(parts)


def _look_in(
    number: int, frame: LiftedKeyframe, sightings: Sightings, chosen: Int64Array, see: SeeOptions
) -> tuple[np.ndarray, ...]:
    from semdb.landmarks.kernels import look_up

    camera = frame.camera
    labels = len(frame.points)
    seen = np.zeros((len(chosen), 5), np.int32)
    overlaps = np.zeros((len(chosen), labels + 1), np.int32)
    behind = np.zeros_like(overlaps)
    distortion = np.array((*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5], np.float64)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], np.float64)
    limits = np.array([see.near_m, see.near_share, see.through_m, see.through_share, see.silhouette_m])
    step = float(frame.step)
    look_up(
        *(sightings.points, sightings.count, sightings.centre, sightings.radius, chosen),
        *(invert_pose(frame.world_from_camera), lens, distortion, frame.grid_depth, frame.grid_owner, step, limits),
        *(labels, seen, overlaps, behind),
    )
    rows = np.flatnonzero(seen[:, IN_VIEW] > 0)
    both = np.stack([overlaps[rows], behind[rows]], axis=2)
    pair, label = np.nonzero(both.any(axis=2))
    return chosen[rows], np.full(len(rows), number, np.int64), seen[rows], pair, label, both[pair, label]


def _joined(parts: Sequence[tuple[np.ndarray, ...]]) -> Views:
    start, pairs = 0, []
    for part in parts:
        pairs.append(part[3] + start)
        start += len(part[0])

    def column(k: int, empty: np.ndarray) -> np.ndarray:
        return np.concatenate([part[k] for part in parts]) if parts else empty

    none = np.empty(0, np.int64)
    sighting, keyframe = column(0, none), column(1, none)
    pair = np.concatenate(pairs) if pairs else none
    order = np.lexsort((keyframe, sighting))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    label = column(4, none)
    moved = place[pair]
    by_pair = np.lexsort((label, moved))
    return Views(
        sighting[order],
        keyframe[order],
        column(2, np.empty((0, 5), np.int32))[order],
        moved[by_pair],
        label[by_pair],
        column(5, np.empty((0, 2), np.int32))[by_pair],
    )
