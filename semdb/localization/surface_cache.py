"""Surfaces of keyframes, made of their images when they are first asked for, the latest kept in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection

from semdb.database.store import Store
from semdb.errors import CodecError, FrameError, NotFoundError
from semdb.localization.surfaces import Surfaces, surfaces_of
from semdb.recordings.images import decode_color_grey, decode_depth
from semdb.recordings.registration import depth_size, register_depth

CAPACITY = 32  # keyframes; about 3 MiB each


class SurfaceCache:
    """Not safe for threads: its owner takes turns."""

    def __init__(self, store: Store, capacity: int = CAPACITY) -> None:
        self._store = store
        self._capacity = capacity
        self._known: OrderedDict[int, Surfaces | None] = OrderedDict()

    def forget(self, keyframe_ids: Collection[int] | None = None) -> None:
        """Drops these, or all."""
        for keyframe_id in list(self._known) if keyframe_ids is None else keyframe_ids:
            self._known.pop(keyframe_id, None)

    def of(self, keyframe_id: int) -> Surfaces | None:
        """None of a keyframe without depth, that was deleted meanwhile, or is damaged."""
        if keyframe_id not in self._known:
            self._known[keyframe_id] = self._made(keyframe_id)
        self._known.move_to_end(keyframe_id)
        while len(self._known) > self._capacity:
            self._known.popitem(last=False)
        return self._known[keyframe_id]

    def _made(self, keyframe_id: int) -> Surfaces | None:
        where = f"of keyframe {keyframe_id}"
        try:
            [stored] = self._store.load_keyframes([keyframe_id], descriptors=False)
            files = self._store.load_image(keyframe_id)
            if files.depth is None or files.depth_scale is None:
                return None
            size = depth_size(stored.camera, files.depth_registration)
            depth = decode_depth(files.depth, f"keyframe_images.depth {where}", files.depth_scale, size)
            depth = register_depth(depth, files.depth_registration, stored.camera)
            grey = decode_color_grey(files.rgb, f"keyframe_images.rgb {where}")
            return surfaces_of(stored.camera, depth, grey) if grey.shape == depth.shape else None
        except NotFoundError:  # deleted a moment ago
            return None
        except (FrameError, CodecError) as error:
            self._store.left_out(keyframe_id, CodecError(str(error)))
            return None
