"""Reading keyframes back as values, in the order that was asked for."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from sqlalchemy import Connection, Engine, Select, select

from semdb.database import retry
from semdb.database.codecs import decode_array, decode_keypoints, decode_mask, decode_vectors, keypoint_rows
from semdb.database.records import KeyframeHead, StoredImage, StoredKeyframe, StoredObject
from semdb.database.tables import (
    cameras,
    categories,
    cnn_vectors,
    descriptors,
    keyframe_images,
    keyframes,
    keypoints,
    maps,
    object_features,
    objects,
    recordings,
)
from semdb.errors import CodecError, NotFoundError
from semdb.geometry import pose_from, rotation_from_quat_wxyz, rotations_from_quats_wxyz
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, ObjectGeometry

CHUNK = 500


def _chunked(
    connection: Connection, keys: Sequence[int], query: Callable[[Sequence[int]], Select[Any]]
) -> Iterator[Any]:
    for start in range(0, len(keys), CHUNK):
        yield from connection.execute(query(keys[start : start + CHUNK]))


def _ints(keys: Sequence[int]) -> list[int]:
    """Numpy's integers are not what drivers take, and larger ones than 64 bits nobody's. Raises NotFoundError."""
    for key in keys:
        if not -(2**63) <= key < 2**63:
            raise NotFoundError(f"there is no keyframe {key}")
    return [int(key) for key in keys]


def _missing(keys: Sequence[int], found: Any, what: str) -> None:
    gone = [key for key in keys if key not in found]
    if gone:
        raise NotFoundError(f"there is no {what} {gone[0]}" + (f" (and {len(gone) - 1} more)" if gone[1:] else ""))


def keyframe_ids(engine: Engine, map_id: int) -> list[int]:
    """Ids of all keyframes of a map, ascending."""
    query = select(keyframes.c.id).join(recordings).where(recordings.c.map_id == map_id).order_by(keyframes.c.id)
    return retry.read(engine, lambda c: list(c.execute(query).scalars()))


def load_vectors(engine: Engine, keys: Sequence[int]) -> Float32Array:
    """CNN vectors float32 ``[n, d]`` of keyframes in the order of `keys` (``[0, 0]`` for none).

    Raises NotFoundError for a keyframe that is not there, CodecError for a damaged one.
    """
    keys = _ints(keys)

    def work(connection: Connection) -> dict[int, bytes]:
        c = cnn_vectors.c
        rows = _chunked(connection, keys, lambda chunk: select(c.keyframe_id, c.vector).where(c.keyframe_id.in_(chunk)))
        return {row.keyframe_id: row.vector for row in rows}

    blobs = retry.read(engine, work)
    _missing(keys, blobs, "vector of the keyframe")
    return decode_vectors([blobs[key] for key in keys], "cnn_vectors of keyframe", np.array(keys, np.int64))


def _pose(row: Any) -> FloatArray:
    return pose_from(rotation_from_quat_wxyz([row.qw, row.qx, row.qy, row.qz]), [row.tx, row.ty, row.tz])


def poses(engine: Engine, map_id: int, keys: Sequence[int] | None = None) -> tuple[list[int], FloatArray]:
    """Ids (ascending) and poses float64 ``[n, 4, 4]`` of the keyframes of a map.

    With `keys`, of those of them that are in the map.
    """
    k = keyframes.c
    query = select(k.id, k.qw, k.qx, k.qy, k.qz, k.tx, k.ty, k.tz).join(recordings).where(recordings.c.map_id == map_id)

    def work(connection: Connection) -> list[Any]:
        if keys is None:
            return list(connection.execute(query))
        return list(_chunked(connection, _ints(keys), lambda chunk: query.where(k.id.in_(chunk))))

    rows = sorted(map(tuple, retry.read(engine, work)))
    numbers = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 7)
    matrices = np.zeros((len(rows), 4, 4))
    matrices[:, :3, :3] = rotations_from_quats_wxyz(numbers[:, :4])
    matrices[:, :3, 3] = numbers[:, 4:]
    matrices[:, 3, 3] = 1.0
    return [row[0] for row in rows], matrices


def load_keyframes(engine: Engine, keys: Sequence[int], *, with_descriptors: bool = True) -> list[StoredKeyframe]:
    """Keyframes with objects and keypoints, in the order of `keys`.

    Without descriptors theirs have the shape ``[n, 0]``. Raises NotFoundError, CodecError.
    """
    keys = _ints(keys)
    rows = retry.read(engine, lambda connection: _keyframe_rows(connection, keys, with_descriptors))
    _missing(keys, rows["frames"], "keyframe")
    return [_keyframe(rows, key, with_descriptors) for key in keys]


def _keyframe_rows(connection: Connection, keys: Sequence[int], with_descriptors: bool) -> dict[str, dict[int, Any]]:
    k, o = keyframes.c, objects.c
    frame_columns = (k, cameras.c, recordings.c)
    rows: dict[str, dict[int, Any]] = {
        "frames": {
            row.id: row
            for row in _chunked(
                connection,
                keys,
                lambda chunk: (
                    select(
                        *(column for column in frame_columns[0]),
                        *(column for column in frame_columns[1] if column.name not in ("id", "digest")),
                        recordings.c.map_id,
                        recordings.c.name.label("recording"),
                    )
                    .join(cameras, cameras.c.id == k.camera_id)
                    .join(recordings, recordings.c.id == k.recording_id)
                    .where(k.id.in_(chunk))
                ),
            )
        },
        "objects": {},
        "keypoints": {
            row.keyframe_id: row.data
            for row in _chunked(
                connection,
                keys,
                lambda chunk: select(keypoints.c.keyframe_id, keypoints.c.data).where(
                    keypoints.c.keyframe_id.in_(chunk)
                ),
            )
        },
        "descriptors": {},
    }
    columns = [column for column in o if column.name != "mask"]
    for row in _chunked(
        connection,
        keys,
        lambda chunk: (
            select(*columns, categories.c.name, object_features.c.start, object_features.c.count)
            .join(categories, categories.c.id == o.category_id)
            .join(object_features, object_features.c.object_id == o.id)
            .where(o.keyframe_id.in_(chunk))
            .order_by(o.keyframe_id, o.ordinal)
        ),
    ):
        rows["objects"].setdefault(row.keyframe_id, []).append(row)
    if with_descriptors:
        d = descriptors.c
        for item in _chunked(
            connection, keys, lambda chunk: select(d.keyframe_id, d.data).where(d.keyframe_id.in_(chunk))
        ):
            rows["descriptors"][item.keyframe_id] = item.data
    return rows


def _keyframe(rows: dict[str, dict[int, Any]], key: int, with_descriptors: bool) -> StoredKeyframe:
    row = rows["frames"][key]
    object_rows = rows["objects"].get(key, [])
    blob = rows["keypoints"].get(key)
    if blob is None or (with_descriptors and key not in rows["descriptors"]):
        raise CodecError(f"keyframe {key} has no keypoints: delete its recording and ingest it again")
    described = decode_array(rows["descriptors"][key], f"descriptors of keyframe {key}") if with_descriptors else None
    count = len(keypoint_rows(blob, f"keypoints of keyframe {key}"))
    object_index = np.full(count, -1, dtype=np.int32)
    for item in object_rows:
        # "count" is also a method of a row
        object_index[item.start : item.start + item._mapping["count"]] = item.ordinal
    return StoredKeyframe(
        id=row.id,
        map_id=row.map_id,
        recording_id=row.recording_id,
        recording=row.recording,
        frame_index=row.frame_index,
        timestamp_ns=row.timestamp_ns,
        camera=camera_from_row(row),
        world_from_camera=_pose(row),
        objects=tuple(_object(item) for item in object_rows),
        keypoints=decode_keypoints(blob, described, object_index, f"keypoints of keyframe {key}"),
    )


def camera_from_row(row: Any) -> Camera:
    """The camera of a row that has the columns of `cameras`."""
    return Camera(row.width, row.height, row.fx, row.fy, row.cx, row.cy, tuple(json.loads(row.distortion)))


def _object(row: Any) -> StoredObject:
    def triple(name: str) -> FloatArray:
        values = [getattr(row, f"{name}_{axis}") for axis in "xyz"]
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)

    return StoredObject(
        id=row.id,
        ordinal=row.ordinal,
        category=row.name,
        score=row.score,
        box=np.array([row.x1, row.y1, row.x2, row.y2], dtype=np.float32),
        geometry=ObjectGeometry(row.pixel_area, triple("centroid"), triple("extent")),
    )


def keyframe_heads(
    engine: Engine,
    *,
    keys: Sequence[int] | None = None,
    map_id: int | None = None,
    recording_id: int | None = None,
    after: int = 0,
    limit: int | None = None,
) -> list[KeyframeHead]:
    """Keyframes without what is large, by ascending id: those of `keys`, or of a map or recording, after an id.

    Raises NotFoundError for one of `keys` that is not there.
    """
    k, r = keyframes.c, recordings.c
    query = (
        select(
            *(column for column in k),
            *(column for column in cameras.c if column.name not in ("id", "digest")),
            r.name.label("recording"),
            maps.c.name.label("map"),
        )
        .join(cameras, cameras.c.id == k.camera_id)
        .join(recordings, r.id == k.recording_id)
        .join(maps, maps.c.id == r.map_id)
        .where(k.id > after)
        .order_by(k.id)
    )
    if map_id is not None:
        query = query.where(r.map_id == map_id)
    if recording_id is not None:
        query = query.where(k.recording_id == recording_id)

    def work(connection: Connection) -> list[Any]:
        if keys is None:
            return list(connection.execute(query.limit(limit)))
        return list(_chunked(connection, _ints(keys), lambda chunk: query.where(k.id.in_(chunk))))

    rows = retry.read(engine, work)
    if keys is not None:
        _missing(_ints(keys), {row.id for row in rows}, "keyframe")
    return [
        KeyframeHead(
            id=row.id,
            map=row.map,
            recording=row.recording,
            frame_index=row.frame_index,
            timestamp_ns=row.timestamp_ns,
            camera=camera_from_row(row),
            world_from_camera=_pose(row),
        )
        for row in rows
    ]


def load_image(engine: Engine, keyframe_id: int) -> StoredImage:
    """The files of a keyframe as recorded. Raises NotFoundError."""
    c = keyframe_images.c
    query = select(c.rgb, c.rgb_format, c.depth, c.depth_format, c.depth_scale, c.depth_registration)
    query = query.where(c.keyframe_id == int(keyframe_id))
    row = retry.read(engine, lambda connection: connection.execute(query).one_or_none())
    if row is None:
        raise NotFoundError(f"there is no image of the keyframe {keyframe_id}")
    return StoredImage(*row)


def load_masks(engine: Engine, keyframe_id: int) -> tuple[BoolArray, ...]:
    """Masks ``[H, W]`` of the objects of a keyframe, by ordinal (none for a keyframe without objects)."""
    query = select(objects.c.ordinal, objects.c.mask).where(objects.c.keyframe_id == int(keyframe_id))
    rows = retry.read(engine, lambda c: list(c.execute(query.order_by(objects.c.ordinal))))
    return tuple(decode_mask(blob, f"mask of object {ordinal} of keyframe {keyframe_id}") for ordinal, blob in rows)
