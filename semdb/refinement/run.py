"""What needs more than one keyframe: each step reads rows of a map, computes, and replaces a table of its own.

A step is a function of what the map holds, and of nothing else: not of row ids, nor of the order of ingest, nor of the
server. So it can be run at any time and as often as one likes, beside ingest and deletion; what it wrote belongs to the
state of the map that it read, and is out of date when the map has another (`semdb.database.refinements`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np
from sqlalchemy import Connection
from sqlalchemy.exc import IntegrityError

from semdb.database import point_rows, refinements
from semdb.database.records import ClassConfusion, KeyframePoints, MapInfo, MapObject
from semdb.database.store import Store
from semdb.errors import DatabaseError, NotFoundError, UsageError
from semdb.geometry import transform_points
from semdb.localization.keyframe_cache import POINTS
from semdb.localization.views import ClassNumbers, View, make_view
from semdb.refinement.confusion import ConfusionOptions, PlacedObjects, co_detections, confusions
from semdb.refinement.points.options import FusionOptions

CLASSES = "classes"
READ_CHUNK = 50
ATTEMPTS = 3  # of a step while the map changes under it
Progress = Callable[[str, int, int], None]  # what, done, total


class Step(Protocol):
    """One thing that is computed of a map. `kind` names its row in `refinements`."""

    @property
    def kind(self) -> str: ...

    @property
    def summary(self) -> str:
        """For people, in a few words."""

    @property
    def parameters(self) -> Mapping[str, Any]:
        """All that changes the result, beside the map: other ones make it out of date."""

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> Any:
        """Reads the map and computes: what `write` takes."""

    def write(self, connection: Connection, map_id: int, result: Any) -> int:
        """Replaces the rows of the map within the transaction of `connection`. Returns how many there are now."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """What a step did. `computed` False: it was up to date; `current` False: the map changed meanwhile."""

    map_name: str
    kind: str
    summary: str
    rows: int
    computed: bool
    current: bool


@dataclass(frozen=True, slots=True)
class ClassStep:
    """Which classes the detector takes for each other."""

    options: ConfusionOptions = field(default_factory=ConfusionOptions)
    kind: str = CLASSES
    summary: str = "classes taken for each other"

    @property
    def parameters(self) -> Mapping[str, Any]:
        return asdict(self.options)

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> list[ClassConfusion]:
        placed, names = placed_objects(store.iter_objects(map_id, progress))
        counts = co_detections(placed, len(names), self.options)
        return [
            ClassConfusion(names[found.category], names[found.other], found.pairs, found.weight)
            for found in confusions(counts, self.options)
        ]

    def write(self, connection: Connection, map_id: int, result: Sequence[ClassConfusion]) -> int:
        return refinements.replace_confusions(connection, map_id, result)


@dataclass(frozen=True, slots=True)
class PointStep:
    """3D points that several keyframes agree on."""

    options: FusionOptions = field(default_factory=FusionOptions)
    kind: str = POINTS
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


STEPS: tuple[Step, ...] = (ClassStep(), PointStep())


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


def refine_map(
    store: Store,
    info: MapInfo,
    *,
    kinds: Sequence[str] = (),
    force: bool = False,
    progress: Progress | None = None,
) -> list[StepResult]:
    """Runs the steps that are out of date (with `force` all), of the named `kinds` or of all.

    Raises UsageError for a kind that is none, NotFoundError when the map is deleted meanwhile, DatabaseError when it
    never holds still.
    """
    results = []
    for step in steps_of(kinds):
        known = {item.kind: item for item in store.refinements(info.id)}.get(step.kind)
        if known is not None and known.current and known.parameters == dict(step.parameters) and not force:
            results.append(StepResult(info.name, step.kind, step.summary, known.rows, computed=False, current=True))
            continue
        rows, current = _run(store, info, step, progress)
        results.append(StepResult(info.name, step.kind, step.summary, rows, computed=True, current=current))
    return results


def steps_of(kinds: Sequence[str]) -> list[Step]:
    """The steps of these kinds, all without any. Raises UsageError for a kind that is none."""
    known = [step.kind for step in STEPS]
    for kind in kinds:
        if kind not in known:
            raise UsageError(f"--step {kind}: known are {', '.join(known)}")
    return [step for step in STEPS if not kinds or step.kind in kinds]


def _run(store: Store, info: MapInfo, step: Step, progress: Progress | None) -> tuple[int, bool]:
    """Computes and writes one step; again when the map changed meanwhile. Rows, and whether they are of its state."""

    def show(done: int, total: int) -> None:
        if progress is not None:
            progress(f"{info.name}: {step.summary}", done, total)

    failure: Exception | None = None
    for attempt in range(1, ATTEMPTS + 1):
        state = store.map_state(info.id)
        try:
            result = step.compute(store, info.id, show)
        except NotFoundError as error:  # a keyframe was deleted after the map was listed
            failure = error
            continue
        same = store.map_state(info.id) == state
        if not same and attempt < ATTEMPTS:
            continue
        try:
            rows = store.replace_refinement(info.id, step.kind, state, step.parameters, step.write, result)
        except IntegrityError as error:  # the result refers to a keyframe that was deleted after the map was read
            failure = error
            continue
        return rows, store.map_state(info.id) == state
    raise DatabaseError(
        f"the map {info.name!r} kept changing while it was refined ({step.summary}): run semdb refine when ingest and "
        "deletion are done"
    ) from failure
