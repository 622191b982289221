"""Pictures of maps and of what was found in them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semdb.errors import UsageError

if TYPE_CHECKING:
    from semdb.database.store import Store
    from semdb.door.found import Found


def plot_found(store: Store, found: Found, folder: Path) -> list[Path]:
    """One picture for each map that has a hit: see `semdb.api.reading.Reading.plot_found`."""
    from semdb.recordings.images import encode_color

    names = sorted({hit.map for hit in found.hits})
    written = []
    for name in names:
        image = encode_color(picture(store, name, {hit.landmark_id for hit in found.hits}))
        path = folder / f"{re.sub('[^A-Za-z0-9._-]+', '_', name)}-landmarks.png"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(image)
        except OSError as error:
            raise UsageError(f"{path}: cannot be written ({error.strerror})") from None
        written.append(path)
    return written


def picture(store: Store, map_name: str, found: set[int]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """A map from above with its landmarks, RGB ``[H, W, 3]``."""
    from semdb.database.landmark_reading import load_landmarks
    from semdb.database.landmark_rows import load_gravity
    from semdb.landmarks.boxes import footprint, turned_box, upright_axes
    from semdb.pictures.landmarks import Footprint, draw_landmarks

    info = store.find_map(map_name)
    gravity = load_gravity(store.engine, info.id)
    axes = upright_axes(np.array((0.0, 0.0, 1.0) if gravity is None else gravity.up))
    shown = []
    for thing in load_landmarks(store.engine, info.id, store.say)[0]:
        if thing.state == "gone":
            continue
        box = turned_box(np.array(thing.position), np.array(thing.size), thing.yaw, axes[:, 2])
        height = float(np.array(thing.position) @ axes[:, 2]) + thing.size[2] / 2
        sure = thing.state == "confirmed"
        shown.append(Footprint(thing.id, thing.category, footprint(box, axes), height, sure))
    _, poses = store.poses(info.id, bad=store.left_out)
    title = f"{map_name}: {len(shown)} landmarks from above"
    return draw_landmarks(shown, poses[:, :3, 3] @ axes[:, :2], title, found)
