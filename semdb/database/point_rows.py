"""Rows of `refined_points`: what `semdb refine` writes of each keyframe, and what the fine step reads."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, Engine, delete, insert, select

from semdb.database import retry
from semdb.database.codecs import decode_array, encode_array
from semdb.database.records import KeyframePoints, ListedKeyframe
from semdb.database.tables import keyframes, recordings, refined_points
from semdb.errors import CodecError
from semdb.types import Float32Array

CHUNK = 500


def listed_keyframes(engine: Engine, map_id: int) -> list[ListedKeyframe]:
    """All keyframes of a map by recording's name and frame: an order that does not depend on ids."""
    query = (
        select(keyframes.c.id, recordings.c.name, keyframes.c.frame_index)
        .select_from(keyframes.join(recordings))
        .where(recordings.c.map_id == map_id)
    )
    rows = retry.read(engine, lambda connection: list(connection.execute(query)))
    found = [ListedKeyframe(int(row.id), str(row.name), int(row.frame_index)) for row in rows]
    return sorted(found, key=lambda item: (item.recording, item.frame_index))


def replace_points(connection: Connection, map_id: int, points: Sequence[KeyframePoints]) -> int:
    """Write the refined points of a map in place of those that are there. Returns how many keyframes have any."""
    query = select(keyframes.c.id).join(recordings).where(recordings.c.map_id == map_id)
    there = sorted(connection.execute(query).scalars())
    for start in range(0, len(there), CHUNK):
        chunk = there[start : start + CHUNK]
        connection.execute(delete(refined_points).where(refined_points.c.keyframe_id.in_(chunk)))
    for found in points:
        row = {
            "keyframe_id": found.keyframe_id,
            "count": len(found.points),
            "fused": found.fused,
            "triangulated": found.triangulated,
            "data": encode_array(found.points),
        }
        connection.execute(insert(refined_points), row)  # one by one: blobs go as they are
    return len(points)


def load_points(engine: Engine, keyframe_ids: Sequence[int]) -> dict[int, Float32Array]:
    """Refined points float32 ``[n, 4]`` (X, Y, Z in the camera frame, sigma of Z) of those keyframes that have any.

    Raises CodecError for a damaged row.
    """
    c = refined_points.c
    keys = [int(key) for key in keyframe_ids]
    found: dict[int, Float32Array] = {}
    for start in range(0, len(keys), CHUNK):
        query = select(c.keyframe_id, c.data).where(c.keyframe_id.in_(keys[start : start + CHUNK]))
        for row in retry.read(engine, lambda connection, query=query: list(connection.execute(query))):  # type: ignore[misc]
            where = f"refined_points of keyframe {row.keyframe_id}"
            points = decode_array(row.data, where)
            if points.ndim != 2 or points.shape[1] != 4 or points.dtype != "<f4":
                raise CodecError(f"{where}: float32 [n, 4] is expected, not {points.dtype} {points.shape}")
            found[int(row.keyframe_id)] = points
    return found
