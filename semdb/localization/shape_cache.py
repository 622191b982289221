"""What is made of images of keyframes when it is first asked for, the latest kept in memory: surfaces, edges."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from semdb.database.records import StoredKeyframe
from semdb.database.store import Store
from semdb.errors import CodecError, FrameError, NotFoundError
from semdb.localization.edges import PlacedEdges, SpaceEdges, space_edges
from semdb.localization.likeness import small_inverse_depth
from semdb.localization.predicted_view import PlacedView, SmallView, small_view
from semdb.localization.surface_alignment import PlacedSurfaces, place
from semdb.localization.surfaces import Surfaces, surfaces_of
from semdb.recordings.images import decode_color_grey
from semdb.recordings.registration import decode_registered_depth
from semdb.types import Float32Array, FloatArray, ImageArray

CAPACITY = 32  # keyframes; about 4 MiB each of surfaces, 0.4 of edges
DEPTHS = 128  # of 0.13 MiB each
VIEWS = 128  # keyframes; about 0.3 MiB each


class Placed(Protocol):
    """What a keyframe shows, in the world."""

    @property
    def world_from_camera(self) -> FloatArray: ...


Local = TypeVar("Local")
There = TypeVar("There", bound=Placed)


class ShapeCache(Generic[Local, There]):
    """What keyframes with depth show. Not safe for threads: its owner takes turns.

    `made` makes it of the keyframe, depth and grey image, `placed_at` moves it to the world.
    """

    def __init__(
        self,
        store: Store,
        made: Callable[[StoredKeyframe, Float32Array, ImageArray], Local | None],
        placed_at: Callable[[int, Local, FloatArray], There],
        capacity: int = CAPACITY,
    ) -> None:
        self._store = store
        self._make = made
        self._place = placed_at
        self._capacity = capacity
        self._known: OrderedDict[int, tuple[Local, There] | None] = OrderedDict()

    def forget(self, keyframe_ids: Collection[int] | None = None) -> None:
        """Drops these, or all."""
        for keyframe_id in list(self._known) if keyframe_ids is None else keyframe_ids:
            self._known.pop(keyframe_id, None)

    def placed(self, keyframe_id: int, world_from_camera: FloatArray) -> There | None:
        """That of a keyframe at its pose; None of one without depth, that was deleted meanwhile, or is damaged."""
        if keyframe_id not in self._known:
            local = self._made(keyframe_id)
            there = None if local is None else self._place(keyframe_id, local, world_from_camera)
            self._known[keyframe_id] = None if local is None or there is None else (local, there)
        found = self._known[keyframe_id]
        if found is not None and not np.array_equal(found[1].world_from_camera, world_from_camera):  # it was moved
            found = self._known[keyframe_id] = found[0], self._place(keyframe_id, found[0], world_from_camera)
        self._known.move_to_end(keyframe_id)
        while len(self._known) > self._capacity:
            self._known.popitem(last=False)
        return None if found is None else found[1]

    def _made(self, keyframe_id: int) -> Local | None:
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
            return self._make(stored, depth, grey) if grey.shape == depth.shape else None
        except NotFoundError:  # deleted a moment ago
            return None
        except (FrameError, CodecError) as error:
            self._store.left_out(keyframe_id, CodecError(str(error)))
            return None


def surface_cache(store: Store) -> ShapeCache[Surfaces, PlacedSurfaces]:
    """Of the surfaces that a query's depth is laid on."""
    return ShapeCache(store, lambda stored, depth, grey: surfaces_of(stored.camera, depth, grey), place)


def edge_cache(store: Store) -> ShapeCache[SpaceEdges, PlacedEdges]:
    """Of the edges that a query's are laid on."""
    return ShapeCache(store, lambda stored, depth, grey: space_edges(stored.camera, depth, grey), PlacedEdges.at)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedDepth:
    """One over the depth of a keyframe's small image ``[h, w]`` (1/m, NaN where there is none), and its pose."""

    inverse: Float32Array
    world_from_camera: FloatArray


def depth_cache(store: Store) -> ShapeCache[Float32Array, PlacedDepth]:
    """Of the depth by which a query is looked at."""
    return ShapeCache(
        store,
        lambda stored, depth, grey: small_inverse_depth(stored.camera, depth),
        lambda _, inverse, world_from_camera: PlacedDepth(inverse, world_from_camera),
        DEPTHS,
    )


def view_cache(store: Store) -> ShapeCache[SmallView, PlacedView]:
    """Of the small images from which it is predicted what a query shows."""
    return ShapeCache(
        store,
        lambda stored, depth, grey: small_view(stored.camera, grey, depth),
        lambda keyframe_id, view, pose: PlacedView(keyframe_id, pose, view),
        VIEWS,
    )
