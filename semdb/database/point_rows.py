"""Rows of `refined_points`: what `semdb refine` writes of each keyframe, and what the fine step reads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sqlalchemy import Connection, Engine, delete, insert, select

from semdb.database import checked, retry
from semdb.database.codecs import decode_array, encode_array
from semdb.database.keyframe_rows import FARTHEST_POINT_M
from semdb.database.reading import Bad
from semdb.database.records import KeyframePoints, ListedKeyframe
from semdb.database.tables import keyframes, recordings, refined_points
from semdb.errors import CodecError
from semdb.types import Float32Array

CHUNK = 500


def listed_keyframes(engine: Engine, map_id: int) -> list[ListedKeyframe]:
    """All keyframes of a map by recording's name and frame: an order that does not depend on ids."""
    query = (
        select(keyframes.c.id, recordings.c.name, keyframes.c.frame_index, keyframes.c.recording_id)
        .select_from(keyframes.join(recordings))
        .where(recordings.c.map_id == map_id)
    )
    rows = retry.read(engine, lambda connection: list(connection.execute(query)))
    found = [
        ListedKeyframe(
            int(row.id),
            checked.text(row.name, f"recordings.name of recording {row.recording_id}"),
            checked.integer(row.frame_index, f"keyframes.frame_index of keyframe {row.id}"),
        )
        for row in rows
    ]
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


def load_points(engine: Engine, keyframe_ids: Sequence[int], bad: Bad | None = None) -> dict[int, Float32Array]:
    """Refined points float32 ``[n, 4]`` (X, Y, Z in the camera frame, sigma of Z) of those keyframes that have any.

    A damaged row is left out and told to `bad`, or raises CodecError.
    """
    c = refined_points.c
    keys = [int(key) for key in keyframe_ids]
    data = checked.up_to(c.data, checked.MOST_KEYPOINTS)
    found: dict[int, Float32Array] = {}
    for start in range(0, len(keys), CHUNK):
        query = select(c.keyframe_id, data).where(c.keyframe_id.in_(keys[start : start + CHUNK]))
        for row in retry.read(engine, lambda connection, query=query: list(connection.execute(query))):  # type: ignore[misc]
            try:
                found[int(row.keyframe_id)] = _points(row.data, f"refined_points.data of keyframe {row.keyframe_id}")
            except CodecError as error:
                if bad is None:
                    raise
                bad(int(row.keyframe_id), error)
    return found


def _points(data: object, where: str) -> Float32Array:
    points = decode_array(checked.blob(data, where), where)
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype != "<f4":
        raise CodecError(f"{where}: float32 [n, 4] is expected, not {points.dtype} {list(points.shape)}")
    if np.isinf(points).any() or (np.abs(points[~np.isnan(points)]) > FARTHEST_POINT_M).any():
        raise CodecError(f"{where}: a point is more than {FARTHEST_POINT_M:g} m away")
    known = np.isfinite(points[:, 2])
    if not (points[known, 3] >= 0).all() or not np.isfinite(points[known]).all():
        raise CodecError(f"{where}: a sigma is no number")
    return points
