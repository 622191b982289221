"""Step ``points``: 3D points that several keyframes agree on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import Connection

from semdb.database import point_rows, refinements
from semdb.database.records import KeyframePoints
from semdb.database.store import Store
from semdb.localization.views import ClassNumbers, View, make_view
from semdb.refinement.points.options import FusionOptions

READ_CHUNK = 50


@dataclass(frozen=True, slots=True)
class PointStep:
    """3D points that several keyframes agree on."""

    options: FusionOptions = field(default_factory=FusionOptions)
    kind: str = refinements.POINTS
    summary: str = "points that several keyframes see"

    @property
    def parameters(self) -> Mapping[str, Any]:
        return asdict(self.options)

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> list[KeyframePoints]:
        """Raises NotFoundError where a keyframe is deleted meanwhile."""
        from semdb.refinement.points.overlap import volume_of
        from semdb.refinement.points.refined import refine_points

        ids = [listed.id for listed in store.listed_keyframes(map_id)]
        numbers, volumes, counts = ClassNumbers(), [], []
        for start in range(0, len(ids), READ_CHUNK):
            for known in store.load_keyframes(ids[start : start + READ_CHUNK], descriptors=False):
                keypoints = known.keypoints
                volumes.append(
                    volume_of(known.camera, known.world_from_camera, keypoints.features.xy, keypoints.points)
                )
                counts.append(len(keypoints))
            progress(len(volumes), 2 * len(ids))

        def load(number: int) -> View:
            (known,) = store.load_keyframes([ids[number]])
            names = [thing.category for thing in known.objects]
            return make_view(known.camera, known.keypoints, names, numbers)

        def show(done: int, total: int) -> None:
            progress(total + done, 2 * total)

        results = []
        for number, found in refine_points(volumes, load, self.options, show):
            points = np.full((counts[number], 4), np.nan, np.float32)
            points[found.keypoints] = found.points
            results.append(KeyframePoints(ids[number], points, found.fused, found.triangulated))
        return results

    def write(self, connection: Connection, map_id: int, result: Sequence[KeyframePoints]) -> int:
        return point_rows.replace_points(connection, map_id, result)
