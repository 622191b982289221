"""What pages show of a landmark and of a keyframe: which objects show which landmark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import BigInteger, Connection, Engine, cast, func, select

from semdb.database import checked, retry
from semdb.database.exact_sums import exact_sum
from semdb.database.ids import camera_row
from semdb.database.landmark_tables import landmark_sightings, landmarks, map_gravity
from semdb.database.refinements import MICRO, map_state_of, within
from semdb.database.tables import cameras, categories, keyframes, loop_closures, objects, recordings, refinements
from semdb.types import Camera, FloatArray, Int64Array

MOST_PIXELS = 1e6
_UP = ("up_x", "up_y", "up_z")


@dataclass(frozen=True, slots=True)
class StoredSighting:
    """An object that shows a landmark; `box` is x1, y1, x2, y2 in pixels of its keyframe.

    `coverage` says how much of the landmark the object shows, `visibility` how much of it could be seen from there.
    """

    landmark_id: int
    object_id: int
    ordinal: int
    keyframe_id: int
    recording: str
    frame_index: int
    timestamp_ns: int | None
    category: str
    score: float
    box: tuple[float, float, float, float]
    coverage: float
    visibility: float


def sightings_of_landmark(engine: Engine, map_id: int, landmark_id: int) -> list[StoredSighting]:
    """All sightings of a landmark of a map, by time, then id. Raises CodecError for a damaged row."""
    query = _statement().where(landmark_sightings.c.landmark_id == int(landmark_id), landmarks.c.map_id == map_id)
    return _read(engine, query)


def sightings_in_keyframe(engine: Engine, keyframe_id: int) -> list[StoredSighting]:
    """The landmarks that objects of a keyframe show. Raises CodecError for a damaged row."""
    return _read(engine, _statement().where(objects.c.keyframe_id == int(keyframe_id)))


def sighting_boxes(engine: Engine, map_id: int, camera: Camera) -> tuple[Int64Array, Int64Array, FloatArray]:
    """Which landmark ``[n]`` of a map which keyframe ``[n]`` shows (ids), and in which boxes ``[n, 4]`` (pixels).

    Of the keyframes that `camera` took, by landmark and object; a row whose box is damaged is left out.
    """
    s, o, m = landmark_sightings.c, objects.c, landmarks.c
    by_camera = keyframes.join(cameras, cameras.c.id == keyframes.c.camera_id)
    query = (
        select(s.landmark_id, o.keyframe_id, o.x1, o.y1, o.x2, o.y2)
        .select_from(
            landmark_sightings.join(objects, o.id == s.object_id)
            .join(landmarks, m.id == s.landmark_id)
            .join(by_camera, keyframes.c.id == o.keyframe_id)
        )
        .where(m.map_id == map_id, cameras.c.digest == camera_row(camera)["digest"])
        .order_by(s.landmark_id, s.object_id)
    )
    rows = retry.read(engine, lambda c: list(c.execute(query)))
    kept = [row for row in rows if all(isinstance(value, float) and abs(value) < MOST_PIXELS for value in row[2:])]
    boxes = np.array([row[2:] for row in kept], np.float64).reshape(-1, 4)
    return np.array([row[0] for row in kept], np.int64), np.array([row[1] for row in kept], np.int64), boxes


def _statement() -> Any:
    s, o, k = landmark_sightings.c, objects.c, keyframes.c
    return (
        select(s.landmark_id, s.object_id, s.coverage, s.visibility, o.keyframe_id, o.ordinal, o.score)
        .add_columns(o.x1, o.y1, o.x2, o.y2, categories.c.name.label("category"))
        .add_columns(recordings.c.name.label("recording"), k.frame_index, k.timestamp_ns)
        .select_from(
            landmark_sightings.join(objects, o.id == s.object_id)
            .join(landmarks, landmarks.c.id == s.landmark_id)
            .join(keyframes, k.id == o.keyframe_id)
            .join(recordings, recordings.c.id == k.recording_id)
            .join(categories, categories.c.id == o.category_id)
        )
        .order_by(k.timestamp_ns, s.object_id)
    )


def _read(engine: Engine, query: Any) -> list[StoredSighting]:
    return [_sighting(row) for row in retry.read(engine, lambda c: list(c.execute(query)))]


def _sighting(row: Any) -> StoredSighting:
    where = f"of object {row.object_id}"

    def real(name: str) -> float:
        return checked.real(getattr(row, name), f"{name} {where}", -1e7, 1e7)

    return StoredSighting(
        landmark_id=int(row.landmark_id),
        object_id=int(row.object_id),
        ordinal=int(row.ordinal),
        keyframe_id=int(row.keyframe_id),
        recording=str(row.recording),
        frame_index=int(row.frame_index),
        timestamp_ns=None if row.timestamp_ns is None else int(row.timestamp_ns),
        category=checked.text(row.category, f"categories.name {where}"),
        score=real("score"),
        box=(real("x1"), real("y1"), real("x2"), real("y2")),
        coverage=real("coverage"),
        visibility=real("visibility"),
    )


def scene_state(engine: Engine, map_id: int) -> str:
    """What viewers draw of a map, in a line: equal lines, the same keyframes, landmarks, links and up.

    Sums, as of `refinements.map_state`, which cost a fraction of reading the rows.
    """
    return retry.read(engine, lambda connection: _scene_state(connection, map_id))


def _scene_state(connection: Connection, map_id: int) -> str:
    r, t, c = refinements.c, landmarks.c, loop_closures.c
    steps = select(r.kind, r.computed_at, r.row_count, r.map_state).where(r.map_id == map_id).order_by(r.kind)
    up = select(*(getattr(map_gravity.c, name) for name in _UP)).where(map_gravity.c.map_id == map_id)
    mixed = within(t.x) + 2 * within(t.y) + 3 * within(t.z) + 5 * within(t.size_x) + 7 * within(t.size_y)
    mixed = mixed + 11 * within(t.size_z) + 13 * within(t.yaw) + 17 * within(t.probability)
    places = exact_sum(connection.engine, cast(func.round(mixed * MICRO), BigInteger))
    ids = exact_sum(connection.engine, t.id)
    things = select(t.category_id, t.state, func.count(), func.coalesce(func.max(t.last_seen_ns), 0), *ids, *places)
    things = things.where(t.map_id == map_id).group_by(t.category_id, t.state).order_by(t.category_id, t.state)
    ends = exact_sum(connection.engine, c.keyframe_id + 3 * c.other_keyframe_id)
    links = select(c.kind, c.state, func.count(), func.coalesce(func.sum(c.inliers), 0), *ends)
    links = links.select_from(loop_closures.join(keyframes, keyframes.c.id == c.keyframe_id).join(recordings))
    links = links.where(recordings.c.map_id == map_id).group_by(c.kind, c.state).order_by(c.kind, c.state)
    parts = [map_state_of(connection, map_id)]
    for query in (steps, up, things, links):
        parts += [_in_a_line(row) for row in connection.execute(query)]
    return "; ".join(parts)


def _in_a_line(row: Any) -> str:
    return " ".join(value if isinstance(value, str) else str(value) for value in row)
