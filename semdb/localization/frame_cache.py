"""Frames beside the keyframes of a map (`semdb refine --frames`), as what a query is matched with."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

import numpy as np

from semdb.database.frame_views import FrameHead, FrameRow, load_frame_heads, load_frames
from semdb.database.store import Store
from semdb.errors import CodecError, FrameError
from semdb.geometry import pose_distances
from semdb.localization.views import ClassNumbers, KeyframeView, make_keyframe_view
from semdb.recordings.images import decode_color_grey
from semdb.types import FloatArray, ImageArray

CAPACITY = 64  # about 1 MiB each


class FrameCache:
    """Those of one map; each goes by a negative id of its own. Not safe for threads: its owner takes turns."""

    def __init__(self, store: Store, map_id: int, numbers: ClassNumbers) -> None:
        self._store = store
        self._map_id = map_id
        self._numbers = numbers
        self._heads: list[FrameHead] | None = None
        self._views: OrderedDict[int, tuple[KeyframeView, FloatArray]] = OrderedDict()

    def forget(self) -> None:
        """Reads all anew when it is asked for."""
        self._heads = None
        self._views.clear()

    def head(self, view_id: int) -> FrameHead:
        """What is known of the frame that goes by `view_id`."""
        return self._known()[-view_id - 1]

    def near(
        self, pose: FloatArray, limit: float, count: int, keyframes: Mapping[int, FloatArray]
    ) -> list[KeyframeView]:
        """The `count` nearest to `pose` less than `limit` away (`pose_distances`), nearest first.

        `keyframes` are the poses ``[4, 4]`` of keyframes in the world.
        """
        known = [(n, head) for n, head in enumerate(self._known()) if head.keyframe_id in keyframes]
        if not known:
            return []
        poses = np.stack([keyframes[head.keyframe_id] @ head.keyframe_from_camera for _, head in known])
        distance = pose_distances(pose, poses)
        order = [int(n) for n in np.argsort(distance, kind="stable") if distance[n] < limit][:count]
        self._load({-known[n][0] - 1: poses[n] for n in order})
        found = []
        for n in order:
            view = self._views.get(-known[n][0] - 1)
            if view is not None:
                self._views.move_to_end(-known[n][0] - 1)
                found.append(view[0])
        while len(self._views) > CAPACITY:
            self._views.popitem(last=False)
        return found

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
