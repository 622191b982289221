"""Blobs come back exactly, and whatever is wrong with one is an error that names the row."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semdb.database.codecs import (
    decode_array,
    decode_keypoints,
    decode_mask,
    encode_array,
    encode_keypoints,
    encode_mask,
    image_format,
    keypoint_rows,
)
from semdb.database.compact import compact, expand
from semdb.errors import CodecError
from tests.database_samples import description

DTYPES = ("<f4", "u1", "<f8", "<i4", "<u4", "<f2", "<u2")


@given(
    st.sampled_from(DTYPES).flatmap(
        lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=9))
    )
)
def test_arrays_come_back(array: npt.NDArray[Any]) -> None:
    decoded = decode_array(encode_array(array), "here")
    np.testing.assert_array_equal(decoded, array)
    assert (decoded.dtype, decoded.shape) == (array.dtype, array.shape)


@settings(deadline=None)  # kernels compile at their first call
@given(hnp.arrays(np.bool_, st.tuples(st.integers(0, 20), st.integers(0, 20))))
def test_masks_come_back(mask: npt.NDArray[np.bool_]) -> None:
    decoded = decode_mask(encode_mask(mask), "here")
    np.testing.assert_array_equal(decoded, mask)
    assert decoded.dtype == np.bool_
    assert decoded.shape == mask.shape


def test_the_layout_of_a_blob() -> None:
    def checked(start: bytes, body: bytes) -> bytes:
        return start + struct.pack("<I", zlib.crc32(start + body)) + body

    expected = checked(b"SDBA\x01\x01\x01\x00", struct.pack("<I2f", 2, 1.0, -2.5))
    assert encode_array(np.array([1.0, -2.5], ">f4")) == expected
    mask = np.zeros((2, 4), np.bool_)
    mask[0, 2:] = mask[1, :1] = True
    runs = struct.pack("<I5H", 5, 2, 4, 2, 3, 3)  # how many numbers, height, width, runs
    assert encode_mask(mask) == checked(b"SDBM\x02\x07\x01\x00", runs)
    before = checked(b"SDBM\x01\x05\x01\x00", struct.pack("<I5I", 5, 2, 4, 2, 3, 3))  # as version 1 had them
    np.testing.assert_array_equal(decode_mask(before, "here"), mask)


def test_a_mask_is_small() -> None:
    mask = np.zeros((480, 640), np.bool_)
    mask[100:300, 200:400] = True
    assert len(encode_mask(mask)) == 16 + 2 * (2 + 401 + 2)  # the last run is 115,440 pixels


@pytest.mark.parametrize("run", [65534, 65535, 65536, 131070, 200_000])
def test_masks_with_long_runs_come_back(run: int) -> None:
    for shape, start in (((300, 700), 0), ((300, 700), 3), ((2, 131_072), 1)):
        mask = np.zeros(shape, np.bool_)
        mask.reshape(-1)[start : start + run] = True
        for one in (mask, ~mask):
            np.testing.assert_array_equal(decode_mask(encode_mask(one), "here"), one)


def test_arrays_of_other_kinds_are_refused() -> None:
    for array in (np.zeros(2, np.complex64), np.array(["a"]), np.zeros(2, np.complex64), np.array([None])):
        with pytest.raises(CodecError, match=f"an array of {array.dtype}"):
            encode_array(array)
    with pytest.raises(CodecError, match="two dimensions, not 1"):
        encode_mask(np.zeros(3, np.bool_))


@given(st.integers(0, 200), st.integers(1, 255))
def test_no_changed_byte_goes_unnoticed(position: int, difference: int) -> None:
    blob = bytearray(encode_array(np.arange(40, dtype="<f4").reshape(8, 5)))
    position %= len(blob)
    blob[position] ^= difference
    with pytest.raises(CodecError, match="row 7"):
        decode_array(bytes(blob), "row 7")


def test_what_is_wrong_is_said() -> None:
    good = encode_array(np.arange(6, dtype="<f4").reshape(2, 3))
    cases = {
        b"": "truncated \\(0 bytes\\)",
        good[:-1]: "truncated \\(43 bytes.*needs 44\\)",
        good + b"\0": "too long",
        b"\x89PNG" + good[4:]: "not a blob of this kind",
        good[:4] + b"\x03" + good[5:]: "blob format 3 is unknown.*upgrade",
        good[:5] + b"\x63" + good[6:]: "dtype code 99",
        good[:-1] + b"\x7f": "checksum",
    }
    for blob, message in cases.items():
        with pytest.raises(CodecError, match=f"^vector 3: .*{message}"):
            decode_array(blob, "vector 3")
    with pytest.raises(CodecError, match="not a blob of this kind"):
        decode_mask(good, "mask")
    for numbers, message in (([2], "no size"), ([2, 2, 3], "do not fill 2x2"), ([1, 1, 5, 5], "do not fill")):
        with pytest.raises(CodecError, match=message):
            decode_mask(encode_array(np.array(numbers, "<u4"), magic=b"SDBM"), "mask")


@pytest.mark.parametrize("binary", [False, True])
def test_keypoints_come_back(binary: bool) -> None:
    keypoints = description(5, binary=binary).keypoints
    blob = encode_keypoints(keypoints)
    decoded = decode_keypoints(blob, keypoints.features.descriptors, keypoints.object_index, "here")
    for name in ("xy", "size", "angle", "response", "laplacian", "descriptors"):
        before, after = getattr(keypoints.features, name), getattr(decoded.features, name)
        np.testing.assert_array_equal(after, before)
        assert after.dtype == before.dtype
        assert after.flags.c_contiguous
    np.testing.assert_array_equal(decoded.points, keypoints.points)
    np.testing.assert_array_equal(decode_array(blob, "here")[:, :2], keypoints.features.xy)
    assert decode_keypoints(blob, None, keypoints.object_index, "here").features.descriptors.shape == (60, 0)


@st.composite
def keypoint_rows_of_a_camera(draw: st.DrawFn) -> npt.NDArray[np.float32]:
    """Rows float32 [n, 9] as a camera could see them, some without depth."""
    count, seed = draw(st.integers(0, 40)), draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    rows = np.empty((count, 9), np.float32)
    rows[:, :2] = rng.uniform(0, draw(st.sampled_from([2, 640, 8000])), (count, 2))
    rows[:, 2] = rng.uniform(9, 300, count)
    rows[:, 3] = rng.uniform(0, 360, count)
    rows[:, 4] = np.exp(rng.uniform(np.log(100), np.log(1e6), count))
    rows[:, 5] = rng.integers(-1, 2, count)
    rows[:, 6:] = rng.uniform(-8, 8, (count, 3))
    rows[rng.random(count) < draw(st.sampled_from([0, 0.3, 1])), 6:] = np.nan
    return rows


@given(keypoint_rows_of_a_camera())
def test_compact_keypoints_lose_less_than_is_measured(rows: npt.NDArray[np.float32]) -> None:
    numbers = compact(rows)
    assert numbers is not None
    assert numbers.nbytes == 52 + 16 * len(rows)
    back = expand(decode_array(encode_array(numbers), "here"))
    assert back is not None
    assert back.shape == rows.shape
    if not len(rows):
        return
    np.testing.assert_array_equal(back[:, 5], rows[:, 5])
    np.testing.assert_array_equal(np.isnan(back[:, 6:]), np.isnan(rows[:, 6:]))
    span = np.nanmax(rows, axis=0, initial=-1e9) - np.nanmin(rows, axis=0, initial=1e9)
    for column in (0, 1, 2, 6, 7, 8):
        lost = np.nan_to_num(np.abs(back[:, column] - rows[:, column]))
        assert lost.max() <= max(span[column], 0) / 65534 * 0.5 + 2e-6 * np.nan_to_num(np.abs(rows[:, column])).max()
    turned = np.abs(back[:, 3] - rows[:, 3])
    assert np.minimum(turned, 360 - turned).max() <= 360 / 16384 / 2 + 1e-4
    strong = rows[:, 4] > rows[:, 4].max() / 10_000
    assert (np.abs(back[:, 4] / rows[:, 4] - 1)[strong]).max() <= 2**-10


def test_compact_keypoints_come_back_through_the_codec() -> None:
    keypoints = description(5).keypoints
    blob = encode_keypoints(keypoints, small=True)
    assert len(blob) == 16 + 52 + 16 * 60
    decoded = decode_keypoints(blob, keypoints.features.descriptors, keypoints.object_index, "here")
    np.testing.assert_allclose(decoded.features.xy, keypoints.features.xy, atol=0.01)
    np.testing.assert_allclose(decoded.points, keypoints.points, atol=2e-4)
    np.testing.assert_array_equal(decoded.features.laplacian, keypoints.features.laplacian)
    damaged = encode_array(np.zeros(27, "<u2"), magic=b"SDBK")
    with pytest.raises(CodecError, match=r"row 3: compact keypoints are uint16 \[26 \+ 8 n\]"):
        keypoint_rows(damaged, "row 3")


@pytest.mark.parametrize(
    ("column", "value"), [(0, np.nan), (2, np.inf), (3, -1), (3, 361), (4, -0.5), (5, 2), (5, 0.5), (6, np.nan)]
)
def test_what_does_not_fit_is_stored_as_it_is(column: int, value: float) -> None:
    rows = np.ones((3, 9), np.float32)
    assert compact(rows) is not None
    rows[1, column] = value
    assert compact(rows) is None


def test_keypoints_that_do_not_belong_together_are_refused() -> None:
    keypoints = description(5).keypoints
    blob = encode_keypoints(keypoints)
    with pytest.raises(CodecError, match=r"60 keypoints, descriptors \(59, 64\)"):
        decode_keypoints(blob, keypoints.features.descriptors[1:], keypoints.object_index, "here")
    with pytest.raises(CodecError, match="59 in object slices"):
        decode_keypoints(blob, None, keypoints.object_index[1:], "here")
    with pytest.raises(CodecError, match=r"float32 \[n, 9\], not float32 \(4, 8\)"):
        decode_keypoints(encode_array(np.zeros((4, 8), np.float32)), None, np.zeros(4, np.int32), "here")


def test_formats_are_told_by_their_first_bytes() -> None:
    assert image_format(b"\x89PNG\r\n\x1a\n....") == "png"
    assert image_format(b"\xff\xd8\xff\xe0....") == "jpeg"
    assert image_format(b"P6 640 480") == image_format(None) == ""
