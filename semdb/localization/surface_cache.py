"""Surfaces of keyframes, made of their images when they are first asked for, the latest kept in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection

import numpy as np

from semdb.database.store import Store
from semdb.errors import CodecError, FrameError, NotFoundError
from semdb.localization.surface_alignment import PlacedSurfaces, place
from semdb.localization.surfaces import Surfaces, surfaces_of
from semdb.recordings.images import decode_color_grey
from semdb.recordings.registration import decode_registered_depth
from semdb.types import FloatArray

CAPACITY = 32  # keyframes; about 4 MiB each


class SurfaceCache:
    """Not safe for threads: its owner takes turns."""

    def __init__(self, store: Store, capacity: int = CAPACITY) -> None:
        self._store = store
        self._capacity = capacity
        self._known: OrderedDict[int, PlacedSurfaces | None] = OrderedDict()

    def forget(self, keyframe_ids: Collection[int] | None = None) -> None:
        """Drops these, or all."""
        for keyframe_id in list(self._known) if keyframe_ids is None else keyframe_ids:
            self._known.pop(keyframe_id, None)

    def placed(self, keyframe_id: int, world_from_camera: FloatArray) -> PlacedSurfaces | None:
        """Those of a keyframe at its pose; None of one without depth, that was deleted meanwhile, or is damaged."""
        if keyframe_id not in self._known:
            surfaces = self._made(keyframe_id)
            self._known[keyframe_id] = None if surfaces is None else place(keyframe_id, surfaces, world_from_camera)
        found = self._known[keyframe_id]
        if found is not None and not np.array_equal(found.world_from_camera, world_from_camera):  # it was moved
            found = self._known[keyframe_id] = place(keyframe_id, found.surfaces, world_from_camera)
        self._known.move_to_end(keyframe_id)
        while len(self._known) > self._capacity:
            self._known.popitem(last=False)
        return found

    def _made(self, keyframe_id: int) -> Surfaces | None:
        where = f"of keyframe {keyframe_id}"
        try:
            [stored] = self._store.load_keyframes([keyframe_id], descriptors=False)
            files = self._store.load_image(keyframe_id)
            if files.depth is None or files.depth_scale is None:
                return None
            name = f"keyframe_images.depth {where}"
            registration, camera = files.depth_registration, stored.camera
            depth = decode_registered_depth(files.depth, name, files.depth_scale, registration, camera)
            grey = decode_color_grey(files.rgb, f"keyframe_images.rgb {where}")
            return surfaces_of(camera, depth, grey) if grey.shape == depth.shape else None
        except NotFoundError:  # deleted a moment ago
            return None
        except (FrameError, CodecError) as error:
            self._store.left_out(keyframe_id, CodecError(str(error)))
            return None
