"""What `semdb refine` remembers of the computation of landmarks, so that only what changed is computed anew.

Rows are named after all that they were made from, and hold their own name, a checksum and arrays. One that is damaged,
cut off or of something else is no result: it is computed anew. Nothing else in the database refers to them, and they
may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import struct
import threading
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from isal import isal_zlib
from sqlalchemy import Connection, Engine, Select, delete, func, insert, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.sql.elements import ColumnElement

from semdb.database import checked, retry
from semdb.database.blobs import in_bulk
from semdb.database.landmark_tables import landmark_parts

MAGIC = b"SDBL"
_NOT_COMPRESSED = cast(type[Exception], isal_zlib.error)
_HEAD = struct.Struct("<4sIII")  # magic, checksum of the content, its length, length of the description
MOST_BYTES = 64 * 2**20  # of a part
READ, WRITE = 200, 32  # rows at a time
WRITE_BYTES = 2 * 2**20  # of rows of one statement
MOST_WAITING = 32 * 2**20  # bytes of large parts in memory
MOST_WRITTEN = 8 * 2**20  # bytes of a part: servers take no more in one statement, as they come
MOST_STORED = 4 * 2**30  # bytes of a map: nothing more is remembered then
Arrays = Mapping[str, npt.NDArray[Any]]


class LostPartError(Exception):
    """What was remembered of a keyframe is there in part: it is to be computed from nothing."""


def forget_parts(engine: Engine, map_id: int) -> None:
    """Everything of a map is computed anew the next time."""
    c = landmark_parts.c

    def work(connection: Connection) -> bool:
        query = select(c.kind, c.name).where(c.map_id == map_id).order_by(c.kind, c.name).limit(READ)
        there = [(str(kind), str(name)) for kind, name in connection.execute(query)]
        for kind in sorted({kind for kind, _ in there}):
            names = [name for own, name in there if own == kind]
            connection.execute(delete(landmark_parts).where(c.map_id == map_id, c.kind == kind, c.name.in_(names)))
        return bool(there)

    while retry.write(engine, work):
        pass


def pack(kind: str, name: str, arrays: Arrays) -> bytes:
    """Arrays as a blob that knows its name."""
    listed = [[key, array.dtype.str, list(array.shape)] for key, array in arrays.items()]
    described = json.dumps([kind, name, listed]).encode()
    content = described + b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())
    head = _HEAD.pack(MAGIC, isal_zlib.crc32(content, len(described)), len(content), len(described))
    return head + isal_zlib.compress(content, 1)


def unpack(kind: str, name: str, data: object) -> dict[str, npt.NDArray[Any]] | None:
    """The arrays of a blob of `pack`; None for anything else."""
    if not isinstance(data, bytes) or len(data) < _HEAD.size:
        return None
    magic, checksum, length, described = _HEAD.unpack_from(data)
    if magic != MAGIC or not 0 < described <= length <= MOST_BYTES:
        return None
    reader = isal_zlib.decompressobj()
    try:
        content = reader.decompress(data[_HEAD.size :], length)
    except _NOT_COMPRESSED:
        return None
    if len(content) != length or isal_zlib.crc32(content, described) != checksum:
        return None
    found_kind, found_name, listed = json.loads(content[:described])
    if (found_kind, found_name) != (kind, name):
        return None
    found, start = {}, described
    for key, dtype, shape in listed:
        number = math.prod(shape)
        # a copy, so that it lies where kernels want it, and may be written
        found[key] = np.frombuffer(content, np.dtype(dtype), number, start).reshape(shape).copy()
        start += found[key].nbytes
    return found


class LandmarkParts:
    """The parts of a map, for one computation (`semdb.landmarks.memo.Memo`). Threads may share it.

    What all keyframes or landmarks ask for is read when one of its kind is first asked for, all in one go; large ones
    (`LARGE`), and what few ask for (`FEW`), one by one.
    """

    LARGE = ("grid",)
    FEW = ("points", "noise", "box", "visit")  # of what a landmark is made: of one that changed
    FIRST = ("lift", *LARGE)  # of a keyframe, of no use one without the other: stored before the others

    def __init__(self, engine: Engine, map_id: int, revision: int, *, empty: bool = False) -> None:
        """`revision` of the computation: what another one made is nothing. `empty`: nothing that is stored is read."""
        self._revision = revision
        self._engine, self._map_id, self._empty = engine, map_id, empty
        self._known: dict[str, dict[str, Arrays]] = {}
        self._large: dict[str, set[str]] = {}  # names of what is stored, by kind, of what is read one by one
        self._used: set[tuple[str, str]] = set()
        self._new: dict[tuple[str, str], bytes] = {}
        self._waiting = 0  # bytes of large ones that are not stored
        self._lock = threading.Lock()

    def get(self, kind: str, name: str) -> Arrays | None:
        """What was put under a name, now or in a computation before; None where there is nothing."""
        name = self._named(name)
        with self._lock:
            self._used.add((kind, name))
            if (kind, name) in self._new:
                return unpack(kind, name, self._new[kind, name])
            if self._empty:
                return None
            if kind not in self.LARGE + self.FEW:
                if kind not in self._known:
                    self._known[kind] = self._read(kind)
                return self._known[kind].get(name)
        if not self._is_stored(kind, name):
            return None
        c = landmark_parts.c
        query = select(checked.up_to(c.data, MOST_BYTES)).where(self._mine, c.kind == kind, c.name == name)
        return unpack(kind, name, retry.read(self._engine, lambda connection: connection.execute(query).scalar()))

    def has(self, kind: str, name: str) -> bool:
        """Whether one that is read alone is stored under a name; it is not read."""
        return self._is_stored(kind, self._named(name))

    def _is_stored(self, kind: str, name: str) -> bool:
        c = landmark_parts.c
        with self._lock:
            if kind not in self._large and not self._empty:
                query = select(c.name).where(self._mine, c.kind == kind)
                rows = retry.read(self._engine, functools.partial(_rows, query=query))
                self._large[kind] = {str(row[0]) for row in rows}
            return name in self._large.get(kind, ())

    def keep(self, kind: str, name: str) -> None:
        """What is stored under a name stays, whether or not it is asked for."""
        name = self._named(name)
        with self._lock:
            self._used.add((kind, name))

    def put(self, kind: str, name: str, arrays: Arrays) -> None:
        """Remembers arrays; they are stored by `save`, large ones, and what belongs to them, before."""
        name = self._named(name)
        data = pack(kind, name, arrays)
        with self._lock:
            self._used.add((kind, name))
            self._new[kind, name] = data
            if kind in self._large:
                self._large[kind].add(name)
            self._waiting += len(data) if kind in self.LARGE else 0
            first = {key: self._new.pop(key) for key in list(self._new) if key[0] in self.FIRST and self._is_full}
            self._waiting = 0 if first else self._waiting
        if first:
            self._write(first)

    def save(self) -> None:
        """Stores what is new, as far as there is room for it, and deletes what this computation did not ask for."""
        c = landmark_parts.c
        query = select(c.kind, c.name).where(self._mine)
        there = {(str(kind), str(name)) for kind, name in retry.read(self._engine, lambda one: _rows(one, query))}
        for kind in sorted({kind for kind, _ in there}):
            gone = sorted(name for own, name in there - self._used if own == kind)
            for start in range(0, len(gone), READ):
                some = (self._mine, c.kind == kind, c.name.in_(gone[start : start + READ]))
                retry.write(self._engine, functools.partial(_delete, some=some))
        with self._lock:
            new, self._new = self._new, {}
        self._write(new)

    @property
    def _is_full(self) -> bool:
        return self._waiting > MOST_WAITING

    def _write(self, new: Mapping[tuple[str, str], bytes]) -> None:
        """Stores rows, in transactions of bounded size; of two that store the same at once one is enough."""
        c = landmark_parts.c
        used = retry.read(self._engine, lambda one: one.execute(select(func.sum(c.size)).where(self._mine)).scalar())
        room, rows = MOST_STORED - int(used or 0), []
        for (kind, name), data in sorted(new.items()):
            room -= len(data)
            if room >= 0 and len(data) <= MOST_WRITTEN:
                rows.append({"map_id": self._map_id, "kind": kind, "name": name, "size": len(data), "data": data})
        while rows:
            ends = np.cumsum([row["size"] for row in rows[:WRITE]])
            some = max(1, int(np.searchsorted(ends, WRITE_BYTES)))
            with contextlib.suppress(IntegrityError):
                retry.write(self._engine, functools.partial(_replace, rows=rows[:some]))
            rows = rows[some:]

    def _named(self, name: str) -> str:
        return f"{self._revision}.{name}"

    @property
    def _mine(self) -> Any:
        return landmark_parts.c.map_id == self._map_id

    def _read(self, kind: str) -> dict[str, Arrays]:
        c, last = landmark_parts.c, ""
        found: dict[str, Arrays] = {}
        while True:
            query = select(c.name, checked.up_to(c.data, MOST_BYTES)).where(self._mine, c.kind == kind, c.name > last)
            rows = retry.read(self._engine, functools.partial(_rows, query=query.order_by(c.name).limit(READ)))
            for name, data in rows:
                arrays = unpack(kind, str(name), data)
                if arrays is not None:
                    found[str(name)] = arrays
            if len(rows) < READ:
                return found
            last = str(rows[-1][0])


def _rows(connection: Connection, query: Select[Any]) -> list[Any]:
    with in_bulk(connection):
        return list(connection.execute(query))


def _delete(connection: Connection, some: Sequence[ColumnElement[bool]]) -> None:
    connection.execute(delete(landmark_parts).where(*some))


def _replace(connection: Connection, rows: Sequence[Mapping[str, Any]]) -> None:
    c = landmark_parts.c
    for row in rows:
        same = (c.map_id == row["map_id"], c.kind == row["kind"], c.name == row["name"])
        connection.execute(delete(landmark_parts).where(*same))
    connection.execute(insert(landmark_parts), list(rows))
