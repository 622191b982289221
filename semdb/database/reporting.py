"""Status of recordings, and the log of queries."""

from __future__ import annotations

import json
from typing import Any

from sqlalchemy import Connection, Engine, func, insert, select

from semdb.database import retry
from semdb.database.records import RecordingState, RecordingStatus
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
from semdb.errors import DatabaseError
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
        by_state = select(i.recording_id, i.state, func.count()).group_by(i.recording_id, i.state)
        for recording_id, state, count in connection.execute(by_state.order_by(i.recording_id, i.state)):
            items.setdefault(recording_id, {})[state] = count
        frames = _sums(connection, func.count(keyframes.c.id))
        boxes = _sums(connection, func.count(objects.c.id), objects)
        points = _sums(connection, func.sum(keypoints.c.count), keypoints)
        size = _sums(connection, func.sum(keyframe_images.c.rgb_bytes + keyframe_images.c.depth_bytes), keyframe_images)
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


def _sums(connection: Connection, value: Any, table: Any = None) -> dict[int, int]:
    """`value` over the keyframes of each recording, joined with `table` by keyframe_id."""
    source = keyframes if table is None else keyframes.join(table, table.c.keyframe_id == keyframes.c.id)
    query = select(keyframes.c.recording_id, value).select_from(source).group_by(keyframes.c.recording_id)
    return {recording_id: int(number or 0) for recording_id, number in connection.execute(query)}


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
    key = retry.write(engine, lambda c: c.execute(insert(queries), values).inserted_primary_key)
    if key is None:
        raise DatabaseError("the database gave no id for a row of queries")
    return int(key[0])
