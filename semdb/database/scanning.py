"""Reading what a whole map holds, in chunks, as arrays: for what keeps a mirror of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from sqlalchemy import Connection, Engine, select

from semdb.database import retry
from semdb.database.codecs import decode_vectors
from semdb.database.reading import keyframe_ids
from semdb.database.tables import cnn_vectors
from semdb.types import Float32Array, Int64Array

IN_CHUNK = 500
DENSE = 0.5  # of the ids of a range that are wanted: from here on the range is read, not a list of ids


def iter_vectors(engine: Engine, map_id: int, chunk: int = 2000) -> Iterator[tuple[Int64Array, Float32Array]]:
    """All vectors of a map: ids int64 ``[n]``, ascending, and float32 ``[n, d]``, `chunk` at a time.

    Each chunk is a transaction of its own, so a keyframe that is deleted meanwhile is left out. Raises CodecError.
    """
    ids = np.array(keyframe_ids(engine, map_id), np.int64)
    for start in range(0, len(ids), chunk):
        yield vectors_there(engine, ids[start : start + chunk])


def vectors_there(engine: Engine, ids: Int64Array) -> tuple[Int64Array, Float32Array]:
    """Vectors float32 ``[n, d]`` of those of `ids` that are there, and their ids, ascending. Raises CodecError."""
    wanted = np.unique(ids)
    rows = retry.read(engine, lambda connection: _rows(connection, wanted))
    rows.sort(key=lambda row: row[0])
    found = np.array([row[0] for row in rows], np.int64)
    return found, decode_vectors([row[1] for row in rows], "cnn_vectors of keyframe", found)


def _rows(connection: Connection, ids: Int64Array) -> list[tuple[int, bytes]]:
    if not len(ids):
        return []
    c = cnn_vectors.c
    query = select(c.keyframe_id, c.vector)
    first, last = int(ids[0]), int(ids[-1])
    if len(ids) >= DENSE * (last - first + 1):
        keys = set(ids.tolist())
        found = connection.execute(query.where(c.keyframe_id.between(first, last)))
        return [(row[0], row[1]) for row in found if row[0] in keys]
    return [
        (row[0], row[1])
        for keys in _in_chunks(ids.tolist())
        for row in connection.execute(query.where(c.keyframe_id.in_(keys)))
    ]


def _in_chunks(keys: Sequence[int]) -> Iterator[Sequence[int]]:
    for start in range(0, len(keys), IN_CHUNK):
        yield keys[start : start + IN_CHUNK]
