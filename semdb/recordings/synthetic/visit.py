"""A second visit: the same room, some of its objects moved."""

from __future__ import annotations

import numpy as np

from semdb.recordings.synthetic.room import Room, free_place
from semdb.recordings.synthetic.scene import Item, yaw_pose


def move_objects(room: Room, seed: int, room_seed: int) -> list[int]:
    """Moves about half of the chairs and of the small objects, in place; returns the labels of those that moved.

    Small objects stay on their surface; chairs are pushed and turned a little; walls and furniture stay.
    """
    rng = np.random.default_rng([room_seed, 2, seed])
    moved: list[int] = []
    for item in room.items:
        if item.category is None or rng.random() < 0.5:
            continue
        if item.category == "chair":
            dx, dy = rng.uniform(-0.14, 0.14, 2)
            item.pose = item.pose @ yaw_pose(
                float(dx), float(dy), 0, float(rng.uniform(0.15, 0.6) * rng.choice([-1, 1]))
            )
            moved.append(item.label)
        elif item.spot is not None and _move_on_spot(rng, item):
            moved.append(item.label)
    return moved


def take_away(room: Room, share: float, seed: int, room_seed: int) -> list[int]:
    """Takes about a `share` of the small objects out of the room; returns their labels."""
    rng = np.random.default_rng([room_seed, 4, seed])
    gone = [
        item
        for item in room.items
        if item.category is not None and item.category != "chair" and item.spot is not None and rng.random() < share
    ]
    for item in gone:
        item.prims.clear()
    return [item.label for item in gone]


def _move_on_spot(rng: np.random.Generator, item: Item) -> bool:
    spot = item.spot
    if spot is None:
        return False
    if item in spot.items:
        spot.items.remove(item)
        place = free_place(rng, spot, item.radius)
        spot.items.append(item)
        if place is None:
            return False
        item.at = place
        z = 0.0
    else:  # stands alone on the floor
        place = (float(rng.uniform(-0.15, 0.15)), float(rng.uniform(-0.02, 0.2)))
        z = 0.0
    item.pose = spot.pose @ yaw_pose(place[0], place[1], z, float(rng.uniform(-0.6, 0.6)))
    return True
