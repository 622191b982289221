"""Reading keyframes back as values, in the order that was asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import Connection, Engine, Select, func, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.database import checked, retry
from semdb.database.codecs import decode_mask, decode_vectors
from semdb.database.columns import POSE_COLUMNS
from semdb.database.keyframe_rows import KeyframeRows, heads_of, keyframe_of, usable_poses
from semdb.database.records import KeyframeHead, StoredImage, StoredKeyframe
from semdb.database.tables import (
    cameras,
    categories,
    cnn_vectors,
    descriptors,
    keyframe_images,
    keyframes,
    keypoints,
    map_models,
    maps,
    object_features,
    objects,
    recordings,
)
from semdb.errors import CodecError, NotFoundError
from semdb.types import BoolArray, Float32Array, FloatArray

CHUNK = 500
Bad = Callable[[int, CodecError], None]  # takes a keyframe that is left out, and why
_FORMATS = ("", "png", "jpeg")


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


def check_keyframes(engine: Engine, keys: Sequence[int]) -> None:
    """Raises NotFoundError for a keyframe that is not there."""
    keys = _ints(keys)
    k = keyframes.c
    there = retry.read(engine, lambda c: set(_chunked(c, keys, lambda chunk: select(k.id).where(k.id.in_(chunk)))))
    _missing(keys, {key for (key,) in there}, "keyframe")


def encoder_id(connection: Connection, map_id: int) -> int | None:
    """The model whose vectors count in a map; None where none is named, and then all do."""
    m = map_models.c
    found = connection.execute(select(m.model_id).where(m.map_id == map_id, m.role == "encoder")).scalar()
    return None if found is None else int(found)


def by_own_encoder() -> ColumnElement[bool]:
    """Whether a row of `cnn_vectors` is by the encoder of its keyframe's map."""
    c, m, k = cnn_vectors.c, map_models.c, keyframes.c
    own = select(m.model_id).join(recordings, recordings.c.map_id == m.map_id)
    own = own.join(keyframes, k.recording_id == recordings.c.id).where(k.id == c.keyframe_id, m.role == "encoder")
    return c.model_id == func.coalesce(own.correlate(cnn_vectors).scalar_subquery(), c.model_id)


def load_vectors(engine: Engine, keys: Sequence[int]) -> Float32Array:
    """CNN vectors float32 ``[n, d]`` of keyframes in the order of `keys` (``[0, 0]`` for none).

    They are by the encoders of their maps.

    Raises NotFoundError for a keyframe that is not there, CodecError for a damaged one.
    """
    keys = _ints(keys)
    c = cnn_vectors.c
    vector = checked.up_to(c.vector, checked.MOST_VECTOR)

    def work(connection: Connection) -> dict[int, bytes]:
        query = select(c.keyframe_id, vector).where(by_own_encoder())
        rows = _chunked(connection, keys, lambda chunk: query.where(c.keyframe_id.in_(chunk)))
        return {row.keyframe_id: row.vector for row in rows}

    blobs = retry.read(engine, work)
    _missing(keys, blobs, "vector of the keyframe")
    return decode_vectors([blobs[key] for key in keys], np.array(keys, np.int64))


def poses(
    engine: Engine, map_id: int, keys: Sequence[int] | None = None, bad: Bad | None = None
) -> tuple[list[int], FloatArray]:
    """Ids (ascending) and poses float64 ``[n, 4, 4]`` of the keyframes of a map.

    With `keys`, of those of them that are in the map. A pose that is none is left out and told to `bad`, or raises
    CodecError.
    """
    k = keyframes.c
    query = select(k.id, *(k[name] for name in POSE_COLUMNS)).join(recordings).where(recordings.c.map_id == map_id)

    def work(connection: Connection) -> list[Any]:
        if keys is None:
            return list(connection.execute(query))
        return list(_chunked(connection, _ints(keys), lambda chunk: query.where(k.id.in_(chunk))))

    rows = sorted(map(tuple, retry.read(engine, work)), key=lambda row: row[0])
    usable, matrices = usable_poses([row[1:] for row in rows])
    for place in np.flatnonzero(~usable):
        try:
            checked.pose_numbers(rows[place][1:], f"keyframe {rows[place][0]}")
        except CodecError as error:
            _leave_out(bad, rows[place][0], error)
    return [rows[place][0] for place in np.flatnonzero(usable)], matrices


def _leave_out(bad: Bad | None, keyframe_id: int, error: CodecError) -> None:
    if bad is None:
        raise error
    bad(keyframe_id, error)


def load_keyframes(
    engine: Engine, keys: Sequence[int], *, with_descriptors: bool = True, bad: Bad | None = None
) -> list[StoredKeyframe]:
    """Keyframes with objects and keypoints, in the order of `keys`.

    Without descriptors theirs have the shape ``[n, 0]``. Raises NotFoundError; a damaged keyframe is left out and told
    to `bad`, or raises CodecError.
    """
    keys = _ints(keys)
    once = list(dict.fromkeys(keys))
    rows = retry.read(engine, lambda connection: _keyframe_rows(connection, once, with_descriptors))
    _missing(keys, rows.frames, "keyframe")
    found = []
    for key in keys:
        try:
            found.append(keyframe_of(rows, key))
        except CodecError as error:
            _leave_out(bad, key, error)
    return found


def _keyframe_rows(connection: Connection, keys: Sequence[int], with_descriptors: bool) -> KeyframeRows:
    k, c, o, p, d = keyframes.c, cameras.c, objects.c, keypoints.c, descriptors.c
    of_camera = [column for column in c if column.name not in ("id", "digest", "distortion")]
    frames = (
        select(*k, *of_camera, checked.up_to(c.distortion, checked.MOST_DISTORTION), recordings.c.map_id)
        .add_columns(recordings.c.name.label("recording"), maps.c.name.label("map"))
        .join(cameras, c.id == k.camera_id, isouter=True)
        .join(recordings, recordings.c.id == k.recording_id)
        .join(maps, maps.c.id == recordings.c.map_id)
    )
    features = select(p.keyframe_id, p.count, checked.up_to(p.data, checked.MOST_KEYPOINTS))
    described = select(d.keyframe_id, checked.up_to(d.data, checked.MOST_DESCRIPTORS))
    things = (
        select(*(column for column in o if column.name != "mask"), categories.c.name)
        .add_columns(object_features.c.start, object_features.c.count)
        .join(categories, categories.c.id == o.category_id, isouter=True)
        .join(object_features, object_features.c.object_id == o.id, isouter=True)
        .order_by(o.keyframe_id, o.ordinal)
    )

    def each(query: Select[Any], column: Any) -> Iterator[Any]:
        return _chunked(connection, keys, lambda chunk: query.where(column.in_(chunk)))

    rows = KeyframeRows(
        frames={row.id: row for row in each(frames, k.id)},
        keypoints={row.keyframe_id: row for row in each(features, p.keyframe_id)},
    )
    for row in each(things, o.keyframe_id):
        rows.objects.setdefault(row.keyframe_id, []).append(row)
    if with_descriptors:
        rows.descriptors = {row.keyframe_id: row for row in each(described, d.keyframe_id)}
    return rows


def keyframe_heads(
    engine: Engine,
    *,
    keys: Sequence[int] | None = None,
    map_id: int | None = None,
    recording_id: int | None = None,
    after: int = 0,
    limit: int | None = None,
    bad: Bad | None = None,
) -> list[KeyframeHead]:
    """Keyframes without what is large, by ascending id: those of `keys`, or of a map or recording, after an id.

    Raises NotFoundError for one of `keys` that is not there; a damaged one is left out and told to `bad`, or raises
    CodecError.
    """
    k, c, r = keyframes.c, cameras.c, recordings.c
    of_camera = [column for column in c if column.name not in ("id", "digest", "distortion")]
    query = (
        select(*k, *of_camera, checked.up_to(c.distortion, checked.MOST_DISTORTION))
        .add_columns(r.name.label("recording"), maps.c.name.label("map"), r.map_id)
        .join(cameras, c.id == k.camera_id, isouter=True)
        .join(recordings, r.id == k.recording_id)
        .join(maps, maps.c.id == r.map_id)
        .order_by(k.id)
    )
    if map_id is not None:
        query = query.where(r.map_id == map_id)
    if recording_id is not None:
        query = query.where(k.recording_id == recording_id)

    def page(connection: Connection, start: int, size: int | None) -> list[Any]:
        if keys is None:
            return list(connection.execute(query.where(k.id > start).limit(size)))
        return list(_chunked(connection, _ints(keys), lambda chunk: query.where(k.id > start, k.id.in_(chunk))))

    found: list[KeyframeHead] = []
    while True:
        wanted = None if limit is None else limit - len(found)
        rows = retry.read(engine, partial(page, start=after, size=wanted))
        if keys is not None:
            _missing(_ints(keys), {row.id for row in rows}, "keyframe")
        found += heads_of(rows, partial(_leave_out, bad))
        if wanted is None or keys is not None or len(rows) < wanted or len(found) == limit:
            return found
        after = rows[-1].id  # damaged ones must not make a page look like the last


def load_image(engine: Engine, keyframe_id: int) -> StoredImage:
    """The files of a keyframe as recorded. Raises NotFoundError, CodecError."""
    c = keyframe_images.c
    rgb, depth = (checked.up_to(column, checked.MOST_FILE) for column in (c.rgb, c.depth))
    query = select(rgb, c.rgb_format, depth, c.depth_format, c.depth_scale, c.depth_registration)
    query = query.where(c.keyframe_id == int(keyframe_id))
    row = retry.read(engine, lambda connection: connection.execute(query).one_or_none())
    if row is None:
        check_keyframes(engine, [keyframe_id])
        raise CodecError(f"keyframe_images has no row of keyframe {keyframe_id}")

    def name(column: str) -> str:
        return f"keyframe_images.{column} of keyframe {keyframe_id}"

    return StoredImage(
        rgb=checked.blob(row.rgb, name("rgb")),
        rgb_format=_format(row.rgb_format, name("rgb_format")),
        depth=None if row.depth is None else checked.blob(row.depth, name("depth")),
        depth_format=_format(row.depth_format, name("depth_format")),
        depth_scale=depth_scale_of(row.depth_scale, keyframe_id),
        depth_registration=checked.text(row.depth_registration, name("depth_registration"), 32),
    )


def depth_scale_of(value: Any, keyframe_id: int) -> float | None:
    """Units per metre, None where there is no depth. Raises CodecError."""
    where = f"keyframe_images.depth_scale of keyframe {keyframe_id}"
    return None if value is None else checked.real(value, where, 1e-6, 1e9)


def _format(value: Any, where: str) -> str:
    if value not in _FORMATS:
        raise CodecError(f"{where} is {checked.shown(value)}, not png, jpeg or empty")
    return str(value)


def load_masks(engine: Engine, keyframe_id: int) -> tuple[BoolArray, ...]:
    """Masks ``[H, W]`` of the objects of a keyframe, by ordinal (none for a keyframe without objects).

    Raises CodecError, also for one of another size than the camera's.
    """
    query = (
        select(objects.c.id, checked.up_to(objects.c.mask, checked.MOST_MASK), cameras.c.width, cameras.c.height)
        .join(keyframes, keyframes.c.id == objects.c.keyframe_id)
        .join(cameras, cameras.c.id == keyframes.c.camera_id)
        .where(objects.c.keyframe_id == int(keyframe_id))
        .order_by(objects.c.ordinal)
    )
    masks = []
    for row in retry.read(engine, lambda connection: list(connection.execute(query))):
        where = f"objects.mask of object {row.id} (keyframe {keyframe_id})"
        masks.append(decode_mask(checked.blob(row.mask, where), where, (row.height, row.width)))
    return tuple(masks)
