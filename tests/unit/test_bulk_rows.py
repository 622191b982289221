"""Results that are read in bulk: the rows are those of PyMySQL, however the server's bytes come."""

from __future__ import annotations

import io
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymysql import err

from semdb.database import blobs
from semdb.database.packed import Numbers, PackedRows
from semdb.threads import ahead

Row = tuple[bytes | None, ...]
SIZES = (0, 1, 250, 251, 252, 300, 65_535, 65_536, 200_000)


class Wire(io.RawIOBase):
    """Bytes that come in pieces of these sizes, and then as many as are asked for; a socket would wait at the end."""

    def __init__(self, data: bytes, pieces: list[int]) -> None:
        self._data, self._pieces = memoryview(data), pieces

    def readable(self) -> bool:
        return True

    def readinto(self, room: Any) -> int:
        size = min(self._pieces.pop() if self._pieces else len(room), len(room), len(self._data))
        room[:size] = self._data[:size]
        self._data = self._data[size:]
        return size


def connection(data: bytes, pieces: list[int]) -> Any:
    closed: list[bool] = []
    return SimpleNamespace(
        _rfile=io.BufferedReader(Wire(data, pieces)),
        _next_seq_id=0,
        _force_close=lambda: closed.append(True),
        closed=closed,
    )


def length(size: int) -> bytes:
    if size < 251:
        return bytes([size])
    if size < 1 << 16:
        return b"\xfc" + struct.pack("<H", size)
    if size < 1 << 24:
        return b"\xfd" + struct.pack("<I", size)[:3]
    return b"\xfe" + struct.pack("<Q", size)


def sent(packets: list[bytes]) -> bytes:
    return b"".join(struct.pack("<I", len(packet))[:3] + bytes([n % 256]) + packet for n, packet in enumerate(packets))


def wire_of(rows: list[Row]) -> list[bytes]:
    return [b"".join(b"\xfb" if value is None else length(len(value)) + value for value in row) for row in rows]


END = b"\xfe" + struct.pack("<HH", 3, 0)


NUMBERS = [("ascii", int), (None, None)]
OTHERS = [(None, int), (None, None)]  # which are not split by the kernel


def read(
    packets: list[bytes], pieces: list[int], converters: Any = NUMBERS, into: PackedRows | Numbers | None = None
) -> blobs._BulkResult:
    opened = connection(sent(packets), pieces)
    result = blobs._BulkResult(opened, into)
    result.converters = converters
    result._read_rowdata_packet()
    return result


values = st.one_of(st.none(), st.sampled_from(SIZES).map(bytes), st.binary(max_size=40))


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-5, 2**62), values), max_size=300),
    st.lists(st.integers(1, 100_000), max_size=50),
)
def test_rows_are_those_that_were_sent(rows: list[tuple[int, bytes | None]], pieces: list[int]) -> None:
    packets = [*wire_of([(str(key).encode(), value) for key, value in rows]), END]
    for converters in (NUMBERS, OTHERS):
        result = read(packets, list(pieces), converters)
        assert result.rows == tuple(rows)
        assert (result.affected_rows, result.warning_count, result.has_next) == (len(rows), 3, False)
    packed = PackedRows()
    for _ in range(2):  # the second time in the same memory
        packed.clear()
        for row in read(packets, list(pieces), into=packed).rows:  # what is no whole number and a blob
            packed.add(*row)
        assert len(packed) == len(rows)
        assert sorted(packed.rows(), key=repr) == sorted(rows, key=repr)
        assert packed.keys() == {key for key, _ in rows}
    wanted = np.unique([key for key, _ in rows if key % 2]).astype(np.int64)
    packed.keep(wanted)
    assert packed.keys() == set(wanted.tolist())


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(-5, 2**63 - 1), max_size=2000), st.lists(st.integers(1, 3000), max_size=50))
def test_numbers_are_those_that_were_sent(sent_numbers: list[int], pieces: list[int]) -> None:
    numbers = Numbers()
    packets = [*wire_of([(str(number).encode(),) for number in sent_numbers]), END]
    others = read(packets, pieces, [("ascii", int)], numbers).rows
    numbers.add_many(np.array([number for (number,) in others], np.int64))
    assert sorted(numbers.all().tolist()) == sorted(sent_numbers)
    short = [number for number in sent_numbers if 0 <= number < 10**18]
    assert len(others) == len(sent_numbers) - len(short)


def test_a_value_of_more_than_a_packet() -> None:
    value = bytes(range(256)) * (1 << 16)
    (packet,) = wire_of([(b"7", value)])
    packets = [packet[: blobs._WHOLE], packet[blobs._WHOLE :], END]
    assert read(packets, []).rows == ((7, value),)


def test_errors_amid_rows_are_those_of_the_server() -> None:
    error = b"\xff" + struct.pack("<H", 1317) + b"#70100Query execution was interrupted"
    opened = connection(sent([*wire_of([(b"1", b"a")]), error]), [])
    result = blobs._BulkResult(opened)
    result.converters = NUMBERS
    with pytest.raises(err.OperationalError, match="interrupted") as raised:
        result._read_rowdata_packet()
    assert raised.value.args[0] == 1317
    assert not opened.closed  # nothing else is on its way


def test_a_server_that_shuts_down_amid_rows_is_lost() -> None:
    """MariaDB says so in a packet that is not counted."""
    error = b"\xff" + struct.pack("<H", 1927) + b"#70100Connection was killed"
    row = sent(wire_of([(b"1", b"a")]))
    opened = connection(row + sent([error]), [])
    result = blobs._BulkResult(opened)
    result.converters = NUMBERS
    with pytest.raises(err.OperationalError, match="Lost connection to MySQL server during query") as raised:
        result._read_rowdata_packet()
    assert raised.value.args[0] == 2013
    assert opened.closed


def test_a_connection_that_ends_is_lost() -> None:
    opened = connection(sent(wire_of([(b"1", bytes(50))]))[:-1], [])
    result = blobs._BulkResult(opened)
    result.converters = NUMBERS
    with pytest.raises(err.OperationalError, match="Lost connection to MySQL server during query") as raised:
        result._read_rowdata_packet()
    assert raised.value.args[0] == 2013
    assert opened.closed


@pytest.mark.parametrize("data", [b"\x01\x00\x00\x05\xfe", sent([b"\x05ab"])])
def test_nonsense_is_refused(data: bytes) -> None:
    opened = connection(data, [])
    result = blobs._BulkResult(opened)
    result.converters = [("ascii", int)]
    with pytest.raises(err.Error):
        result._read_rowdata_packet()
    assert opened.closed  # or what it sends besides would be taken for the next answer


def test_items_are_worked_out_ahead_of_those_who_use_them() -> None:
    made: list[int] = []

    def items() -> Any:
        for number in range(5):
            made.append(number)
            yield number
        raise ValueError("the end")

    found: list[int] = []
    with pytest.raises(ValueError, match="the end"):
        found.extend(ahead(items()))
    assert found == made == [0, 1, 2, 3, 4]
    made.clear()
    for _ in ahead(items()):
        break
    assert made in ([0], [0, 1])
