"""Keyframes of one map as the fine step wants them, the latest kept in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

from semdb.database.records import StoredKeyframe
from semdb.database.store import Store
from semdb.errors import NotFoundError
from semdb.localization.views import ClassNumbers, KeyframeView, make_keyframe_view
from semdb.types import FloatArray


class KeyframeCache:
    """Loads keyframes from the database and keeps the `capacity` last used (about 1 MiB each)."""

    def __init__(self, store: Store, map_id: int, capacity: int = 64) -> None:
        self.numbers = ClassNumbers()
        self._store = store
        self._map_id = map_id
        self._capacity = capacity
        self._views: OrderedDict[int, KeyframeView] = OrderedDict()
        self._names: dict[int, tuple[str, int]] = {}
        self._poses: tuple[list[int], FloatArray] | None = None

    def forget(self) -> None:
        """Drops everything: the map has changed."""
        self._views.clear()
        self._names.clear()
        self._poses = None

    def views(self, keyframe_ids: Sequence[int]) -> list[KeyframeView]:
        """Views in the order of `keyframe_ids`; a keyframe deleted meanwhile is left out."""
        self._load([i for i in keyframe_ids if i not in self._views])
        found = []
        for keyframe_id in keyframe_ids:
            view = self._views.get(keyframe_id)
            if view is not None:
                self._views.move_to_end(keyframe_id)
                found.append(view)
        while len(self._views) > self._capacity:
            self._views.popitem(last=False)
        return found

    def _load(self, missing: Sequence[int]) -> None:
        for stored in self._stored(missing):
            self._names[stored.id] = (stored.recording, stored.frame_index)
            self._views[stored.id] = make_keyframe_view(
                stored.id,
                stored.camera,
                stored.world_from_camera,
                stored.keypoints,
                [found.category for found in stored.objects],
                self.numbers,
            )

    def _stored(self, keyframe_ids: Sequence[int]) -> list[StoredKeyframe]:
        try:
            return self._store.load_keyframes(keyframe_ids) if keyframe_ids else []
        except NotFoundError:
            if len(keyframe_ids) == 1:
                return []  # deleted since the coarse step proposed it
            return [found for keyframe_id in keyframe_ids for found in self._stored([keyframe_id])]

    def name_of(self, keyframe_id: int) -> tuple[str, int]:
        """Recording and frame index of a keyframe that was loaded."""
        return self._names.get(keyframe_id, ("", -1))

    def poses(self) -> tuple[list[int], FloatArray]:
        """Ids and ``world_from_camera`` ``[n, 4, 4]`` of all keyframes of the map."""
        if self._poses is None:
            self._poses = self._store.poses(self._map_id)
        return self._poses
