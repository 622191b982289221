"""The picture of one localization, with what the database knows: keyframe image, masks, map from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from semdb.database.landmark_reading import load_landmarks
from semdb.database.landmark_rows import LANDMARKS, load_gravity
from semdb.database.left_out import telling
from semdb.database.store import Store
from semdb.errors import CodecError, FrameError
from semdb.geometry import pose_error, transform_points
from semdb.landmarks.boxes import turned_box
from semdb.landmarks.values import LandmarkState
from semdb.localization.query_image import QueryImage
from semdb.pictures.drawing import category_colours, combine_pictures, draw_localization, localization_facts
from semdb.pictures.top_view import MapObject, draw_top_view
from semdb.recordings import decode_color
from semdb.recordings.images import has_size
from semdb.types import Detection, ImageArray, Localization


def picture_path(directory: Path, name: str, taken: set[Path]) -> Path:
    """``DIR/<image name>.png`` for the image of that `name`. Names in `taken` are numbered on, and it is added."""
    stem = Path(name).stem
    path, number = directory / f"{stem}.png", 1
    while path in taken:
        number += 1
        path = directory / f"{stem}-{number}.png"
    taken.add(path)
    return path


def draw_picture(store: Store, query: QueryImage, seen: Sequence[Detection], found: Localization) -> ImageArray:
    """Query with what was `seen` in it and best keyframe side by side, over the map from above, RGB ``[H, W, 3]``."""
    error = None
    if found.world_from_camera is not None and query.world_from_camera is not None:
        error = pose_error(found.world_from_camera, query.world_from_camera)
    image, detections, label = _keyframe(store, found)
    matches = draw_localization(
        query.image,
        seen,
        image,
        detections,
        found.query_xy,
        found.keyframe_xy,
        title=Path(query.name).name,
        verdict=found.verdict,
        facts=localization_facts(found, error),
        keyframe_label=label,
    )
    classes = [thing.category for thing in (*seen, *detections)]
    return combine_pictures([matches, _top_view(store, query, found, classes)])


def _keyframe(store: Store, found: Localization) -> tuple[ImageArray | None, tuple[Detection, ...], str]:
    """Image, objects and label of the best keyframe."""
    if found.best_keyframe_id is None:
        return None, (), ""
    stored = store.load_keyframes([found.best_keyframe_id], descriptors=False)[0]
    label = f"best keyframe: {stored.recording}, frame {stored.frame_index}"
    try:
        masks = store.load_masks(stored.id)
        detections = tuple(
            Detection(thing.category, thing.score, thing.box, mask)
            for thing, mask in zip(stored.objects, masks, strict=True)
        )
    except CodecError as error:
        store.left_out(stored.id, error)
        detections = ()
    try:
        data = store.load_image(stored.id).rgb
        where = f"keyframe_images.rgb of keyframe {stored.id}"
        if not has_size(data, (stored.camera.width, stored.camera.height)):
            raise CodecError(f"{where}: not of {stored.camera.width}x{stored.camera.height} pixels, as the camera is")
        return decode_color(data, where), detections, label
    except (CodecError, FrameError) as error:
        store.left_out(stored.id, CodecError(str(error)))
        return None, (), label


def landmark_objects(store: Store, map_id: int) -> list[MapObject]:
    """The confirmed landmarks of a map with their footprints, the largest first; none where they are out of date."""
    if not any(item.kind == LANDMARKS and item.current for item in store.refinements(map_id)):
        return []
    gravity = load_gravity(store.engine, map_id)
    up = np.array((0.0, 0.0, 1.0) if gravity is None else gravity.up)
    shown = []
    for thing in load_landmarks(store.engine, map_id, telling(store.say))[0]:
        if thing.state == LandmarkState.CONFIRMED:
            box = turned_box(np.array(thing.position), np.array(thing.size), thing.yaw, up)
            shown.append(MapObject(thing.category, box.centre, thing.keyframes, box.corners[:4]))
    return sorted(shown, key=lambda item: -_area(item))


def _area(item: MapObject) -> float:
    if item.footprint is None:
        return 0.0
    one, other = item.footprint[1] - item.footprint[0], item.footprint[2] - item.footprint[1]
    return float(np.linalg.norm(np.cross(one, other)))


def _top_view(store: Store, query: QueryImage, found: Localization, classes: Sequence[str]) -> ImageArray:
    info = store.find_map(found.map_name)
    ids, poses = store.poses(info.id, bad=store.left_out)
    objects = landmark_objects(store, info.id) or [
        MapObject(thing.category, transform_points(thing.world_from_camera, thing.centroid))
        for thing in store.iter_objects(info.id, bad=store.left_out)
        if thing.score >= 0.7
    ]
    matched = {candidate.keyframe_id for candidate in found.candidates}
    return draw_top_view(
        poses,
        found.world_from_camera,
        covariance=found.covariance,
        verdict=found.verdict,
        colours=category_colours(classes),
        objects=objects,
        true_pose=query.world_from_camera,
        candidates=[position for position, keyframe_id in enumerate(ids) if keyframe_id in matched],
    )
