"""Reading what a whole map holds, in chunks, as arrays: for what keeps a mirror of it."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

import numpy as np
from sqlalchemy import BigInteger, Connection, Engine, Select, and_, case, cast, func, literal, not_, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.class_score import MOST_OBJECTS, Part, word
from semdb.database import checked, retry
from semdb.database.blobs import in_bulk
from semdb.database.class_filter import classes_of_keyframes
from semdb.database.codecs import decode_packed, decode_vectors
from semdb.database.exact_sums import exact_sum, whole
from semdb.database.packed import Numbers, PackedRows
from semdb.database.reading import Bad, by_own_encoder, encoder_id
from semdb.database.tables import categories, cnn_vectors, keyframe_categories, keyframes, maps, recordings
from semdb.errors import CodecError
from semdb.threads import ahead
from semdb.types import Float32Array, Int64Array

IN_CHUNK = 500
CHUNK = 2000  # vectors at a time
FETCH = 50_000  # numbers at a time
IDS_IN_A_ROW = 1000
_LARGEST_ID = 2**63 // (MOST_OBJECTS + 1) ** 3 - 1  # that is packed with three numbers
DENSE = 0.5  # of the ids of a range that are wanted: from here on the range is read, not a list of ids


def iter_vectors(
    engine: Engine,
    map_id: int,
    chunk: int = CHUNK,
    size: int | None = None,
    bad: Bad | None = None,
    *,
    in_turn: bool = False,
) -> Iterator[tuple[Int64Array, Float32Array]]:
    """All vectors of a map: ids int64 ``[n]``, ascending, and float32 ``[n, d]``, `chunk` at a time.

    Each chunk is a transaction of its own, so a keyframe that is deleted meanwhile is left out. `size` and `bad` as in
    `vectors_there`; without `size` it is that of the first chunk. All are by the encoder that the map has at first.
    `in_turn`: vectors are asked for one chunk after the other, and their memory is that of the chunk before.
    """
    ids = _map_ids(engine, map_id)
    encoder = retry.read(engine, lambda connection: encoder_id(connection, map_id))
    starts = range(0, len(ids), chunk)
    packs = itertools.cycle((PackedRows(), PackedRows()))  # one is looked at while the other is filled
    fetched = (_fetched(engine, ids[start : start + chunk], encoder, next(packs)) for start in starts)
    room: Float32Array | None = None
    for rows, without in ahead(fetched):
        _tell_missing(without, bad)
        found, vectors = _decoded(rows, size, bad, room)
        size = vectors.shape[1] if len(found) else size
        room = vectors if in_turn and (room is None or len(vectors) > len(room)) else room
        yield found, vectors


def _map_ids(engine: Engine, map_id: int) -> Int64Array:
    """The keyframes of a map ``[n]``, ascending; in several transactions."""
    k = keyframes.c
    query = select(k.id.label("number")).join(recordings, recordings.c.id == k.recording_id)
    query = query.where(recordings.c.map_id == map_id).order_by(k.id).limit(FETCH)
    pieces, last = [np.empty(0, np.int64)], -(2**63)
    while True:
        numbers = retry.read(engine, partial(_numbers, query=query.where(k.id > last), step=1))
        pieces.append(numbers)
        if len(numbers) < FETCH:
            return np.concatenate(pieces)
        last = int(numbers[-1])


def _fetched(engine: Engine, ids: Int64Array, encoder: int | None, rows: PackedRows) -> tuple[PackedRows, list[int]]:
    """In `rows` those of `ids` (ascending) that are there, and those without one."""

    def work(connection: Connection) -> tuple[PackedRows, list[int]]:
        rows.clear()
        _read_rows(connection, ids, encoder, rows)
        return rows, _without_row(connection, ids, rows)

    return retry.read(engine, work)


def vectors_there(
    engine: Engine, ids: Int64Array, size: int | None = None, bad: Bad | None = None, encoder: int | None = None
) -> tuple[Int64Array, Float32Array]:
    """Vectors float32 ``[n, d]`` of those of `ids` that are there, and their ids, ascending.

    They are by the model `encoder`, without it by the encoders of their maps.

    `size` is how many numbers they have to have, by default as many as most have. A damaged one is zero and told to
    `bad`, or raises CodecError; so is a keyframe that has none, which is left out.
    """
    rows, without = _fetched(engine, np.unique(ids), encoder, PackedRows())
    _tell_missing(without, bad)
    return _decoded(rows, size, bad)


@dataclass(frozen=True, slots=True, eq=False)
class CoarseRows:
    """What the coarse step needs of some keyframes."""

    ids: Int64Array  # [n] ascending
    vectors: Float32Array  # [n, d]
    words: tuple[tuple[int, str, int], ...]  # keyframe, word (`semdb.class_score.word`), number, none of them 0


def coarse_rows(
    engine: Engine,
    map_id: int,
    ids: Int64Array,
    size: int | None = None,
    bad: Bad | None = None,
    completed: bool = False,
) -> CoarseRows:
    """What is there of these keyframes in the map, as of one moment; `size` and `bad` as in `vectors_there`.

    One that was moved into another map is not there. `completed`: their classes as landmarks complete them.
    """

    def work(connection: Connection) -> tuple[PackedRows, list[int], list[tuple[int, str, int]]]:
        k = keyframes.c
        mine = select(k.id).join(recordings, recordings.c.id == k.recording_id).where(recordings.c.map_id == map_id)
        asked = np.unique(ids).tolist()
        here = [key for keys in _in_chunks(asked) for key in connection.execute(mine.where(k.id.in_(keys))).scalars()]
        wanted = np.array(sorted(here), np.int64)
        c = classes_of_keyframes(completed).c
        own = [c.map_id == map_id] if completed else []  # rows of before it was moved into this map
        values = (c.count, c.upper_strength, c.lower_strength)
        query = select(c.keyframe_id, categories.c.name, *values).join(categories, categories.c.id == c.category_id)
        shown = [
            (int(key), word(str(name), part), number)
            for keys in _in_chunks(wanted.tolist())
            for key, name, *numbers in connection.execute(query.where(c.keyframe_id.in_(keys), *own))
            for part, number in zip(Part, map(_held, numbers), strict=True)
            if number
        ]
        rows = PackedRows()
        _read_rows(connection, wanted, encoder_id(connection, map_id), rows)
        return rows, _without_row(connection, wanted, rows), shown

    rows, without, shown = retry.read(engine, work)
    _tell_missing(without, bad)
    found, vectors = _decoded(rows, size, bad)
    there = set(found.tolist())
    return CoarseRows(found, vectors, tuple(item for item in shown if item[0] in there))


def map_categories(engine: Engine, map_id: int) -> list[tuple[int, str]]:
    """Ids and names of the classes that keyframes of a map show, by id; landmarks complete them by no other class."""
    c = keyframe_categories.c
    shown = select(c.keyframe_id).where(c.map_id == map_id, c.category_id == categories.c.id).exists()
    query = select(categories.c.id, categories.c.name).where(shown).order_by(categories.c.id)
    return retry.read(engine, lambda connection: [(int(key), str(name)) for key, name in connection.execute(query)])


def category_columns(
    engine: Engine, map_id: int, category_id: int, completed: bool = False
) -> tuple[Int64Array, dict[Part, Int64Array]]:
    """Keyframes of a map that show a class ``[n]``, ascending, and how many objects, and how strongly, each ``[n]``.

    More than `MOST_OBJECTS` count as so many. `completed`: as landmarks complete them. Read in several transactions.
    """
    c = classes_of_keyframes(completed).c
    base = MOST_OBJECTS + 1
    packed = c.keyframe_id * base + _at_most(c.count)
    packed = (packed * base + _at_most(c.upper_strength)) * base + _at_most(c.lower_strength)
    query = select(packed.label("number")).where(c.map_id == map_id, c.category_id == category_id)
    query = query.where(c.keyframe_id.between(0, _LARGEST_ID))
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
    """The numbers of a query of one column, ascending.

    Python takes longer for a row than databases do for a hundred: those of `IDS_IN_A_ROW` ids in a row come as one
    text of SQLite, and as they are in what a server sends.
    """
    if connection.dialect.name != "sqlite":
        numbers = Numbers()
        with in_bulk(connection, numbers), connection.execute(query) as result:
            numbers.add_many(np.array([row[0] for row in result.cursor.fetchall()], np.int64))
        return np.sort(numbers.all())
    rows = query.subquery("packed").c
    width = literal(step * IDS_IN_A_ROW, BigInteger)
    texts = select(func.group_concat(rows.number)).group_by(rows.number - rows.number % width)
    found = ",".join(str(text) for text in connection.execute(texts).scalars())
    return np.sort(np.array(found.split(","), np.int64)) if found else np.empty(0, np.int64)


def _at_most(column: ColumnElement[int]) -> ColumnElement[int]:
    """A number of objects, or a strength, as a mirror has it; 0 for what SQLite may have there that is none."""
    return case(
        (column.between(1, MOST_OBJECTS), cast(column, BigInteger)),
        (column.between(MOST_OBJECTS, checked.LARGEST), MOST_OBJECTS),
        else_=0,
    )


def _held(value: Any) -> int:
    """As `_at_most`, of one value; larger ones stay."""
    number = isinstance(value, int | float) and 1 <= value <= checked.LARGEST
    return int(value) if number else 0


def class_rows_that_are_none(engine: Engine, map_id: int, most: int) -> list[int]:
    """Up to `most` keyframes of a map whose objects per class are no numbers, and count as none; on SQLite alone.

    Servers keep only numbers there.
    """
    if engine.dialect.name != "sqlite":
        return []
    c = keyframe_categories.c
    values = (c.count, c.upper_strength, c.lower_strength)
    whole_number = and_(*(and_(func.typeof(value) == "integer", value.between(0, checked.LARGEST)) for value in values))
    query = select(c.keyframe_id).where(c.map_id == map_id, not_(whole_number)).distinct().limit(most)
    return [int(key) for key in retry.read(engine, lambda connection: list(connection.execute(query).scalars()))]


@dataclass(frozen=True, slots=True)
class MapSums:
    """Sums over the rows of a map that a mirror of it must have too."""

    keyframes: int
    sum_of_ids: int
    words: int  # pairs of a keyframe and a word that it has
    numbers: int  # the sum of their numbers


def map_sums(engine: Engine, map_id: int, completed: bool = False) -> MapSums:
    """The sums over a map; more than `MOST_OBJECTS` of a class count as so many. Reads two indexes to the end.

    `completed`: of the classes that landmarks complete.
    """
    c = classes_of_keyframes(completed).c
    frames = select(func.count(), *exact_sum(engine, keyframes.c.id))
    frames = frames.select_from(keyframes.join(recordings)).where(recordings.c.map_id == map_id)
    values = (c.count, c.upper_strength, c.lower_strength)
    there = reduce(operator.add, (case((value.between(1, checked.LARGEST), 1), else_=0) for value in values))
    numbers = reduce(operator.add, (_at_most(value) for value in values))
    shown = select(func.coalesce(func.sum(there), 0), func.coalesce(func.sum(numbers), 0)).where(c.map_id == map_id)

    def work(connection: Connection) -> MapSums:
        number, *ids = connection.execute(frames).one()
        return MapSums(int(number), whole(ids), *map(int, connection.execute(shown).one()))

    return retry.read(engine, work)


def map_identity(engine: Engine, map_id: int) -> str:
    """A map's name and when it was made, to tell it from another one with the same id; empty where there is none."""
    query = select(maps.c.name, maps.c.created_at).where(maps.c.id == map_id)
    row = retry.read(engine, lambda connection: connection.execute(query).one_or_none())
    return "" if row is None else f"{row.name} {row.created_at}"


def _decoded(
    rows: PackedRows, size: int | None, bad: Bad | None, room: Float32Array | None = None
) -> tuple[Int64Array, Float32Array]:
    table = rows.table()
    if not rows.others and (vectors := decode_packed(rows.data, table, size, room)) is not None:
        return table[:, 0].copy(), vectors
    single = rows.rows()
    found = np.array([row[0] for row in single], np.int64)
    return found, decode_vectors([row[1] for row in single], found, size, bad)


def _read_rows(connection: Connection, ids: Int64Array, encoder: int | None, into: PackedRows) -> None:
    if not len(ids):
        return
    c = cnn_vectors.c
    query = select(c.keyframe_id, checked.up_to(c.vector, checked.MOST_VECTOR))
    query = query.where(by_own_encoder() if encoder is None else c.model_id == encoder)
    first, last = int(ids[0]), int(ids[-1])
    dense = len(ids) >= DENSE * (last - first + 1)
    wanted = [c.keyframe_id.between(first, last)] if dense else map(c.keyframe_id.in_, _in_chunks(ids.tolist()))
    for some in wanted:
        with in_bulk(connection, into), connection.execute(query.where(some)) as result:
            # SQLite reads as rows are asked for, and may fail then; a driver of servers has all of them, as plain
            # tuples: nothing is to be made of their values
            for row in result if connection.dialect.name == "sqlite" else result.cursor.fetchall():
                into.add(row[0], row[1])
    if dense:
        into.keep(ids)


def _without_row(connection: Connection, ids: Int64Array, rows: PackedRows) -> list[int]:
    """Those of `ids` that are there, but not in `rows`: others were deleted a moment ago."""
    if len(rows) == len(ids):
        return []
    lacking = sorted(set(ids.tolist()) - rows.keys())
    query = select(keyframes.c.id)
    return [
        key
        for keys in _in_chunks(lacking)
        for key in connection.execute(query.where(keyframes.c.id.in_(keys))).scalars()
    ]


def _tell_missing(keys: Sequence[int], bad: Bad | None) -> None:
    for key in keys:
        error = CodecError(f"cnn_vectors has no row of keyframe {key}")
        if bad is None:
            raise error
        bad(key, error)


def _in_chunks(keys: Sequence[int]) -> Iterator[Sequence[int]]:
    for start in range(0, len(keys), IN_CHUNK):
        yield keys[start : start + IN_CHUNK]
