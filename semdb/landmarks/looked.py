"""What keyframes were found to see of each other's sightings, remembered for each pair of keyframes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from semdb.geometry import invert_pose
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.memo import Arrays, Memo, name_of
from semdb.landmarks.options import SeeOptions
from semdb.types import BoolArray, FloatArray, Int64Array

LOOK = "look"  # kind of what is remembered
WIDER = 1.01  # than the cone of `kernels.look_up`: what lies outside of it is outside of that one as well
Part = tuple[np.ndarray, ...]  # sightings, keyframe, seen, and of overlaps: row, label, points (see `visibility`)


class Looked:
    """Looks sightings up in keyframes, those that were looked up before left out.

    A keyframe remembers what it sees of every other one, by what that one is made of and where it is: if that changes,
    it is another one.
    """

    def __init__(
        self,
        lifted: Sequence[LiftedKeyframe],
        keyframe: Int64Array,
        spheres: tuple[FloatArray, FloatArray],
        see: SeeOptions,
        memo: Memo,
    ) -> None:
        """`keyframe` ``[n]`` of each sighting, ascending, and the sphere about its points: centres, radii."""
        self._lifted, self._keyframe, self._see, self._memo = lifted, keyframe, see, memo
        self._centre, self._radius = spheres
        names = [name_of(frame.name, frame.world_from_camera) for frame in lifted]
        self._names = names
        self._source = np.array([int(name[:16], 16) for name in names], np.uint64)  # of each keyframe
        order = np.argsort(self._source, kind="stable")
        self._sorted, self._order = self._source[order], order
        self._first = np.searchsorted(keyframe, np.arange(len(lifted)))

    def look_in(self, number: int, compute: Callable[[Int64Array], Part]) -> Part:
        """What keyframe `number` sees of all sightings; `compute` looks some up, whose rows are given."""
        name = name_of(self._names[number], self._see)
        known = self._memo.get(LOOK, name)
        if known is None:
            known = _nothing()
        new = ~np.isin(self._source, known["sources"])
        chosen = np.flatnonzero(new[self._keyframe])
        chosen = chosen[self._in_cone(number, chosen)]
        kept = self._kept(number, known)
        if not new.any() and len(known["sources"]) == len(self._source):
            return kept
        part = _joined(kept, compute(chosen)) if len(chosen) else kept
        self._memo.put(LOOK, name, self._arrays(part))
        return part

    def _kept(self, number: int, known: Arrays) -> Part:
        """What is known of keyframes that are still there."""
        place = np.minimum(np.searchsorted(self._sorted, known["source"]), max(len(self._sorted) - 1, 0))
        there = self._sorted[place] == known["source"] if len(self._sorted) else np.zeros(len(place), np.bool_)
        keyframe = self._order[place[there]]
        rows = self._first[keyframe] + known["rank"][there]
        row_of = np.full(len(there), -1, np.int64)
        row_of[there] = np.arange(len(rows))
        pair = row_of[known["pair"]]
        kept = pair >= 0
        seen, label, both = known["seen"][there], known["label"][kept].astype(np.int64), known["overlap"][kept]
        return rows, np.full(len(rows), number, np.int64), seen, pair[kept], label, both

    def _arrays(self, part: Part) -> Arrays:
        rows, _, seen, pair, label, both = part
        keyframe = self._keyframe[rows]
        return {
            "sources": self._source,
            "source": self._source[keyframe],
            "rank": (rows - self._first[keyframe]).astype(np.int32),
            "seen": seen,
            "pair": pair.astype(np.int32),
            "label": label.astype(np.int32),
            "overlap": both,
        }

    def _in_cone(self, number: int, chosen: Int64Array) -> BoolArray:
        """Which of these sightings a keyframe may have in view; its depth is not asked."""
        frame, camera = self._lifted[number], self._lifted[number].camera
        pose = invert_pose(frame.world_from_camera)
        x, y, z = (self._centre[chosen] @ pose[:3, :3].T + pose[:3, 3]).T
        radius = self._radius[chosen] * WIDER + 1e-6
        across = max(camera.cx, camera.width - camera.cx) / camera.fx
        corner = np.hypot(across, max(camera.cy, camera.height - camera.cy) / camera.fy)
        cosine = 1 / np.sqrt(1 + corner * corner)
        return np.asarray((z >= -radius) & (np.hypot(x, y) * cosine - z * corner * cosine <= radius))


def _nothing() -> Arrays:
    none = np.empty(0, np.int32)
    pairs = {"seen": np.empty((0, 5), np.int32), "overlap": np.empty((0, 2), np.int32)}
    sources = {"sources": np.empty(0, np.uint64), "source": np.empty(0, np.uint64)}
    return {**sources, "rank": none, "pair": none, "label": none, **pairs}


def _joined(one: Part, other: Part) -> Part:
    both = [np.concatenate(columns) for columns in zip(one, other, strict=True)]
    both[3] = np.concatenate([one[3], other[3] + len(one[0])])
    return tuple(both)
