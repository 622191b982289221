"""What keyframes were found to see of each other's sightings, remembered for each pair of keyframes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from semdb.geometry import invert_pose
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.memo import Arrays, Memo, name_of
from semdb.landmarks.options import SeeOptions
from semdb.types import BoolArray, FloatArray, Int64Array

LOOK = "look"  # kind of what is remembered
WIDER = 1.01  # than the cone of `kernels.look_up`: what lies outside of it is outside of that one as well
Part = tuple[np.ndarray, ...]  # sightings, keyframe, seen, and of overlaps: row, label, points (see `visibility`)


class Reach:
    """Which sightings keyframes may have in view, and not behind all that they measured."""

    def __init__(
        self,
        lifted: Sequence[LiftedKeyframe],
        keyframe: Int64Array,
        spheres: tuple[FloatArray, FloatArray],
        see: SeeOptions,
    ) -> None:
        """`keyframe` ``[n]`` of each sighting, ascending, and the sphere about its points: centres, radii."""
        self._lifted, self._see = lifted, see
        self._centre, self._radius = spheres
        # one sphere about all sightings of a keyframe: what does not reach that one reaches none of them
        self._first = np.flatnonzero(np.diff(keyframe, prepend=-1))
        self._end = np.append(self._first, len(keyframe))[1:]
        self._all_centre, self._all_radius = np.empty((len(self._first), 3)), np.empty(len(self._first))
        for row, (start, end) in enumerate(zip(self._first.tolist(), self._end.tolist(), strict=True)):
            middle = self._centre[start:end].mean(axis=0)
            away = np.linalg.norm(self._centre[start:end] - middle, axis=1) + self._radius[start:end]
            self._all_centre[row], self._all_radius[row] = middle, away.max()

    def of(self, number: int) -> Int64Array:
        """Rows of the sightings that keyframe `number` may see, ascending."""
        near = np.flatnonzero(self._in_cone(number, self._all_centre, self._all_radius))
        if not len(near):
            return np.empty(0, np.int64)
        chosen = np.concatenate([np.arange(self._first[k], self._end[k]) for k in near.tolist()])
        return np.asarray(chosen[self._in_cone(number, self._centre[chosen], self._radius[chosen])], np.int64)

    def _in_cone(self, number: int, centre: FloatArray, radius: FloatArray) -> BoolArray:
        """Which of these spheres meet the cone about the image, as far as it may see."""
        frame, camera, see = self._lifted[number], self._lifted[number].camera, self._see
        pose = invert_pose(frame.world_from_camera)
        x, y, z = (centre @ pose[:3, :3].T + pose[:3, 3]).T
        radius = radius * WIDER + 1e-6
        across = max(camera.cx, camera.width - camera.cx) / camera.fx
        corner = np.hypot(across, max(camera.cy, camera.height - camera.cy) / camera.fy)
        cosine = 1 / np.sqrt(1 + corner * corner)
        # of a point farther than this nothing is known, but that something hides it
        seen = (frame.farthest + see.near_m) / (1 - see.near_share)
        farthest = max(seen, frame.farthest + see.silhouette_m)
        within = (z >= -radius) & (z - radius <= farthest)
        return np.asarray(within & (np.hypot(x, y) * cosine - z * corner * cosine <= radius))


class Looked:
    """Looks sightings up in keyframes, those that were looked up before left out.

    A keyframe remembers what it sees of every other one that may be in its reach, by what that one is made of and where
    it is: if that changes, it is another one.
    """

    def __init__(self, lifted: Sequence[LiftedKeyframe], keyframe: Int64Array, see: SeeOptions, memo: Memo) -> None:
        """`keyframe` ``[n]`` of each sighting, ascending."""
        self._keyframe, self._see, self._memo = keyframe, see, memo
        names = [name_of(frame.name, frame.world_from_camera) for frame in lifted]
        self._names = names
        self._source = np.array([int(name[:16], 16) for name in names], np.uint64)  # of each keyframe
        order = np.argsort(self._source, kind="stable")
        self._sorted, self._order = self._source[order], order
        self._first = np.searchsorted(keyframe, np.arange(len(lifted)))

    def look_in(self, number: int, within: Int64Array, compute: Callable[[Int64Array], Part]) -> Part:
        """What keyframe `number` sees of the sightings `within` its reach; `compute` looks some of them up."""
        name = name_of(self._names[number], self._see)
        known = self._memo.get(LOOK, name)
        if known is None:
            known = _nothing()
        source = self._source[self._keyframe[within]]
        chosen = within[~np.isin(source, known["sources"])]
        kept = self._kept(number, known)
        sources = np.unique(source)
        if not len(chosen) and len(known["sources"]) == len(sources):
            return kept
        part = _joined(kept, compute(chosen)) if len(chosen) else kept
        self._memo.put(LOOK, name, self._arrays(part, sources))
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

    def _arrays(self, part: Part, sources: npt.NDArray[np.uint64]) -> Arrays:
        rows, _, seen, pair, label, both = part
        keyframe = self._keyframe[rows]
        return {
            "sources": sources,
            "source": self._source[keyframe],
            "rank": (rows - self._first[keyframe]).astype(np.int32),
            "seen": seen,
            "pair": pair.astype(np.int32),
            "label": label.astype(np.int32),
            "overlap": both,
        }


def _nothing() -> Arrays:
    none = np.empty(0, np.int32)
    pairs = {"seen": np.empty((0, 5), np.int32), "overlap": np.empty((0, 2), np.int32)}
    sources = {"sources": np.empty(0, np.uint64), "source": np.empty(0, np.uint64)}
    return {**sources, "rank": none, "pair": none, "label": none, **pairs}


def _joined(one: Part, other: Part) -> Part:
    both = [np.concatenate(columns) for columns in zip(one, other, strict=True)]
    both[3] = np.concatenate([one[3], other[3] + len(one[0])])
    return tuple(both)
