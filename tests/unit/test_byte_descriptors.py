"""Descriptors of float as bytes: what is lost, what is refused, and that products of integers say the same."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.byte_descriptors import SCALE, are_bytes, from_bytes, to_bytes
from semdb.database import codecs
from semdb.errors import CodecError
from semdb.localization import matching_kernels as kernels
from semdb.localization.matching import closeness, distance_of, match_guided, match_keypoints, of_one_kind


def vectors(count: int, width: int = 64, seed: int = 0) -> np.ndarray:
    found = np.random.default_rng(seed).normal(size=(count, width)).astype(np.float32)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def seen_again(first: np.ndarray, noise: float = 0.03) -> np.ndarray:
    found = first + np.random.default_rng(1).normal(size=first.shape).astype(np.float32) * np.float32(noise)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize("width", [1, 3, 32, 64, 128, 256])
def test_any_two_fit_16_bits(width: int) -> None:
    """Also rows that rounding makes as long as it can, which all point the same way."""
    rows = np.full((3, width), (np.floor(SCALE / np.sqrt(width)) + 0.5) / SCALE, np.float32)
    rows *= np.float32(min(1.0, 1.003 / np.linalg.norm(rows[0])))
    small = to_bytes(np.concatenate([rows, -rows, vectors(20, width)]))
    assert small is not None
    assert are_bytes(small)
    exact = small.astype(np.int64) @ small.astype(np.int64).T
    np.testing.assert_array_equal(closeness(small, small), exact)
    assert np.abs(exact).max() < 2**15


def test_what_is_lost_is_half_a_step() -> None:
    one = vectors(500)
    small = to_bytes(one)
    assert small is not None
    assert np.abs(from_bytes(small) - one).max() <= 0.5 / SCALE + 1e-6
    squared = distance_of(closeness(small, small), small.dtype)
    exact = ((one[:, None] - one[None]) ** 2).sum(axis=2)
    assert np.abs(squared - exact).max() < 0.05


def test_what_is_no_unit_vector_stays_float() -> None:
    assert to_bytes(vectors(3) * np.float32(1.1)) is None
    assert to_bytes(vectors(3, 257)) is None
    assert to_bytes(np.full((1, 4), np.nan, np.float32)) is None
    small = to_bytes(np.zeros((2, 64), np.float32))  # of a keypoint on nothing
    assert small is not None
    assert not small.any()
    first, second = of_one_kind(vectors(3) * np.float32(1.1), small)
    assert first.dtype == second.dtype == np.float32


@pytest.mark.parametrize(("n", "m", "depth"), [(1, 1, 64), (5, 3, 7), (37, 130, 64), (130, 37, 66), (64, 515, 32)])
def test_products_and_scans_are_those_of_integers(n: int, m: int, depth: int) -> None:
    rng = np.random.default_rng(n)
    first, second = (rng.integers(-20, 21, (size, depth)).astype(np.int8) for size in (n, m))
    close = closeness(first, second)
    exact = first.astype(np.int64) @ second.astype(np.int64).T
    np.testing.assert_array_equal(close, exact)
    for rows, columns in ((np.arange(n), np.arange(m)), (np.arange(0, n, 2), np.arange(0, m, 3))):
        part = exact[np.ix_(rows, columns)]
        nearest, best, following = np.empty(len(rows), np.int32), *np.empty((2, len(rows)), np.int16)
        back = np.empty(len(columns), np.int16)
        if len(rows) == n and len(columns) == m:
            kernels.scan_bytes(close, nearest, best, following, back)
        else:
            kernels.scan_some_bytes(
                close, rows.astype(np.int32), columns.astype(np.int32), nearest, best, following, back
            )
        np.testing.assert_array_equal(nearest, part.argmax(axis=1))
        np.testing.assert_array_equal(best, part.max(axis=1))
        np.testing.assert_array_equal(back, part.max(axis=0))
        expected = np.sort(part, axis=1)[:, -2] if part.shape[1] > 1 else np.full(len(rows), -32768)
        np.testing.assert_array_equal(following, expected)


def test_bytes_match_as_floats_do() -> None:
    first = vectors(300)
    second = seen_again(first)[::-1].copy()
    none = np.full(300, -1, np.int32)
    pairs = []
    for one, other in ((first, second), (to_bytes(first), to_bytes(second)), (first, to_bytes(second))):
        assert one is not None
        assert other is not None
        found = match_keypoints(one, other, none, none)
        pairs.append(set(zip(found.query.tolist(), found.keyframe.tolist(), strict=True)))
    assert pairs[0] == pairs[1] == pairs[2]
    assert len(pairs[0]) == 300
    xy = np.random.default_rng(2).uniform(0, 200, (300, 2))
    guided = [
        match_guided(a, b, xy, xy[::-1].copy(), none, none) for a, b in ((first, second), (first, to_bytes(second)))
    ]
    np.testing.assert_array_equal(guided[0].query, guided[1].query)
    np.testing.assert_allclose(guided[0].distance, guided[1].distance, atol=0.02)


def test_a_blob_of_bytes_says_what_it_is() -> None:
    small = to_bytes(vectors(7))
    assert small is not None
    blob = codecs.encode_descriptors(vectors(7), "uint8")
    assert len(blob) == codecs.HEAD + 8 + 7 * 64
    assert blob[:4] == b"SDBQ"
    np.testing.assert_array_equal(codecs.decode_descriptors(blob, "here"), small)
    assert codecs.encode_descriptors(small) == blob
    assert codecs.dtype_of(blob[: codecs.HEAD]) == "uint8"
    assert codecs.dtype_of(codecs.encode_descriptors(vectors(1), "float16")[: codecs.HEAD]) == "float16"
    bits = np.arange(64, dtype=np.uint8).reshape(2, 32)
    np.testing.assert_array_equal(codecs.decode_descriptors(codecs.encode_descriptors(bits, "uint8"), "here"), bits)
    of_bits = codecs.encode_descriptors(bits, "auto")[: codecs.HEAD]  # keypoints beside them stay whole
    assert [codecs.dtype_of(head) for head in (of_bits, b"", b"x" * codecs.HEAD)] == ["float32"] * 3
    wide = vectors(2, 300)  # stays as it is
    np.testing.assert_array_equal(codecs.decode_descriptors(codecs.encode_descriptors(wide, "uint8"), "here"), wide)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.full((2, 64), 255, np.uint8), "here: a descriptor of bytes is longer than a unit vector"),
        (np.zeros((2, 64), np.float32), "here: float32 .2, 64. are no descriptors"),
        (np.zeros(64, np.uint8), "here: uint8 .64. are no descriptors"),
        (np.full((1, 300), 128, np.uint8), "here: a descriptor of bytes is longer than a unit vector"),
    ],
)
def test_bytes_that_are_no_descriptors_are_refused(array: np.ndarray, message: str) -> None:
    with pytest.raises(CodecError, match=message):
        codecs.decode_descriptors(codecs.encode_array(array, magic=codecs.BYTES_MAGIC), "here")
