"""The picture of one localization, with what the database knows: keyframe image, masks, map from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from semdb.database.store import Store
from semdb.geometry import pose_error, transform_points
from semdb.localization.images import ImageLocalization
from semdb.pictures.drawing import category_colours, combine_pictures, draw_localization, localization_facts
from semdb.pictures.top_view import MapObject, draw_top_view
from semdb.recordings import decode_color
from semdb.types import Detection, ImageArray, Localization


def write_picture(directory: Path, store: Store, answer: ImageLocalization, taken: set[Path]) -> Path:
    """Writes ``DIR/<image name>.png`` and returns its path. Names in `taken` are numbered on, and it is added."""
    picture = draw_picture(store, answer)
    stem = answer.query.path.stem
    path, number = directory / f"{stem}.png", 1
    while path in taken:
        number += 1
        path = directory / f"{stem}-{number}.png"
    taken.add(path)
    encoded = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1]
    path.write_bytes(encoded.tobytes())
    return path


def draw_picture(store: Store, answer: ImageLocalization) -> ImageArray:
    """Query and best keyframe side by side over the map from above, RGB ``[H, W, 3]``."""
    found, query = answer.localization, answer.query
    error = None
    if found.world_from_camera is not None and query.world_from_camera is not None:
        error = pose_error(found.world_from_camera, query.world_from_camera)
    image, detections, label = _keyframe(store, found)
    matches = draw_localization(
        query.image,
        answer.description.detections,
        image,
        detections,
        found.query_xy,
        found.keyframe_xy,
        title=query.path.name,
        verdict=found.verdict,
        facts=localization_facts(found, error),
        keyframe_label=label,
    )
    classes = [thing.category for thing in (*answer.description.detections, *detections)]
    return combine_pictures([matches, _top_view(store, answer, classes)])


def _keyframe(store: Store, found: Localization) -> tuple[ImageArray | None, tuple[Detection, ...], str]:
    """Image, objects and label of the best keyframe."""
    if found.best_keyframe_id is None:
        return None, (), ""
    stored = store.load_keyframes([found.best_keyframe_id], descriptors=False)[0]
    masks = store.load_masks(stored.id)
    detections = tuple(
        Detection(thing.category, thing.score, thing.box, mask)
        for thing, mask in zip(stored.objects, masks, strict=True)
    )
    image = decode_color(store.load_image(stored.id).rgb, f"keyframe {stored.id}")
    return image, detections, f"best keyframe: {stored.recording}, frame {stored.frame_index}"


def _top_view(store: Store, answer: ImageLocalization, classes: Sequence[str]) -> ImageArray:
    found = answer.localization
    info = store.find_map(found.map_name)
    ids, poses = store.poses(info.id)
    objects = []
    for stored in store.load_keyframes(ids, descriptors=False):
        for thing in stored.objects:
            if np.isfinite(thing.geometry.centroid).all() and thing.score >= 0.7:
                centre = transform_points(stored.world_from_camera, thing.geometry.centroid)
                objects.append(MapObject(thing.category, centre))
    matched = {candidate.keyframe_id for candidate in found.candidates}
    return draw_top_view(
        poses,
        found.world_from_camera,
        covariance=found.covariance,
        verdict=found.verdict,
        colours=category_colours(classes),
        objects=objects,
        true_pose=answer.query.world_from_camera,
        candidates=[position for position, keyframe_id in enumerate(ids) if keyframe_id in matched],
    )
