"""Pictures of maps and of what was found in them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semdb.errors import CodecError, FrameError, NotFoundError, UsageError

if TYPE_CHECKING:
    from semdb.database.store import Store
    from semdb.door.changed import Changes, Crop, LandmarkChange
    from semdb.door.found import Found
    from semdb.types import FloatArray, ImageArray


def plot_found(store: Store, found: Found, folder: Path) -> list[Path]:
    """One picture for each map that has a hit: see `semdb.api.reading.Reading.plot_found`."""
    names = sorted({hit.map for hit in found.hits})
    ids = {hit.landmark_id for hit in found.hits}
    return [_written(folder, name, "landmarks", picture(store, name, ids)) for name in names]


def plot_changes(store: Store, found: Changes, folder: Path) -> list[Path]:
    """What changed from above, and the crops: see `semdb.api.reading.Reading.plot_changes`."""
    from semdb.pictures.changes import draw_crops

    ids = {key for c in found.changes for key in (c.landmark_id, c.other_landmark_id) if key is not None}
    moves = [
        (np.array(c.before.position), np.array(c.after.position))
        for c in found.changes
        if c.kind == "moved" and c.before.position is not None and c.after.position is not None
    ]
    title = f"{found.map}: from {found.before} to {found.after}"
    written = [_written(folder, found.map, "changes", picture(store, found.map, ids, moves, title))]
    rows = [(_caption(change), *_crops(store, change)) for change in found.changes]
    if rows:
        written.append(_written(folder, found.map, "crops", draw_crops(rows, (found.before, found.after))))
    return written


def _caption(change: LandmarkChange) -> str:
    other = "" if change.other_landmark_id is None else f" / {change.other_landmark_id}"
    away = "" if change.distance is None else f", {change.distance:.2f} m"
    return f"{change.kind}: {change.category} {change.landmark_id}{other}{away}"


def _crops(store: Store, change: LandmarkChange) -> tuple[ImageArray | None, ImageArray | None]:
    return _crop(store, change.before.crop), _crop(store, change.after.crop)


def _crop(store: Store, crop: Crop | None) -> ImageArray | None:
    """The box of a crop with as much again about it; None without, or where the image cannot be read."""
    from semdb.database.left_out import telling
    from semdb.database.reading import load_image
    from semdb.recordings.images import decode_color

    if crop is None:
        return None
    try:
        image = decode_color(load_image(store.engine, crop.keyframe_id).rgb, f"image of keyframe {crop.keyframe_id}")
    except (CodecError, FrameError, NotFoundError) as error:
        telling(store.say)(f"no crop of keyframe {crop.keyframe_id}: {error}")
        return None
    x1, y1, x2, y2 = crop.box
    margin = max(x2 - x1, y2 - y1, 16.0) / 2
    height, width = image.shape[:2]
    left, top = max(int(x1 - margin), 0), max(int(y1 - margin), 0)
    cut = image[top : min(int(y2 + margin), height), left : min(int(x2 + margin), width)]
    return cut if cut.size else None


def _written(folder: Path, map_name: str, what: str, image: ImageArray) -> Path:
    from semdb.recordings.images import encode_color

    path = folder / f"{re.sub('[^A-Za-z0-9._-]+', '_', map_name)}-{what}.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_color(image))
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def picture(
    store: Store,
    map_name: str,
    found: set[int],
    moves: Sequence[tuple[FloatArray, FloatArray]] = (),
    title: str | None = None,
) -> ImageArray:
    """A map from above with its landmarks, RGB ``[H, W, 3]``; `moves` are drawn as arrows, positions in the map."""
    from semdb.database.landmark_reading import load_landmarks
    from semdb.database.landmark_rows import load_gravity
    from semdb.landmarks.boxes import footprint, turned_box, upright_axes
    from semdb.pictures.landmarks import Footprint, draw_landmarks

    info = store.find_map(map_name)
    gravity = load_gravity(store.engine, info.id)
    axes = upright_axes(np.array((0.0, 0.0, 1.0) if gravity is None else gravity.up))
    shown = []
    for thing in load_landmarks(store.engine, info.id, store.say)[0]:
        if thing.state == "gone" and thing.id not in found:
            continue
        box = turned_box(np.array(thing.position), np.array(thing.size), thing.yaw, axes[:, 2])
        height = float(np.array(thing.position) @ axes[:, 2]) + thing.size[2] / 2
        sure = thing.state == "confirmed"
        shown.append(Footprint(thing.id, thing.category, footprint(box, axes), height, sure))
    _, poses = store.poses(info.id, bad=store.left_out)
    title = title or f"{map_name}: {len(shown)} landmarks from above"
    arrows = [(one @ axes[:, :2], other @ axes[:, :2]) for one, other in moves]
    return draw_landmarks(shown, poses[:, :3, 3] @ axes[:, :2], title, found, arrows)
