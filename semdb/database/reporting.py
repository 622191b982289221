"""Status of recordings, and the log of queries."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, FromClause, case, func, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.database import checked, retry
from semdb.database.clock import now_plus
from semdb.database.ids import new_id
from semdb.database.keyframe_rows import pose_columns
from semdb.database.records import ItemState, RecordingState, RecordingStatus
from semdb.database.tables import (
    ingest_items,
    keyframe_images,
    keyframes,
    keypoints,
    maps,
    objects,
    queries,
    recordings,
)
from semdb.types import Localization


def status(engine: Engine, map_id: int | None = None) -> list[RecordingStatus]:
    """The recordings of a map, or of all, by id, with what the plan has come to and what is stored."""

    def work(connection: Connection) -> list[RecordingStatus]:
        r = recordings.c
        query = select(r.id, r.map_id, maps.c.name, r.name, r.format, r.source, r.state, r.frame_count)
        query = query.join(maps, maps.c.id == r.map_id).order_by(r.id)
        if map_id is not None:
            query = query.where(r.map_id == map_id)
        rows = list(connection.execute(query))
        items: dict[int, dict[str, int]] = {}
        i = ingest_items.c
        # In the order of an index that holds all three.
        by_state = select(i.recording_id, i.state, func.count()).group_by(i.state, i.recording_id)
        if map_id is not None:
            by_state = by_state.join(recordings, r.id == i.recording_id).where(r.map_id == map_id)
        for recording_id, state, count in connection.execute(by_state):
            items.setdefault(recording_id, {})[state] = count
        image_bytes = func.sum(_size(keyframe_images.c.rgb_bytes) + _size(keyframe_images.c.depth_bytes))
        frames = _sums(connection, map_id, func.count(keyframes.c.id))
        boxes = _sums(connection, map_id, func.count(objects.c.id), objects)
        points = _sums(connection, map_id, func.sum(_size(keypoints.c.count)), keypoints)
        size = _sums(connection, map_id, image_bytes, keyframe_images)
        return [
            RecordingStatus(
                **_recording(row),
                items=_items(items.get(row.id, {}), row.id),
                keyframes=frames.get(row.id, 0),
                objects=boxes.get(row.id, 0),
                keypoints=points.get(row.id, 0),
                image_bytes=size.get(row.id, 0),
            )
            for row in rows
        ]

    return retry.read(engine, work)


def _recording(row: Any) -> dict[str, Any]:
    def where(column: str) -> str:
        return f"recordings.{column} of recording {row.id}"

    return {
        "recording_id": row.id,
        "map_id": row.map_id,
        "map": checked.text(row[2], f"maps.name of map {row.map_id}"),
        "name": checked.text(row[3], where("name")),
        "format": checked.text(row.format, where("format"), 32),
        "source": checked.text(row.source, where("source"), checked.MOST_JSON),
        "state": checked.choice(row.state, where("state"), RecordingState),
        "frame_count": checked.integer(row.frame_count, where("frame_count")),
    }


def _items(counts: dict[Any, int], recording_id: int) -> dict[str, int]:
    """How many keyframes of a plan are in which state, by its name."""
    where = f"ingest_items.state of recording {recording_id}"
    return dict(sorted((checked.choice(state, where, ItemState).value, count) for state, count in counts.items()))


def _size(column: ColumnElement[int]) -> ColumnElement[int]:
    """A size or a number; 0 for what is none, which could overflow a sum."""
    return case((column.between(0, checked.LARGEST), column), else_=0)


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """A worker with keyframes in hand. `seconds_left` of its shortest lease, by the database's clock."""

    machine: str
    process: str
    items: int
    seconds_left: float


def workers(engine: Engine) -> list[WorkerStatus]:
    """Who works on keyframes now, by name."""
    item = ingest_items.c
    query = (
        select(item.worker, func.count(), func.min(item.lease_until), now_plus())
        .where(item.state == ItemState.RUNNING.value, item.worker.is_not(None))
        .group_by(item.worker)
        .order_by(item.worker)
    )
    found = []
    for name, count, until, now in retry.read(engine, lambda c: list(c.execute(query))):
        where = f"of worker {checked.shown(name)}"
        parts = f"{checked.text(name, f'ingest_items.worker {where}')}!!!".split("!")
        left = 0.0
        if until is not None:
            end = checked.moment(until, f"ingest_items.lease_until {where}")
            left = (end - checked.moment(now, "the time of the database")).total_seconds()
        found.append(WorkerStatus(parts[0], parts[2], int(count), left))
    return found


def _sums(connection: Connection, map_id: int | None, value: Any, table: Any = None) -> dict[int, int]:
    """`value` over the keyframes of each recording of a map (None: of all), joined with `table` by keyframe_id."""
    source: FromClause = keyframes
    recording_id = keyframes.c.recording_id
    if map_id is not None:
        source = recordings.join(keyframes, keyframes.c.recording_id == recordings.c.id)
        recording_id = recordings.c.id
    if table is not None:
        source = source.join(table, table.c.keyframe_id == keyframes.c.id)
    query = select(recording_id, value).select_from(source).group_by(recording_id)
    if map_id is not None:
        query = query.where(recordings.c.map_id == map_id)
    # From the keyframes to what belongs to them: the other way round a server reads a table of blobs from end to end.
    query = query.prefix_with("STRAIGHT_JOIN", dialect="mysql")
    return {key: int(number or 0) for key, number in connection.execute(query)}


def log_query(engine: Engine, map_id: int, image: str, localization: Localization) -> int:
    """Add a localization to the log. Returns the id of the row. Raises DatabaseError."""
    pose = localization.world_from_camera
    values: dict[str, Any] = {
        "map_id": map_id,
        "image": image,
        "verdict": localization.verdict.value,
        **({} if pose is None else pose_columns(pose)),
        "confidence": float(localization.confidence),
        "inliers": int(localization.inliers),
        "stage": localization.stage,
        "reason": localization.reason,
        "candidates": json.dumps(
            [
                {
                    "keyframe": candidate.keyframe_id,
                    "recording": candidate.recording,
                    "frame_index": candidate.frame_index,
                    "class_score": candidate.class_score,
                    "cosine": None if candidate.cosine != candidate.cosine else float(candidate.cosine),
                    "inliers": candidate.inliers,
                }
                for candidate in localization.candidates
            ]
        ),
        "timing_ms": json.dumps({name: round(float(ms), 3) for name, ms in localization.timing_ms.items()}),
    }
    return retry.write(engine, lambda connection: new_id(connection, queries, values))
