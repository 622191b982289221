"""Frames beside the keyframes of a map (`semdb refine --frames`), as what a query is matched with."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence

import numpy as np

from semdb.database.frame_views import FrameHead, FrameRow, load_frame_heads, load_frames
from semdb.database.store import Store
from semdb.errors import CodecError, FrameError
from semdb.geometry import POSE_UNIT_M, pose_distances
from semdb.localization.views import ClassNumbers, KeyframeView, make_keyframe_view
from semdb.recordings.images import decode_color_grey
from semdb.types import FloatArray, ImageArray, IntArray

CAPACITY = 64  # about 1 MiB each


class FrameCache:
    """Those of one map; each goes by a negative id of its own. Not safe for threads: its owner takes turns."""

    def __init__(self, store: Store, map_id: int, numbers: ClassNumbers) -> None:
        self._store = store
        self._map_id = map_id
        self._numbers = numbers
        self._heads: list[FrameHead] | None = None
        self._placed: tuple[FloatArray, IntArray, FloatArray] | None = None  # for these keyframes: heads, poses
        self._views: OrderedDict[int, tuple[KeyframeView, FloatArray]] = OrderedDict()

    def forget(self) -> None:
        """Reads all anew when it is asked for."""
        self._heads, self._placed = None, None
        self._views.clear()

    def __bool__(self) -> bool:
        """Whether the map has any."""
        return bool(self._known())

    def head(self, view_id: int) -> FrameHead:
        """What is known of the frame that goes by `view_id`."""
        return self._known()[-view_id - 1]

    def near(
        self, pose: FloatArray, limit: float, count: int, keyframe_ids: Sequence[int], keyframes: FloatArray
    ) -> list[KeyframeView]:
        """The `count` nearest to `pose` less than `limit` away (`pose_distances`), nearest first.

        `keyframe_ids`, ascending, and `keyframes` ``[n, 4, 4]`` are those of all keyframes and where they are.
        """
        if not self._known():
            return []
        if self._placed is None or self._placed[0] is not keyframes:
            self._placed = keyframes, *self._place(keyframe_ids, keyframes)
        _, rows, poses = self._placed
        # the distance is at least that of the positions alone: turns are worked out for few
        close = np.flatnonzero(((poses[:, :3, 3] - pose[:3, 3]) ** 2).sum(axis=1) < (limit * POSE_UNIT_M) ** 2)
        distance = pose_distances(pose, poses[close])
        nearest = [int(close[n]) for n in np.argsort(distance, kind="stable") if distance[n] < limit][:count]
        wanted = {-int(rows[n]) - 1: poses[n] for n in nearest}
        self._load(wanted)
        found = []
        for key in wanted:
            if key in self._views:
                self._views.move_to_end(key)
                found.append(self._views[key][0])
        while len(self._views) > CAPACITY:
            self._views.popitem(last=False)
        return found

    def _place(self, keyframe_ids: Sequence[int], keyframes: FloatArray) -> tuple[IntArray, FloatArray]:
        """Which heads ``[m]`` have a keyframe that is there, and their poses ``[m, 4, 4]`` in the world."""
        heads, ids = self._known(), np.asarray(keyframe_ids, np.int64)
        owners = np.array([head.keyframe_id for head in heads], np.int64)
        at = np.minimum(np.searchsorted(ids, owners), max(len(ids) - 1, 0))
        rows = np.flatnonzero(ids[at] == owners) if len(ids) else np.zeros(0, np.int64)
        relative = np.stack([heads[n].keyframe_from_camera for n in rows]) if len(rows) else np.zeros((0, 4, 4))
        return rows.astype(np.int32), keyframes[at[rows]] @ relative

    def _known(self) -> list[FrameHead]:
        if self._heads is None:
            self._heads = load_frame_heads(self._store.engine, self._map_id, self._store.left_out)
        return self._heads

    def _load(self, wanted: Mapping[int, FloatArray]) -> None:
        """Views of those ids, at their poses in the world, that are not there, or lie elsewhere now."""
        lacking = {
            key: pose
            for key, pose in wanted.items()
            if key not in self._views or not np.array_equal(self._views[key][1], pose)
        }
        ids = {(self.head(key).keyframe_id, self.head(key).frame_index): key for key in lacking}
        for row in load_frames(self._store.engine, [self.head(key) for key in lacking], self._store.left_out):
            key = ids[row.head.keyframe_id, row.head.frame_index]
            self._views[key] = self._view(key, row, lacking[key]), lacking[key]

    def _view(self, view_id: int, row: FrameRow, pose: FloatArray) -> KeyframeView:
        return make_keyframe_view(view_id, row.head.camera, pose, row.keypoints, (), self._numbers, self._grey(row))

    def _grey(self, row: FrameRow) -> ImageArray | None:
        where = f"frame_views.grey of keyframe {row.head.keyframe_id}, frame {row.head.frame_index}"
        try:
            grey = decode_color_grey(row.grey, where)
        except FrameError as error:
            self._store.left_out(row.head.keyframe_id, CodecError(str(error)))
            return None
        return grey if grey.shape == (row.head.camera.height, row.head.camera.width) else None
