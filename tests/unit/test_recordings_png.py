"""The PNG decoder: every filter, both kinds of pixels, and what is broken in ways that checksums do not show."""

from __future__ import annotations

import itertools
import struct
import zlib

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semdb.errors import FrameError
from semdb.recordings import png
from semdb.recordings.images import decode_16bit, decode_color

Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def header(pixels: Pixels, interlace: int = 0) -> bytes:
    height, width = pixels.shape[:2]
    colour = 2 if pixels.ndim == 3 else 0
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, colour, 0, 0, interlace))


def filtered(pixels: Pixels, filters: list[int]) -> bytes:
    """Rows as section 9 of the specification has them, each after the filter of its turn."""
    size = 3 if pixels.ndim == 3 else 2
    rows = pixels.astype(f">u{pixels.itemsize}").reshape(len(pixels), -1).view(np.uint8).astype(int)
    out = b""
    for y, row in enumerate(rows):
        above = rows[y - 1] if y else np.zeros_like(row)
        left = np.concatenate([np.zeros(size, int), row[:-size]])
        corner = np.concatenate([np.zeros(size, int), above[:-size]])
        near = [np.abs(left + above - corner - other) for other in (left, above, corner)]
        paeth = np.where((near[0] <= near[1]) & (near[0] <= near[2]), left, np.where(near[1] <= near[2], above, corner))
        kind = filters[y % len(filters)]
        predicted = (np.zeros_like(row), left, above, (left + above) // 2, paeth)[kind]
        out += bytes([kind]) + ((row - predicted) % 256).astype(np.uint8).tobytes()
    return out


def file_of(pixels: Pixels, lines: bytes, *between: bytes, parts: int = 1, interlace: int = 0) -> bytes:
    packed = zlib.compress(lines)
    cuts = [len(packed) * k // parts for k in range(parts + 1)]
    data = b"".join(chunk(b"IDAT", packed[a:b]) for a, b in itertools.pairwise(cuts))
    return png.SIGNATURE + header(pixels, interlace) + b"".join(between) + data + chunk(b"IEND", b"")


def decoded(data: bytes, pixels: Pixels) -> Pixels:
    if pixels.ndim == 3:
        return decode_color(data, "a.png")
    return decode_16bit(data, "a.png", (pixels.shape[1], pixels.shape[0]))


SIDES = st.tuples(st.integers(1, 9), st.integers(1, 9))
IMAGES = st.one_of(
    SIDES.flatmap(lambda sides: hnp.arrays(np.uint8, (*sides, 3))), SIDES.flatmap(lambda s: hnp.arrays(np.uint16, s))
)


@settings(deadline=None)  # kernels compile at their first call
@given(IMAGES, st.lists(st.integers(0, 4), min_size=1, max_size=9), st.integers(1, 3))
def test_every_filter_is_undone_as_opencv_does(pixels: Pixels, filters: list[int], parts: int) -> None:
    data = file_of(pixels, filtered(pixels, filters), parts=parts)
    np.testing.assert_array_equal(decoded(data, pixels), pixels)
    theirs = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(theirs[..., ::-1] if pixels.ndim == 3 else theirs, pixels)
    assert png.decode(png.read_header(data[: png.HEADER_BYTES]), list(png.chunks(data))) is not None


RGB = np.random.default_rng(3).integers(0, 256, (5, 7, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(4).integers(0, 65536, (5, 7), dtype=np.uint16)


@pytest.mark.parametrize("pixels", [RGB, DEPTH], ids=["rgb", "depth"])
def test_other_kinds_are_left_to_opencv(pixels: Pixels) -> None:
    lines = filtered(pixels[:1, :1], [0])
    files = [
        file_of(pixels[:1, :1], lines, interlace=1),
        file_of(pixels[:1, :1], lines, chunk(b"tRNS", b"\0" * (6 if pixels.ndim == 3 else 2))),
        bytes(cv2.imencode(".png", RGB[..., 0])[1]),
        bytes(cv2.imencode(".png", np.dstack([RGB, RGB[..., :1]]))[1]),
    ]
    for data in files:
        assert png.decode(png.read_header(data[: png.HEADER_BYTES]), list(png.chunks(data))) is None
    if pixels.ndim == 3:
        np.testing.assert_array_equal(decode_color(files[0], "a.png"), pixels[:1, :1])
        np.testing.assert_array_equal(decode_color(files[1], "a.png"), pixels[:1, :1])


def test_depth_read_as_colour_and_colour_as_depth() -> None:
    deep = file_of(DEPTH, filtered(DEPTH, [4]))
    np.testing.assert_array_equal(decode_color(deep, "a.png")[..., 0], (DEPTH.astype(int) / 256).astype(np.uint8))
    with pytest.raises(
        FrameError, match=r"a\.png: a depth image needs one channel of 16 bits, this has 3 of 8 bits, as colour"
    ):
        decode_16bit(file_of(RGB, filtered(RGB, [1])), "a.png", (7, 5))


@pytest.mark.parametrize("pixels", [RGB, DEPTH], ids=["rgb", "depth"])
def test_pixels_that_are_broken_although_their_checksums_are_right(pixels: Pixels) -> None:
    lines = filtered(pixels, [0, 1, 2, 3, 4])
    whole = file_of(pixels, lines)
    start, end = whole.index(b"IDAT") + 4, whole.index(b"IEND") - 8
    broken = {
        "cannot be decompressed": png.SIGNATURE + header(pixels) + chunk(b"IDAT", b"no deflate") + chunk(b"IEND", b""),
        "fewer pixels": file_of(pixels, lines[:-1]),
        "unknown PNG filter": file_of(pixels, b"\x05" + lines[1:]),
        "wrong checksum of PNG chunk at byte 33": whole[:start] + b"\0" + whole[start + 1 :],
        "truncated": whole[:end],
    }
    for message, data in broken.items():
        with pytest.raises(FrameError, match=message):
            decoded(data, pixels)
    np.testing.assert_array_equal(decoded(file_of(pixels, lines + bytes(1000)), pixels), pixels)  # more is no harm


def test_a_file_that_says_it_is_huge_takes_no_memory() -> None:
    """Its header is of a terapixel: nothing of the kind is allocated, and the error says what is wrong."""
    size = struct.pack(">IIBBBBB", 1 << 20, 1 << 20, 16, 0, 0, 0, 0)
    data = png.SIGNATURE + chunk(b"IHDR", size) + chunk(b"IDAT", zlib.compress(bytes(10))) + chunk(b"IEND", b"")
    with pytest.raises(FrameError, match=r"huge\.png"):
        decode_16bit(data, "huge.png", (1 << 20, 1 << 20))
