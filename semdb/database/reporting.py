"""Status of recordings, and the log of queries."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, Engine, FromClause, func, select

from semdb.database import retry
from semdb.database.clock import now_plus
from semdb.database.ids import new_id
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
from semdb.database.writing import pose_columns
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
        for recording_id, state, count in sorted(tuple(row) for row in connection.execute(by_state)):
            items.setdefault(recording_id, {})[state] = count
        image_bytes = func.sum(keyframe_images.c.rgb_bytes + keyframe_images.c.depth_bytes)
        frames = _sums(connection, map_id, func.count(keyframes.c.id))
        boxes = _sums(connection, map_id, func.count(objects.c.id), objects)
        points = _sums(connection, map_id, func.sum(keypoints.c.count), keypoints)
        size = _sums(connection, map_id, image_bytes, keyframe_images)
        return [
            RecordingStatus(
                *row[:6],
                state=RecordingState(row.state),
                frame_count=row.frame_count,
                items=items.get(row.id, {}),
                keyframes=frames.get(row.id, 0),
                objects=boxes.get(row.id, 0),
                keypoints=points.get(row.id, 0),
                image_bytes=size.get(row.id, 0),
            )
            for row in rows
        ]

    return retry.read(engine, work)


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
        parts = f"{name}!!!".split("!")
        left = (_as_time(until) - _as_time(now)).total_seconds() if until is not None else 0.0
        found.append(WorkerStatus(parts[0], parts[2], int(count), left))
    return found


def _as_time(value: Any) -> datetime:
    """SQLite gives the text of a time that a function made."""
    return value if isinstance(value, datetime) else datetime.fromisoformat(str(value))


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
