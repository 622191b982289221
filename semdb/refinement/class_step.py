"""Step ``classes``: which classes the detector takes for each other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import Connection

from semdb.database import refinements
from semdb.database.records import ClassConfusion, MapObject
from semdb.database.store import Store
from semdb.geometry import transform_points
from semdb.refinement.confusion import ConfusionOptions, PlacedObjects, co_detections, confusions


@dataclass(frozen=True, slots=True)
class ClassStep:
    """Which classes the detector takes for each other."""

    options: ConfusionOptions = field(default_factory=ConfusionOptions)
    kind: str = refinements.CLASSES
    summary: str = "classes taken for each other"
    by_default: bool = True
    moves: bool = False

    @property
    def parameters(self) -> Mapping[str, Any]:
        return asdict(self.options)

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> list[ClassConfusion]:
        placed, names = placed_objects(store.iter_objects(map_id, progress, store.left_out))
        counts = co_detections(placed, len(names), self.options)
        return [
            ClassConfusion(names[found.category], names[found.other], found.pairs, found.weight)
            for found in confusions(counts, self.options)
        ]

    def write(self, connection: Connection, map_id: int, result: Sequence[ClassConfusion]) -> int:
        return refinements.replace_confusions(connection, map_id, result)


def placed_objects(objects: Iterable[MapObject]) -> tuple[PlacedObjects, list[str]]:
    """Stored objects as arrays, in the coordinates of the map, and the names of the classes."""
    found = list(objects)
    names = sorted({item.category for item in found})
    number = {name: n for n, name in enumerate(names)}
    centres = [transform_points(item.world_from_camera, np.array([item.centroid]))[0] for item in found]
    extents = np.array([item.extent for item in found], np.float64).reshape(-1, 3)
    placed = PlacedObjects(
        np.array([item.keyframe for item in found], np.int64),
        np.array([number[item.category] for item in found], np.int64),
        np.array(centres, np.float64).reshape(-1, 3),
        np.sqrt((extents * extents).sum(axis=1)) / 2,
    )
    return placed, names
