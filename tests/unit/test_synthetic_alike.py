"""Rooms that are easily confused: equal workplaces, mirrored textures, the same furniture elsewhere."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.recordings.synthetic import SyntheticOptions
from semdb.recordings.synthetic.room import Room, build_room
from semdb.recordings.synthetic.scene import mirrored


@pytest.fixture(scope="module")
def room() -> Room:
    return build_room(1)


def test_equal_workplaces_are_the_same_things_in_other_places() -> None:
    office = build_room(3, desks=4)
    counts = Counter(category for category in office.classes().values())
    assert counts["chair"] >= 2
    assert set(counts.values()) <= {counts["chair"] * n for n in (1, 2, 3)}
    screens = [item for item in office.items if item.category == "tv"]
    for other in screens[1:]:
        assert other.prims is screens[0].prims
        assert np.linalg.norm(other.pose[:3, 3] - screens[0].pose[:3, 3]) > 1.0


def test_other_furniture_leaves_walls_door_and_windows(room: Room) -> None:
    other = build_room(1, furniture_seed=2)
    assert (room.size, len(room.windows)) == (other.size, len(other.windows))
    assert (
        room.items[0].prims[0].faces[0].texture.image.tobytes()
        == other.items[0].prims[0].faces[0].texture.image.tobytes()
    )
    assert Counter(room.classes().values()) != Counter(other.classes().values())


def test_mirrored_items_have_the_same_shape_and_other_textures(room: Room) -> None:
    items = room.items
    turned = mirrored(items)
    assert [i.label for i in turned] == [i.label for i in items]
    for item, other in zip(items, turned, strict=True):
        for prim, again in zip(item.prims, other.prims, strict=True):
            assert (again.half, again.kind) == (prim.half, prim.kind)
            np.testing.assert_array_equal(again.pose, prim.pose)
            np.testing.assert_array_equal(again.faces[0].texture.image[:, ::-1], prim.faces[0].texture.image)
    shared = {id(prim.faces[0].texture) for item in items for prim in item.prims}
    assert len({id(prim.faces[0].texture) for item in turned for prim in item.prims}) == len(shared)


def test_options_that_make_no_sense() -> None:
    with pytest.raises(UsageError, match="desks = 9"):
        SyntheticOptions(desks=9)
