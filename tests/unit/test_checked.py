"""Values of columns: what is taken, and what the error says."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import BigInteger, Column, MetaData, Table, create_engine, insert, select

from semdb.database import checked
from semdb.database.codecs import decode_packed, decode_vectors, encode_array
from semdb.database.exact_sums import exact_sum, whole
from semdb.database.packed import PackedRows
from semdb.errors import CodecError
from semdb.types import Camera


@pytest.mark.parametrize("value", ["7", b"7", 7.0, None, -1, 2**31, 2**62, True, float("nan")])
def test_whole_numbers(value: Any) -> None:
    assert checked.integer(7, "a.b of c 3") == 7
    with pytest.raises(CodecError, match=r"^a\.b of c 3 is .*, not a whole number from 0 to 2147483647$"):
        checked.integer(value, "a.b of c 3")


@pytest.mark.parametrize("value", ["7", b"7", None, math.inf, -math.inf, math.nan, 10**400, 1.5, True])
def test_numbers(value: Any) -> None:
    assert checked.real(0.5, "x", 0, 1) == 0.5
    assert checked.real(1, "x", 0, 1) == 1.0
    with pytest.raises(CodecError, match=r"^a\.b is .*, not a finite number from 0 to 1$"):
        checked.real(value, "a.b", 0, 1)


@pytest.mark.parametrize("value", [7, b"text", None, "x" * 256, "\udcff", "a\ud800"])
def test_texts(value: Any) -> None:
    assert checked.text("Küche 厨房 🍳\x1b", "x") == "Küche 厨房 🍳\x1b"
    with pytest.raises(CodecError, match=r"^a\.b is "):
        checked.text(value, "a.b")


@pytest.mark.parametrize("value", ["", "{", "[" * 100_000, "9" * 5000, "x" * 2_000_000, 5, None, b"{}"])
def test_documents(value: Any) -> None:
    assert checked.mapping('{"a": [1, 1e999]}', "x") == {"a": [1, math.inf]}
    with pytest.raises(CodecError, match=r"^a\.b is ") as caught:
        checked.mapping(value, "a.b")
    assert len(str(caught.value)) < 120
    with pytest.raises(CodecError, match="not a JSON object"):
        checked.mapping("[1]", "a.b")


GOOD = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.5, "cy": 23.5, "distortion": "[]"}


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("width", 0),
        ("width", 2**31 - 1),
        ("height", "48"),
        ("fx", 0.0),
        ("fy", math.inf),
        ("fx", -50.0),
        ("cx", math.nan),
        ("cy", None),
        ("distortion", "[[1, 2]]"),
        ("distortion", "[1, 2, 3]"),
        ("distortion", '[1, 2, 3, "4"]'),
        ("distortion", "[1, 2, 3, 1e999]"),
        ("distortion", "[" + "9" * 400 + ", 0, 0, 0]"),
        ("distortion", "k1"),
        ("distortion", '{"k1": 0}'),
        ("distortion", "null"),
        ("distortion", b"[]"),
    ],
)
def test_cameras(column: str, value: Any) -> None:
    assert checked.camera(SimpleNamespace(**GOOD), "camera 3") == Camera(64, 48, 50, 51, 31.5, 23.5)
    lens = checked.camera(SimpleNamespace(**{**GOOD, "distortion": "[0.1, -2, 0, 0, 3]"}), "camera 3")
    assert lens.distortion == (0.1, -2.0, 0.0, 0.0, 3.0)
    with pytest.raises(CodecError, match=rf"^cameras\.{column} of camera 3 is "):
        checked.camera(SimpleNamespace(**{**GOOD, column: value}), "camera 3")


def test_poses() -> None:
    right = [1.0, 0.0, 0.0, 0.0, 1e8, -1e8, 0.0]
    rows: list[list[Any]] = [right]
    for place, value in (
        (0, 0.0),
        (0, 1.1),
        (1, math.inf),
        (4, 1.1e8),
        (5, -math.inf),
        (6, math.nan),
        (4, "1"),
        (3, None),
    ):
        wrong: list[Any] = list(right)
        wrong[place] = value
        rows.append(wrong)
        with pytest.raises(CodecError, match="keyframe 7"):
            checked.pose_numbers(wrong, "keyframe 7")
    numbers = checked.numbers_of(rows, 7)
    assert checked.are_poses(numbers).tolist() == [True] + [False] * 8
    assert checked.numbers_of([], 7).shape == (0, 7)
    np.testing.assert_array_equal(checked.numbers_of([[1, 2]] * 3, 2), np.tile([1.0, 2.0], (3, 1)))
    assert np.isnan(checked.numbers_of([["1", 2], [3, 10**400]], 2)).all()
    assert checked.pose_numbers(right, "x").tolist() == right


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "NULL"),
        (b"abc", "a blob of 3 bytes"),
        ("x" * 100, "'" + "x" * 39 + "..."),
        (1.5, "1.5"),
        ("a\n", "'a\\n'"),
    ],
)
def test_values_are_shown_short(value: Any, shown: str) -> None:
    assert checked.shown(value) == shown


@given(st.lists(st.integers(-(2**63), 2**63 - 1), max_size=30))
def test_sums_do_not_overflow(values: list[int]) -> None:
    engine = create_engine("sqlite://")
    table = Table("t", MetaData(), Column("value", BigInteger))
    table.metadata.create_all(engine)
    with engine.begin() as connection:
        if values:
            connection.execute(insert(table), [{"value": value} for value in values])
        row = connection.execute(select(*exact_sum(engine, table.c.value))).one()
    assert whole(row) == sum(values)


def packed(blobs: list[Any], room: Any = None) -> Any:
    rows = PackedRows()
    for key, blob in enumerate(blobs):
        rows.add(key, blob)
    return decode_packed(rows.data, rows.table(), None, room)


def test_vectors_that_are_none_are_zero_and_told() -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(6, 16)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    blobs: list[Any] = [encode_array(vector) for vector in vectors]
    keys = np.arange(10, 16)
    np.testing.assert_array_equal(decode_vectors(blobs, keys), vectors)
    np.testing.assert_array_equal(packed(blobs), vectors)
    room = np.empty((8, 16), np.float32)
    assert packed(blobs, room).base is room
    for number in range(len(blobs[0])):  # each byte of one counts
        damaged = bytearray(blobs[4])
        damaged[number] ^= 1 << number % 8
        assert packed([*blobs[:4], bytes(damaged), blobs[5]]) is None
    for factor in (np.nan, np.inf, -np.inf, 1.02 / np.abs(vectors[3]).max()):
        assert packed([*blobs[:3], encode_array(vectors[3] * np.float32(factor))]) is None
    assert packed([*blobs[:3], encode_array(vectors[3, :15])]) is None
    blobs[1] = encode_array(vectors[1][:5])
    blobs[2] = "text"
    blobs[3] = encode_array(vectors[3] * np.float32(np.nan))
    blobs[5] = blobs[5][:-1] + b"\0" if blobs[5][-1:] != b"\0" else blobs[5][:-1] + b"\1"
    told: dict[int, str] = {}
    found = decode_vectors(blobs, keys, bad=lambda key, error: told.__setitem__(key, str(error)))
    np.testing.assert_array_equal(found[[0, 4]], vectors[[0, 4]])
    assert not found[[1, 2, 3, 5]].any()
    assert sorted(told) == [11, 12, 13, 15]
    assert told[11] == "cnn_vectors.vector of keyframe 11 has 5 numbers, and others have 16"
    assert told[12] == "cnn_vectors.vector of keyframe 12 is 'text', not a blob"
    with pytest.raises(CodecError, match="keyframe 11"):
        decode_vectors(blobs, keys)
    assert decode_vectors(blobs[1:2], keys[1:2], 16, told.__setitem__).tolist() == [[0.0] * 16]
    assert decode_vectors(blobs[1:2], keys[1:2]).shape == (1, 5)
    with pytest.raises(CodecError, match="keyframe 12"):
        decode_vectors(blobs[2:4], keys[2:4], bad=told.__setitem__)
    assert decode_vectors([], keys[:0]).shape == (0, 0)
