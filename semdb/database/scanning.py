"""Reading what a whole map holds, in chunks, as arrays: for what keeps a mirror of it."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial, reduce

import numpy as np
from sqlalchemy import BigInteger, Connection, Engine, Select, case, func, literal, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.class_score import MOST_OBJECTS, Part, word
from semdb.database import retry
from semdb.database.codecs import decode_vectors
from semdb.database.reading import keyframe_ids
from semdb.database.tables import categories, cnn_vectors, keyframe_categories, keyframes, maps, recordings
from semdb.types import Float32Array, Int64Array

IN_CHUNK = 500
FETCH = 50_000  # numbers at a time
IDS_IN_A_ROW = 48  # at most 20 bytes each: servers cut a joined text off at 1024 bytes, unless told otherwise
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
    return _decoded(retry.read(engine, lambda connection: _rows(connection, wanted)))


@dataclass(frozen=True, slots=True, eq=False)
class CoarseRows:
    """What the coarse step needs of some keyframes."""

    ids: Int64Array  # [n] ascending
    vectors: Float32Array  # [n, d]
    words: tuple[tuple[int, str, int], ...]  # keyframe, word (`semdb.class_score.word`), number, none of them 0


def coarse_rows(engine: Engine, ids: Int64Array) -> CoarseRows:
    """What is there of these keyframes, as of one moment. Raises CodecError."""
    wanted = np.unique(ids)

    def work(connection: Connection) -> tuple[list[tuple[int, bytes]], list[tuple[int, str, int]]]:
        c = keyframe_categories.c
        values = (c.count, c.upper_strength, c.lower_strength)
        query = select(c.keyframe_id, categories.c.name, *values).join(categories, categories.c.id == c.category_id)
        shown = [
            (int(key), word(str(name), part), int(number))
            for keys in _in_chunks(wanted.tolist())
            for key, name, *numbers in connection.execute(query.where(c.keyframe_id.in_(keys)))
            for part, number in zip(Part, numbers, strict=True)
            if number
        ]
        return _rows(connection, wanted), shown

    rows, shown = retry.read(engine, work)
    found, vectors = _decoded(rows)
    there = set(found.tolist())
    return CoarseRows(found, vectors, tuple(item for item in shown if item[0] in there))


def map_categories(engine: Engine, map_id: int) -> list[tuple[int, str]]:
    """Ids and names of the classes that keyframes of a map show, by id."""
    c = keyframe_categories.c
    shown = select(c.keyframe_id).where(c.map_id == map_id, c.category_id == categories.c.id).exists()
    query = select(categories.c.id, categories.c.name).where(shown).order_by(categories.c.id)
    return retry.read(engine, lambda connection: [(int(key), str(name)) for key, name in connection.execute(query)])


def category_columns(engine: Engine, map_id: int, category_id: int) -> tuple[Int64Array, dict[Part, Int64Array]]:
    """Keyframes of a map that show a class ``[n]``, ascending, and how many objects, and how strongly, each ``[n]``.

    More than `MOST_OBJECTS` count as so many. Read in several transactions.
    """
    c = keyframe_categories.c
    base = MOST_OBJECTS + 1
    packed = c.keyframe_id * base + _at_most(c.count)
    packed = (packed * base + _at_most(c.upper_strength)) * base + _at_most(c.lower_strength)
    query = select(packed.label("number")).where(c.map_id == map_id, c.category_id == category_id)
    query = query.order_by(c.keyframe_id).limit(FETCH)
    pieces = [np.empty(0, np.int64)]
    last = -1
    while True:
        numbers = retry.read(engine, partial(_numbers, query=query.where(c.keyframe_id > last), step=base**3))
        pieces.append(numbers)
        if len(numbers) < FETCH:
            break
        last = int(numbers[-1]) // base**3
    joined = np.concatenate(pieces)
    return joined // base**3, {
        Part.COUNT: joined // base**2 % base,
        Part.UPPER: joined // base % base,
        Part.LOWER: joined % base,
    }


def _numbers(connection: Connection, query: Select[tuple[int]], step: int) -> Int64Array:
    """The numbers of a query of one column, ascending; those of `IDS_IN_A_ROW` ids in a row come as one text.

    Drivers in Python take longer for a row than servers do for a hundred.
    """
    rows = query.subquery("packed").c
    width = literal(step * IDS_IN_A_ROW, BigInteger)
    texts = select(func.group_concat(rows.number)).group_by(rows.number - rows.number % width)
    found = ",".join(str(text) for text in connection.execute(texts).scalars())
    return np.sort(np.array(found.split(","), np.int64)) if found else np.empty(0, np.int64)


def _at_most(column: ColumnElement[int]) -> ColumnElement[int]:
    return case((column > MOST_OBJECTS, MOST_OBJECTS), else_=column)


@dataclass(frozen=True, slots=True)
class MapSums:
    """Sums over the rows of a map that a mirror of it must have too."""

    keyframes: int
    sum_of_ids: int
    words: int  # pairs of a keyframe and a word that it has
    numbers: int  # the sum of their numbers


def map_sums(engine: Engine, map_id: int) -> MapSums:
    """The sums over a map; more than `MOST_OBJECTS` of a class count as so many. Reads two indexes to the end."""
    c = keyframe_categories.c
    frames = select(func.count(), func.coalesce(func.sum(keyframes.c.id), 0))
    frames = frames.select_from(keyframes.join(recordings)).where(recordings.c.map_id == map_id)
    values = (c.count, c.upper_strength, c.lower_strength)
    there = reduce(operator.add, (case((value > 0, 1), else_=0) for value in values))
    numbers = reduce(operator.add, (_at_most(value) for value in values))
    shown = select(func.coalesce(func.sum(there), 0), func.coalesce(func.sum(numbers), 0)).where(c.map_id == map_id)

    def work(connection: Connection) -> MapSums:
        return MapSums(*map(int, [*connection.execute(frames).one(), *connection.execute(shown).one()]))

    return retry.read(engine, work)


def map_identity(engine: Engine, map_id: int) -> str:
    """A map's name and when it was made, to tell it from another one with the same id; empty where there is none."""
    query = select(maps.c.name, maps.c.created_at).where(maps.c.id == map_id)
    row = retry.read(engine, lambda connection: connection.execute(query).one_or_none())
    return "" if row is None else f"{row.name} {row.created_at}"


def _decoded(rows: list[tuple[int, bytes]]) -> tuple[Int64Array, Float32Array]:
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
