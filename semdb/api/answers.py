"""From what the rooms behind give to the values that programs get."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from semdb.database.records import KeyframeHead
from semdb.database.store import Store
from semdb.door.matched import MatchedPixels
from semdb.door.values import Answer, Keyframe, KeyframeContent, SeenObject, frozen
from semdb.types import Camera, ConsistentPose, Float32Array, ImageArray, Keypoints, Localization

if TYPE_CHECKING:
    from semdb.localization.images import ImageLocalization


def answer_of(found: ImageLocalization, store: Callable[[], Store]) -> Answer:
    """The answer for one image; `store` is asked for what its picture shows of the database."""
    query, localization = found.query, found.localization
    pose = localization.world_from_camera
    objects = tuple(
        SeenObject.of(
            thing.category,
            thing.score,
            thing.box,
            thing.mask,
            centroid=shape.centroid,
            extent=shape.extent,
            world_from_camera=pose,
        )
        for thing, shape in zip(found.description.detections, found.description.geometry, strict=True)
    )
    shown = replace(query, depth=None, instances=None)  # nothing large is kept but the image

    def draw() -> ImageArray:
        from semdb.pictures.localization import draw_picture

        return draw_picture(store(), shown, [thing.detection() for thing in objects], localization)

    return Answer(
        image=query.name,
        verdict=localization.verdict,
        map=localization.map_name,
        world_from_camera=None if pose is None else frozen(pose),
        covariance=None if localization.covariance is None else frozen(localization.covariance),
        confidence=localization.confidence,
        inliers=localization.inliers,
        stage=localization.stage,
        reason=localization.reason,
        objects=objects,
        candidates=localization.candidates,
        ranked_share=localization.ranked_share,
        keyframes_matched=localization.keyframes_matched,
        refinements=localization.refinements,
        others=tuple(ConsistentPose(frozen(other.world_from_camera), other.inliers) for other in localization.others),
        timing_ms=localization.timing_ms,
        frame_index=query.frame_index,
        timestamp_ns=query.timestamp_ns,
        matches=_matches(localization),
        draw=draw,
    )


def _matches(found: Localization) -> MatchedPixels | None:
    if found.best_keyframe_id is None or found.query_xy is None or found.keyframe_xy is None:
        return None
    one, other = (frozen(np.asarray(xy, np.float64)) for xy in (found.query_xy, found.keyframe_xy))
    return MatchedPixels(found.best_keyframe_id, one, other)


def keyframe_of(head: KeyframeHead, content: KeyframeContent) -> Keyframe:
    """The keyframe that reads from `content` what is large."""
    return Keyframe(
        id=head.id,
        map=head.map,
        recording=head.recording,
        frame_index=head.frame_index,
        timestamp_ns=head.timestamp_ns,
        camera=head.camera,
        world_from_camera=frozen(head.world_from_camera),
        content=content,
    )


class StoredContent:
    """Reads what keyframes hold from a store."""

    def __init__(self, store: Callable[[], Store]) -> None:
        self._store = store

    def image(self, keyframe_id: int) -> ImageArray:
        """RGB ``[H, W, 3]``. Raises NotFoundError, FrameError."""
        from semdb.recordings.images import decode_color

        return decode_color(self._store().load_image(keyframe_id).rgb, f"keyframe {keyframe_id}")

    def depth(self, keyframe_id: int, camera: Camera) -> Float32Array | None:
        """Metres ``[H, W]``, registered to the image of `camera`; None without. Raises NotFoundError, FrameError."""
        from semdb.recordings.registration import decode_registered_depth

        stored = self._store().load_image(keyframe_id)
        if stored.depth is None or stored.depth_scale is None:
            return None
        name = f"depth of keyframe {keyframe_id}"
        return decode_registered_depth(stored.depth, name, stored.depth_scale, stored.depth_registration, camera)

    def objects(self, keyframe_id: int) -> tuple[SeenObject, ...]:
        """What was seen, by ordinal. Raises NotFoundError, CodecError."""
        store = self._store()
        [stored] = store.load_keyframes([keyframe_id], descriptors=False)
        return tuple(
            SeenObject.of(
                thing.category,
                thing.score,
                thing.box,
                mask,
                centroid=thing.geometry.centroid,
                extent=thing.geometry.extent,
                world_from_camera=stored.world_from_camera,
                row_id=thing.id,
            )
            for thing, mask in zip(stored.objects, store.load_masks(keyframe_id), strict=True)
        )

    def keypoints(self, keyframe_id: int) -> tuple[Keypoints, tuple[str, ...]]:
        """Keypoints without descriptors, and the classes of the objects. Raises NotFoundError, CodecError."""
        [stored] = self._store().load_keyframes([keyframe_id], descriptors=False)
        return stored.keypoints, tuple(thing.category for thing in stored.objects)
