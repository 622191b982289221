"""Step ``landmarks``: the things that the objects of a map are sightings of, and how they stand to each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import Connection

from semdb.database import landmark_rows
from semdb.database.codecs import decode_mask
from semdb.database.landmark_parts import LandmarkParts, LostPartError
from semdb.database.landmark_records import (
    CompletedClass,
    GravityRow,
    KeyframeDepth,
    LandmarkRelation,
    LandmarkRow,
    LandmarkSet,
    LandmarkSighting,
    LandmarkView,
    LandmarkVisit,
)
from semdb.database.left_out import telling
from semdb.database.pose_records import World
from semdb.database.pose_sources import recording_poses
from semdb.database.records import KeyframeHead
from semdb.database.store import Store
from semdb.errors import CodecError, FrameError
from semdb.landmarks.options import LandmarkOptions
from semdb.refinement.class_step import placed_objects
from semdb.refinement.confusion import MILLION, ConfusionOptions, co_detections, confusions
from semdb.types import Float32Array, FloatArray, Int64Array

if TYPE_CHECKING:
    from semdb.landmarks.lift import Grids, LiftedKeyframe
    from semdb.landmarks.visits import Visit

CLOCK_NS = 10**17  # times from here on (1973) are of the clock on the wall; smaller ones begin with their recording
LEAST_EVIDENCE = 0.0005
REVISION = 8  # of the computation: another one makes what is stored out of date


@dataclass(frozen=True, slots=True)
class LandmarkStep:
    """Things, and how they stand to each other."""

    options: LandmarkOptions = field(default_factory=LandmarkOptions)
    kind: str = landmark_rows.LANDMARKS
    summary: str = "landmarks"
    by_default: bool = True
    moves: bool = False

    @property
    def parameters(self) -> Mapping[str, Any]:
        return {"revision": REVISION, **asdict(self.options)}

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> LandmarkSet:
        try:
            return self._compute(store, map_id, progress, LandmarkParts(store.engine, map_id, REVISION))
        except LostPartError:
            return self._compute(store, map_id, progress, LandmarkParts(store.engine, map_id, REVISION, empty=True))

    def _compute(
        self, store: Store, map_id: int, progress: Callable[[int, int], None], parts: LandmarkParts
    ) -> LandmarkSet:
        from semdb.landmarks.build import SeenKeyframe, find_landmarks
        from semdb.landmarks.lift import SeenObject, lift_keyframe
        from semdb.landmarks.memo import name_of
        from semdb.landmarks.remembered_lift import GRID, LIFT, lift_arrays, lifted_from
        from semdb.landmarks.sizes import sizes_of
        from semdb.threads import cores, each

        gravity = landmark_rows.load_gravity(store.engine, map_id)
        told = gravity is not None and gravity.given
        up = np.array(gravity.up) if gravity is not None and told else _up_of_poses(store, map_id)
        placed, names = placed_objects(store.iter_objects(map_id, None, store.left_out))
        confusion = _confusion(placed, names)
        total = 2 * max(store.keyframe_count(map_id), 1)
        numbers = {name: k for k, name in enumerate(names)}
        rows: list[KeyframeDepth] = []
        seen: list[SeenKeyframe] = []

        def name(head: KeyframeHead | KeyframeDepth) -> str:
            made = (self.options.lift, self.options.see)
            return name_of(*made, head.id, head.recording, head.frame_index, head.timestamp_ns, head.camera)

        def lift(row: KeyframeDepth) -> SeenKeyframe | CodecError:
            known = parts.get(LIFT, name(row)) if row.rgb == landmark_rows.NOT_READ else None
            if known is None:
                return lift_anew(row)
            grids = _LazyGrids(parts, name(row))
            lifted, colours = lifted_from(row.camera, row.world_from_camera, name(row), known, grids)
            if len(lifted.sighting_of) != len(row.objects):
                raise LostPartError
            category = np.array([numbers[thing.category] for thing in row.objects], np.int64)
            return seen_as(row, lifted, category, [thing.score for thing in row.objects], colours)

        def lift_anew(row: KeyframeDepth) -> SeenKeyframe | CodecError:
            size = (row.camera.height, row.camera.width)
            try:
                things = [
                    SeenObject(
                        numbers[o.category], o.score, decode_mask(o.mask, f"objects.mask of object {o.id}", size)
                    )
                    for o in row.objects
                ]
                depth = depth_of(row)
            except CodecError as error:
                return error
            lifted = lift_keyframe(
                row.camera, row.world_from_camera, depth, things, self.options.lift, self.options.see
            )
            lifted, colours = replace(lifted, name=name(row)), colours_in(row, lifted, telling(store.say))
            for kind, arrays in lift_arrays(lifted, colours).items():
                parts.put(kind, lifted.name, arrays)
            category = np.array([thing.category for thing in things], np.int64)
            return seen_as(row, lifted, category, [thing.score for thing in things], colours)

        def seen_as(
            row: KeyframeDepth,
            lifted: LiftedKeyframe,
            category: Int64Array,
            scores: Sequence[float],
            colours: Float32Array | None,
        ) -> SeenKeyframe:
            time = row.timestamp_ns if row.timestamp_ns is not None and row.timestamp_ns >= CLOCK_NS else None
            number = recordings.setdefault(row.recording, len(recordings))
            return SeenKeyframe(lifted, category, np.array(scores, np.float64), number, time, colours)

        def is_known(head: KeyframeHead) -> bool:
            return parts.get(LIFT, name(head)) is not None and parts.has(GRID, name(head))

        recordings: dict[str, int] = {}
        for chunk in landmark_rows.iter_keyframe_depths(store.engine, map_id, store.left_out, is_known):
            for row in chunk:
                recordings.setdefault(row.recording, len(recordings))
                for thing in row.objects:  # of a keyframe whose objects have no place, perhaps
                    if thing.category not in numbers:
                        numbers[thing.category] = len(numbers)
            for row, found in zip(chunk, each(lift, chunk, cores()), strict=True):
                if isinstance(found, CodecError):
                    store.left_out(row.id, found)
                    continue
                rows.append(row)
                seen.append(found)
            progress(min(len(rows), total // 2), total)

        def show(done: int, of: int) -> None:
            progress(total // 2 + done * total // (2 * max(of, 1)), total)

        classes = sorted(numbers, key=lambda name: numbers[name])
        wide = np.zeros((len(classes), len(classes)))
        wide[: len(names), : len(names)] = confusion
        found_all = find_landmarks(seen, len(classes), wide, up, self.options, show, parts, sizes_of(classes))
        stored = _stored(found_all, rows, classes, list(recordings), parts, told=told)
        parts.save()
        return stored

    def write(self, connection: Connection, map_id: int, result: LandmarkSet) -> int:
        from semdb.landmarks.identity import keep_ids

        return landmark_rows.replace_landmarks(connection, map_id, result, keep_ids)


class _LazyGrids:
    """What is large of a keyframe, read when it is first asked for."""

    def __init__(self, parts: LandmarkParts, name: str) -> None:
        from semdb.landmarks.remembered_lift import GRID

        self._parts, self._name = parts, name
        parts.keep(GRID, name)
        self._found: Grids | None = None

    def __call__(self) -> Grids:
        """Raises LostPartError where it is not there, or damaged."""
        from semdb.landmarks.remembered_lift import GRID, grids_from

        if self._found is None:
            large = self._parts.get(GRID, self._name)
            if large is None:
                raise LostPartError
            self._found = grids_from(large)
        return self._found


def _confusion(placed: Any, names: Sequence[str]) -> FloatArray:
    """Shares ``[classes, classes]`` of what goes by another name, as the step `classes` finds them."""
    options = ConfusionOptions()
    found = np.zeros((len(names), len(names)))
    for item in confusions(co_detections(placed, len(names), options), options):
        found[item.category, item.other] = item.weight / MILLION
    return found


def depth_of(row: KeyframeDepth) -> Float32Array | None:
    """Depth ``[H, W]`` in metres, registered to colour; None without. Raises CodecError for a damaged file."""
    from semdb.recordings.registration import decode_registered_depth

    if row.depth is None or row.depth_scale is None:
        return None
    name = f"keyframe_images.depth of keyframe {row.id}"
    try:
        return decode_registered_depth(row.depth, name, row.depth_scale, row.depth_registration, row.camera)
    except FrameError as error:
        raise CodecError(str(error)) from None


def colours_in(row: KeyframeDepth, lifted: LiftedKeyframe, say: Callable[[str], None]) -> Float32Array | None:
    """What the sightings of a keyframe look like; None where its image is none of its camera."""
    from semdb.landmarks.appearance import colours_of
    from semdb.recordings.images import decode_color

    try:
        rgb = decode_color(row.rgb, f"keyframe_images.rgb of keyframe {row.id}")
    except FrameError as error:
        say(f"keyframe {row.id} says nothing of colours: {error}")
        return None
    if rgb.shape[:2] != (row.camera.height, row.camera.width):
        return None
    return colours_of(rgb, lifted)


def _visit(visit: Visit, recordings: Sequence[str]) -> LandmarkVisit:
    centre = size = None
    if visit.box is not None:
        x, y, z = (float(value) for value in visit.box.centre)
        sx, sy, sz = (float(value) for value in visit.box.size)
        centre, size = (x, y, z), (sx, sy, sz)
    counts = (visit.keyframes, visit.points, visit.seen, visit.seen_through, visit.occluded, visit.missed)
    return LandmarkVisit(recordings[visit.recording], str(visit.presence), *counts, centre, size)


def _up_of_poses(store: Store, map_id: int) -> FloatArray | None:
    """Up of a map all of whose poses were estimated and turned upright: z. None of others."""
    sources = [recording_poses(store.engine, one.recording_id) for one in store.status(map_id)]
    upright = [one.world is World.FIRST_KEYFRAME and one.upright is True for one in sources]
    return np.array([0.0, 0.0, 1.0]) if upright and all(upright) else None


def _stored(
    found: Any,
    rows: Sequence[KeyframeDepth],
    classes: Sequence[str],
    recordings: Sequence[str],
    parts: LandmarkParts,
    *,
    told: bool,
) -> LandmarkSet:
    from semdb.landmarks.boxes import upright_axes
    from semdb.landmarks.completion import completed
    from semdb.landmarks.evidence import perhaps
    from semdb.landmarks.relations import find_relations

    numbers = {name: k for k, name in enumerate(classes)}
    axes = upright_axes(found.gravity.up)
    stored = []
    for thing in found.landmarks:
        first = thing.box.axes[:, 0] @ axes
        evidence = {
            classes[k]: round(float(value), 6) for k, value in enumerate(thing.evidence) if value >= LEAST_EVIDENCE
        }
        times = [rows[m.keyframe].timestamp_ns for m in thing.members]
        named = [numbers[rows[m.keyframe].objects[m.ordinal].category] for m in thing.members]
        others = perhaps(thing.evidence, thing.category, named)
        known = [time for time in times if time is not None]
        x, y, z = (float(value) for value in thing.box.centre)
        sx, sy, sz = (float(value) for value in thing.box.size)
        stored.append(
            LandmarkRow(
                category=classes[thing.category],
                probability=thing.probability,
                evidence=evidence,
                position=(x, y, z),
                covariance=thing.covariance,
                size=(sx, sy, sz),
                yaw=float(np.arctan2(first[1], first[0])),
                keyframes=thing.keyframes,
                missed=thing.missed,
                seen_through=thing.seen_through,
                state=str(thing.state),
                first_keyframe_id=rows[thing.first].id,
                last_keyframe_id=rows[thing.last].id,
                first_seen_ns=min(known, default=None),
                last_seen_ns=max(known, default=None),
                sightings=tuple(
                    LandmarkSighting(rows[m.keyframe].objects[m.ordinal].id, m.coverage, m.visibility)
                    for m in thing.members
                ),
                views=tuple(
                    LandmarkView(rows[v.keyframe].objects[v.ordinal].id, v.quality, v.distance) for v in thing.views
                ),
                visits=tuple(_visit(visit, recordings) for visit in thing.visits),
                appearance=thing.colours,
                perhaps={classes[k]: share for k, share in others.items()},
            )
        )
    related = find_relations(found.landmarks, classes, found.gravity.up, memo=parts)
    up_x, up_y, up_z = (float(value) for value in found.gravity.up)
    gravity = GravityRow(
        (up_x, up_y, up_z),
        found.gravity.up_certainty,
        found.gravity.floor,
        found.gravity.floor_certainty,
        told,
    )
    relations = tuple(LandmarkRelation(r.one, str(r.kind), r.other, r.score) for r in related)
    objects = [[(thing.category, thing.score, thing.height) for thing in row.objects] for row in rows]
    more = tuple(
        CompletedClass(row.id, name, *pair)
        for row, found_more in zip(rows, completed(objects, found.landmarks, classes), strict=True)
        for name, pair in sorted(found_more.items())
    )
    return LandmarkSet(tuple(stored), relations, gravity, more)
