"""Sending blobs to a server as they are: prepared statements over PyMySQL's connection.

PyMySQL writes all values into the text of the statement, blobs in hexadecimal; reading that text took MariaDB 60 % of
its time in an ingest, and text with escapes took it longer still. The binary protocol (MySQL's manual: COM_STMT_PREPARE
and COM_STMT_EXECUTE) has nothing to read. It is used for an INSERT with a blob among its values and for nothing
else, so that no result in binary has to be understood.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pymysql.cursors import Cursor

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
