"""Step ``points``: 3D points that several keyframes agree on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import Connection

from semdb.database import point_rows, refinements
from semdb.database.records import KeyframePoints
from semdb.database.store import Store
from semdb.errors import CodecError
from semdb.localization.views import ClassNumbers, View, make_view
from semdb.refinement.points.options import FusionOptions

READ_CHUNK = 50


@dataclass(frozen=True, slots=True)
class PointStep:
    """3D points that several keyframes agree on."""

    options: FusionOptions = field(default_factory=FusionOptions)
    kind: str = refinements.POINTS
    summary: str = "points that several keyframes see"
    by_default: bool = True
    moves: bool = False

    @property
    def parameters(self) -> Mapping[str, Any]:
        return asdict(self.options)

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> list[KeyframePoints]:
        """Raises NotFoundError where a keyframe is deleted meanwhile."""
        from semdb.geometry.volumes import volume_of
        from semdb.refinement.points.refined import refine_points

        listed = [item.id for item in store.listed_keyframes(map_id)]
        numbers, volumes, counts = ClassNumbers(), {}, {}
        kinds: dict[int, tuple[str, int]] = {}  # of descriptors
        measured = False
        for start in range(0, len(listed), READ_CHUNK):
            for known in store.load_keyframes(listed[start : start + READ_CHUNK], bad=store.left_out):
                xy, described = known.keypoints.features.xy, known.keypoints.features.descriptors
                volumes[known.id] = volume_of(known.camera, known.world_from_camera, xy, known.keypoints.points)
                measured = measured or bool(np.isfinite(known.keypoints.points).any())
                counts[known.id], kinds[known.id] = len(xy), (_kind(described), described.shape[1])
            progress(min(start + READ_CHUNK, len(listed)), 2 * len(listed))
        ids = _comparable(listed, kinds, store)
        options = self.options if measured else self.options.without_depth(len(ids))

        def load(number: int) -> View:
            (known,) = store.load_keyframes([ids[number]])
            names = [thing.category for thing in known.objects]
            return make_view(known.camera, known.keypoints, names, numbers)

        def show(done: int, total: int) -> None:
            progress(total + done, 2 * total)

        results = []
        for number, found in refine_points([volumes[key] for key in ids], load, options, show):
            points = np.full((counts[ids[number]], 4), np.nan, np.float32)
            points[found.keypoints] = found.points
            results.append(KeyframePoints(ids[number], points, found.fused, found.triangulated))
        return results

    def write(self, connection: Connection, map_id: int, result: Sequence[KeyframePoints]) -> int:
        return point_rows.replace_points(connection, map_id, result)


def _kind(descriptors: npt.NDArray[np.generic]) -> str:
    """Those of bytes are of float, rounded."""
    return "float32" if descriptors.dtype == np.int8 else str(descriptors.dtype)


def _comparable(listed: Sequence[int], kinds: Mapping[int, tuple[str, int]], store: Store) -> list[int]:
    """Those keyframes whose descriptors are of the kind that most have; the others are said."""
    counts = Counter(kinds.values())
    if not counts:
        return []
    usual = max(counts, key=lambda kind: (counts[kind], kind))
    for key, kind in kinds.items():
        if kind != usual:
            where = f"descriptors.data of keyframe {key}"
            store.left_out(key, CodecError(f"{where}: {kind[0]} with {kind[1]} numbers, and others have {usual}"))
    return [key for key in listed if kinds.get(key) == usual]
