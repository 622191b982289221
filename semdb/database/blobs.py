"""Sending blobs to a server as they are, and reading many of them, over PyMySQL's connection.

PyMySQL writes all values into the text of the statement, blobs in hexadecimal; reading that text took MariaDB 60 % of
its time in an ingest, and text with escapes took it longer still. The binary protocol (MySQL's manual: COM_STMT_PREPARE
and COM_STMT_EXECUTE) has nothing to read. It is used for an INSERT with a blob among its values and for nothing
else, so that no result in binary has to be understood.

PyMySQL reads each row in two or three calls and makes objects of each; within `in_bulk` what a socket holds is read at
once, and rows are taken out of it, or stay where they were read (`semdb.database.packed`).
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymysql import err
from pymysql.connections import MySQLResult
from pymysql.constants import COMMAND, CR, SERVER_STATUS
from pymysql.cursors import Cursor
from sqlalchemy import Connection

from semdb.database.packed import Numbers, PackedRows

KEPT = 32  # prepared statements of a connection; semdb has fewer that carry blobs
_PREPARE, _EXECUTE = 0x16, 0x17
_STATEMENT_OVERHEAD = 16  # bytes of a packet beside its statement, and to spare
_BLOBS = (bytes, bytearray)
_PLACEHOLDER = re.compile(r"%\(([^)]+)\)s|%s|%%")
_DOUBLE, _NULL, _LONGLONG, _BLOB, _STRING = (struct.pack("<H", code) for code in (5, 6, 8, 252, 253))


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A statement that the server knows, and the names of its parameters in order (positions for a sequence)."""

    number: int
    names: tuple[str | int, ...]


class BlobCursor(Cursor):  # type: ignore[misc]
    """PyMySQL's cursor, but for an INSERT of one row with a blob among its values."""

    def execute(self, query: Any, args: Any = None) -> Any:
        """As PyMySQL's: `args` is a mapping for ``%(name)s``, a sequence for ``%s``, or None. Returns the row count."""
        values = args.values() if isinstance(args, Mapping) else args
        if (
            isinstance(query, str)
            and values
            and any(isinstance(value, _BLOBS) for value in values)
            and query[:6].upper() == "INSERT"
            and all(value is None or isinstance(value, (str, int, float, *_BLOBS)) for value in values)
        ):
            return self._execute_prepared(query, args)
        return super().execute(query, args)

    def executemany(self, query: Any, args: Any) -> Any:
        """As PyMySQL's, which joins rows to statements of a megabyte; to no more than this server takes."""
        limit = getattr(self._get_db(), "semdb_packet", Cursor.max_stmt_length)
        self.max_stmt_length = min(Cursor.max_stmt_length, limit - _STATEMENT_OVERHEAD)
        return super().executemany(query, args)

    def _query(self, query: Any) -> int:
        connection = self._get_db()
        if not getattr(connection, "semdb_in_bulk", False):
            return int(super()._query(query))
        into = connection.semdb_packed
        self._clear_result()
        connection._execute_command(COMMAND.COM_QUERY, query.encode(connection.encoding))
        connection._result = None
        result = _BulkResult(connection, into)
        result.read()
        connection._result = result
        if result.server_status is not None:
            connection.server_status = result.server_status
        connection._affected_rows = result.affected_rows
        self._do_get_result()
        return int(self.rowcount)

    def _execute_prepared(self, query: str, args: Mapping[str, Any] | Sequence[Any]) -> int:
        while self.nextset():
            pass
        connection = self._get_db()
        known: dict[str, _Prepared] = connection.__dict__.setdefault("_semdb_prepared", {})
        if query not in known:
            if len(known) >= KEPT:
                return int(super().execute(query, args))
            known[query] = _prepare(connection, query)
        prepared = known[query]
        self._clear_result()
        connection._execute_command(_EXECUTE, _message(prepared, [args[name] for name in prepared.names]))  # type: ignore[index]
        connection._affected_rows = connection._read_query_result()
        self._executed = query
        self._do_get_result()
        return int(self.rowcount)


def _prepare(connection: Any, query: str) -> _Prepared:
    names: list[str | int] = []

    def mark(found: re.Match[str]) -> str:
        if found.group() == "%%":
            return "%"
        names.append(found.group(1) or len(names))
        return "?"

    connection._execute_command(_PREPARE, _PLACEHOLDER.sub(mark, query))
    answer = connection._read_packet().get_all_data()
    number, columns, parameters = struct.unpack_from("<IHH", answer, 1)
    for count in (parameters, columns):
        for _ in range(count + 1 if count else 0):  # definitions, and the packet that ends them
            connection._read_packet()
    return _Prepared(number, tuple(names))


def _message(prepared: _Prepared, values: Sequence[Any]) -> bytes:
    """What follows the command byte of COM_STMT_EXECUTE: number, flags, one iteration, NULLs, types, values."""
    nulls = bytearray((len(values) + 7) // 8)
    kinds: list[bytes] = []
    data: list[bytes] = []
    for position, value in enumerate(values):
        if value is None:
            nulls[position // 8] |= 1 << (position % 8)
            kinds.append(_NULL)
        elif isinstance(value, int):
            kinds.append(_LONGLONG)
            data.append(struct.pack("<q", value))
        elif isinstance(value, float):
            kinds.append(_DOUBLE)
            data.append(struct.pack("<d", value))
        else:
            kinds.append(_BLOB if isinstance(value, _BLOBS) else _STRING)
            text = bytes(value) if isinstance(value, _BLOBS) else value.encode()
            data += [_length(len(text)), text]
    return b"".join((struct.pack("<IBI", prepared.number, 0, 1), nulls, b"\1", *kinds, *data))


def _length(size: int) -> bytes:
    """A length-encoded integer."""
    if size < 251:
        return struct.pack("<B", size)
    if size < 1 << 16:
        return b"\xfc" + struct.pack("<H", size)
    if size < 1 << 24:
        return b"\xfd" + struct.pack("<I", size)[:3]
    return b"\xfe" + struct.pack("<Q", size)


@contextlib.contextmanager
def in_bulk(connection: Connection, into: PackedRows | Numbers | None = None) -> Iterator[None]:
    """Results of many rows are read faster meanwhile, where the driver is PyMySQL.

    Rows of a whole number and a blob, or of one whole number, go into `into`, and are not in the result.
    """
    driver = connection.connection.driver_connection
    if connection.dialect.name == "sqlite" or driver is None:
        yield
        return
    driver.semdb_in_bulk, driver.semdb_packed = True, into
    try:
        yield
    finally:
        driver.semdb_in_bulk, driver.semdb_packed = False, None


class _BulkResult(MySQLResult):  # type: ignore[misc]
    """A result whose rows are read as many at a time as there are; they are those of PyMySQL."""

    connection: Any
    converters: Any

    def __init__(self, connection: Any, into: PackedRows | Numbers | None = None) -> None:
        super().__init__(connection)
        self._into = into

    def _read_rowdata_packet(self) -> None:
        rows = _Rows(self.connection, self.converters, self._into)
        try:
            while not rows.ended:
                rows.take()
                rows.receive()
        except BaseException:
            if not rows.ended:  # what else is on its way would be taken for the answer to the next statement
                self.connection._force_close()
            raise
        self.warning_count, self.has_next = rows.warnings, rows.has_next
        self.connection = None
        self.affected_rows, self.rows = len(rows.found), tuple(rows.found)


_HEAD = 4  # bytes before each packet: its size and its number
_EOF, _ERROR, _NONE = 0xFE, 0xFF, 0xFB
_LONGEST_EOF = 9
_LOST = "Lost connection to MySQL server during query"
_NONSENSE = "the server sent what is no row"
_SOME = 1 << 20  # bytes that are read at once
_LEAST_NUMBER = 6  # bytes of a packet of one
_LEAST = 1 << 16  # bytes that there is room for when more is waited for
_WHOLE = 0xFFFFFF  # a packet of so many bytes goes on in the next


def _row(packet: memoryview, encodings: Sequence[str | None], converters: Sequence[Any]) -> tuple[Any, ...]:
    values: list[Any] = []
    at = 0
    for encoding, converter in zip(encodings, converters, strict=True):
        size = packet[at]
        at += 1
        if size == _NONE:
            values.append(None)
            continue
        if size > _NONE:
            wide = 2 if size == 0xFC else 3 if size == 0xFD else 8
            size = int.from_bytes(packet[at : at + wide], "little")
            at += wide
        value: Any = packet[at : at + size].tobytes()
        at += size
        if encoding is not None:
            value = value.decode(encoding)
        values.append(value if converter is None else converter(value))
    if at != len(packet):
        raise ValueError
    return tuple(values)


class _Rows:
    """The rows of a result while they are read."""

    def __init__(
        self,
        connection: Any,
        converters: Sequence[tuple[str | None, Any]],
        into: PackedRows | Numbers | None = None,
    ) -> None:
        self.found: list[tuple[Any, ...]] = []
        self.ended = self.has_next = False
        self.warnings = 0
        self._connection = connection
        self._encodings, self._converters = [e for e, _ in converters], [c for _, c in converters]
        self._numbers_and_blobs = [c for _, c in converters] == [int, None] and converters[1][0] is None
        self._table = np.empty((256, 3), np.int64)
        self._numbers = into if isinstance(into, Numbers) and self._converters == [int] else None
        self._into = into if isinstance(into, PackedRows) and self._numbers_and_blobs else None
        if self._into is not None:
            self._into.reserve(_SOME)
        self._data = np.empty(_SOME, np.uint8) if self._into is None else self._into.data
        self._view = self._data.data
        self._start = self._stop = 0 if self._into is None else self._into.used
        self._stop += _received(connection, self._view[self._stop :], first=True)  # what is there
        if self._into is not None:
            self._into.used = self._stop
        self._parts = b""  # of a packet that is more than one

    def take(self) -> None:
        """Takes the rows out of what is there."""
        while not self.ended:
            if self._numbers is not None:
                self._take_numbers(self._numbers)
            elif self._numbers_and_blobs and not self._parts:
                self._take_many()
            size = self._next_size()
            end = self._start + _HEAD + size
            if size < 0 or end > self._stop:
                return
            self._count(1, self._view[self._start + 3])
            packet, self._start = self._view[self._start + _HEAD : end], end
            if size == _WHOLE:
                self._parts += packet
            else:
                self._take_packet(memoryview(self._parts + packet) if self._parts else packet)
                self._parts = b""

    def receive(self) -> None:
        """Waits for more, if more is to come; what is left of before comes first."""
        if self.ended:
            return
        needed = _HEAD + max(0, self._next_size())
        if self._into is not None:
            self._receive_behind(self._into, needed)
            return
        rest = self._data[self._start : self._stop]
        if needed > len(self._data):
            self._data = np.empty(needed + _SOME, np.uint8)
            self._view = self._data.data
        self._data[: len(rest)] = rest
        self._start, self._stop = 0, len(rest)
        self._stop += _received(self._connection, self._view[self._stop :])

    def _receive_behind(self, into: PackedRows, needed: int) -> None:
        """Waits for more, which comes behind all that was received before."""
        into.used = self._stop
        into.reserve(max(needed, _LEAST))
        self._data, self._view = into.data, into.data.data
        self._stop += _received(self._connection, self._view[self._stop :])
        into.used = self._stop

    def _next_size(self) -> int:
        """Bytes of the next packet; -1 where that is not known yet."""
        start = self._start
        return int.from_bytes(self._view[start : start + 3], "little") if self._stop - start >= _HEAD else -1

    def _count(self, packets: int, first: int) -> None:
        if first != self._connection._next_seq_id:
            if first == 0:  # MariaDB's farewell when it shuts down
                raise err.OperationalError(CR.CR_SERVER_LOST, _LOST)
            raise err.InternalError("packets of the server come in another order than they were sent in")
        self._connection._next_seq_id = (first + packets) % 256

    def _take_many(self) -> None:
        from semdb.database._packets import split_rows

        count = len(self._table)
        while count == len(self._table):
            number = self._connection._next_seq_id
            count, self._start = split_rows(self._data, self._start, self._stop, number, self._table)  # type: ignore[no-untyped-call]
            self._count(count, number)
            if self._into is not None:
                self._into.add_table(self._table[:count])
                continue
            view = self._view
            self.found += [(key, view[at:end].tobytes()) for key, at, end in self._table[:count].tolist()]

    def _take_numbers(self, into: Numbers) -> None:
        from semdb.database._packets import split_numbers

        room = np.empty((self._stop - self._start) // _LEAST_NUMBER + 1, np.int64)
        number = self._connection._next_seq_id
        count, self._start = split_numbers(self._data, self._start, self._stop, number, room)  # type: ignore[no-untyped-call]
        if count:
            self._count(count, number)
            into.add_many(room[:count])

    def _take_packet(self, packet: memoryview) -> None:
        if not packet:
            raise err.InternalError(_NONSENSE)
        if packet[0] == _EOF and len(packet) < _LONGEST_EOF:
            self.ended = True
            self.warnings, status = struct.unpack_from("<HH", packet, 1)
            self.has_next = bool(status & SERVER_STATUS.SERVER_MORE_RESULTS_EXISTS)
            return
        if packet[0] == _ERROR:
            self.ended = True
            err.raise_mysql_exception(bytes(packet))
        try:
            self.found.append(_row(packet, self._encodings, self._converters))
        except (IndexError, ValueError):
            raise err.InternalError(_NONSENSE) from None


def _received(connection: Any, room: memoryview, *, first: bool = False) -> int:
    """How many bytes came, of as many as there is room for. Raises what PyMySQL raises of a lost connection.

    What the driver has read ahead comes `first`; from then on its buffer is passed by.
    """
    reason = ""
    try:
        ahead = connection._rfile.read1(len(connection._rfile.peek())) if first else b""
        room[: len(ahead)] = ahead
        count = len(ahead) or int(connection._rfile.raw.readinto(room))
    except OSError as error:
        count, reason = 0, f" ({error})"
    except BaseException:
        connection._force_close()
        raise
    if count:
        return count
    connection._force_close()
    raise err.OperationalError(CR.CR_SERVER_LOST, _LOST + reason)
