"""What decodes is used, whatever its kind; what would take the memory is refused; what shows nothing is named."""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.errors import FrameError
from semdb.recordings import decode_color, open_recording, read_query_image
from semdb.recordings.headers import read_header
from semdb.recordings.images import (
    bits_used,
    decode_16bit,
    decode_color_grey,
    inspect_file,
    orientation_of,
    remark_on_color,
    remark_on_depth,
)
from semdb.recordings.png import ImageFileError
from tests.unit.recording_miniatures import write_tum

RNG = np.random.default_rng(7)
PICTURE = cv2.resize(RNG.integers(0, 256, (8, 10, 3), dtype=np.uint8), (80, 60), interpolation=cv2.INTER_CUBIC)
RGB = PICTURE[..., ::-1]


def encoded(image: np.ndarray, suffix: str, *options: int) -> bytes:
    return bytes(cv2.imencode(suffix, image, list(options))[1])


JPEG = encoded(PICTURE, ".jpg")
FILM = b"\0\0\0\x18ftypmp42" + RNG.bytes(40_000).replace(b"\xff\xd9", b"\xff\xd8")


def with_orientation(data: bytes, mark: int, order: str = ">") -> bytes:
    tiff = (b"MM" if order == ">" else b"II") + struct.pack(f"{order}HIHHHIHH", 42, 8, 1, 0x0112, 3, 1, mark, 0)
    exif = b"Exif\0\0" + tiff + bytes(4)
    return data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


# --- what comes after a JPEG's end ---


@pytest.mark.parametrize(
    "after", [FILM, bytes(8192), JPEG, b"SEFT" + FILM], ids=["film", "zeros", "picture", "samsung"]
)
def test_a_picture_with_data_after_its_end_is_whole(tmp_path: Path, after: bytes) -> None:
    (tmp_path / "a.jpg").write_bytes(JPEG + after)
    header = inspect_file(tmp_path / "a.jpg")
    assert (header.kind, header.size, header.bits, header.channels) == ("jpeg", (80, 60), 8, 3)
    np.testing.assert_array_equal(read_query_image(tmp_path / "a.jpg"), decode_color(JPEG, "plain"))


@pytest.mark.parametrize("share", [0.3, 0.7, 0.99])
def test_a_truncated_picture_with_a_film_behind_it_is_not(tmp_path: Path, share: float) -> None:
    (tmp_path / "a.jpg").write_bytes(JPEG[: int(share * len(JPEG))] + bytes(8192))
    with pytest.raises(FrameError, match=r"truncated|damaged"):
        inspect_file(tmp_path / "a.jpg")


def test_a_thumbnail_and_a_profile_before_the_header(tmp_path: Path) -> None:
    thumbnail = b"Exif\0\0" + encoded(PICTURE[::4, ::4], ".jpg")
    profile = b"".join(b"\xff\xe2" + (60_002).to_bytes(2, "big") + bytes(60_000) for _ in range(3))
    data = JPEG[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + profile + JPEG[2:]
    (tmp_path / "a.jpg").write_bytes(data)
    assert inspect_file(tmp_path / "a.jpg").size == (80, 60)
    np.testing.assert_array_equal(decode_color(data, "a"), decode_color(JPEG, "plain"))


@pytest.mark.parametrize("mark", range(1, 9))
@pytest.mark.parametrize("order", [">", "<"])
def test_orientation_marks_are_read_and_never_applied(mark: int, order: str) -> None:
    marked = with_orientation(JPEG, mark, order)
    assert orientation_of(marked) == mark
    np.testing.assert_array_equal(decode_color(marked, "a"), decode_color(JPEG, "a"))
    np.testing.assert_array_equal(decode_color_grey(marked, "a"), decode_color_grey(JPEG, "a"))


@given(st.binary(max_size=80))
def test_broken_exif_is_no_mark(data: bytes) -> None:
    exif = b"Exif\0\0" + data
    marked = JPEG[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + JPEG[2:]
    assert 1 <= orientation_of(marked) <= 8
    assert orientation_of(data) == 1


# --- 16 bits that are 10, 12 or 14 ---


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_pictures_of_fewer_bits_in_16_are_as_bright_as_in_8(bits: int, suffix: str) -> None:
    deep = (PICTURE.astype(np.uint16) << (bits - 8)) | 1
    data = encoded(deep, suffix)
    assert bits_used(deep) == bits
    np.testing.assert_array_equal(decode_color(data, "deep"), RGB)
    np.testing.assert_array_equal(decode_color_grey(data, "deep"), cv2.cvtColor(PICTURE, cv2.COLOR_BGR2GRAY))
    grey = decode_color(encoded(deep[..., 1], suffix), "grey")
    np.testing.assert_array_equal(grey, np.repeat(PICTURE[..., 1:2], 3, axis=2))


def test_16_bits_with_transparency() -> None:
    deep = np.dstack([PICTURE.astype(np.uint16) * 16, np.full((60, 80), 65535, np.uint16)])
    np.testing.assert_array_equal(decode_color(encoded(deep, ".png"), "deep"), RGB)


def test_a_recording_of_12_bit_pictures_is_usable(tmp_path: Path) -> None:
    walk = write_tum(tmp_path / "walk", n=2)
    image = cv2.imread(str(walk / "rgb/100.000000.png"))
    (walk / "rgb/100.000000.png").write_bytes(encoded(image.astype(np.uint16) * 16, ".png"))
    np.testing.assert_array_equal(open_recording(walk).read(open_recording(walk).entries[0]).image, image[..., ::-1])


# --- other kinds ---

OTHERS = [kind for kind in (".webp", ".bmp", ".tiff", ".ppm", ".gif", ".jp2", ".avif") if cv2.haveImageWriter(kind)]


@pytest.mark.parametrize("suffix", OTHERS)
def test_what_decodes_is_used_in_recordings_too(tmp_path: Path, suffix: str) -> None:
    data = encoded(PICTURE, suffix)
    (tmp_path / "a.png").write_bytes(data)  # whatever it is called
    header = inspect_file(tmp_path / "a.png")
    assert (header.size, header.channels) == ((80, 60), 3)
    assert np.abs(read_query_image(tmp_path / "a.png").astype(int) - RGB).mean() < (30 if suffix == ".gif" else 8)


@pytest.mark.parametrize("suffix", OTHERS)
@settings(max_examples=15, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_no_kind_is_decoded_in_part(suffix: str, share: float) -> None:
    data = encoded(PICTURE, suffix)
    with pytest.raises(FrameError):
        decode_color(data[: int(share * len(data))], "cut")


@pytest.mark.parametrize(
    "start", [b"BM", b"RIFF", b"GIF89a", b"II*\0", b"MM\0*", b"P6", b"\xff\x4f\xff\x51", b"\xff\xd8\xff"]
)
@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=200))
def test_broken_headers_are_one_reason(start: bytes, data: bytes) -> None:
    with contextlib.suppress(ImageFileError):  # and nothing else
        read_header(start + data)


def test_depth_in_a_16_bit_pgm_and_tiff() -> None:
    raw = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    for suffix in (".pgm", ".tiff"):
        np.testing.assert_array_equal(decode_16bit(encoded(raw, suffix), "d", (8, 6)), raw)


def test_a_heic_picture_is_named() -> None:
    with pytest.raises(FrameError, match="is a HEIC picture, which is not read: convert it"):
        decode_color(b"\0\0\0\x18ftypheic" + bytes(100), "a.heic")


# --- limits ---


def bomb_jpeg(width: int, height: int) -> bytes:
    at = JPEG.index(b"\xff\xc0")
    return JPEG[: at + 5] + struct.pack(">HH", height, width) + JPEG[at + 9 :]


def bomb_png(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


BOMBS = {
    "jpeg": bomb_jpeg(65_500, 65_500),
    "png": bomb_png(1 << 31, 1 << 31),
    "png of a thin line": bomb_png(1, 1 << 31),
    "bmp": b"BM" + struct.pack("<IHHIIiiHHII", 0, 0, 0, 54, 40, 60_000, -60_000, 1, 24, 1, 0) + bytes(100),
    "gif": b"GIF89a" + struct.pack("<HH", 65_535, 65_535) + bytes(50) + b";",
    "webp": b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + bytes(8) + b"\xff" * 6,
    "pnm": b"P3 # big\n50000 50000 255\n1 2 3",
    "tiff": b"II*\0\x08\0\0\0\x02\0" + struct.pack("<HHIIHHII", 256, 4, 1, 99_999, 257, 4, 1, 99_999) + bytes(8),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_pictures_of_too_many_pixels_are_refused_before_they_are_decoded(tmp_path: Path, kind: str) -> None:
    assert len(BOMBS[kind]) < 3000
    (tmp_path / "bomb").write_bytes(BOMBS[kind])
    for look in (lambda: inspect_file(tmp_path / "bomb"), lambda: read_query_image(tmp_path / "bomb")):
        with pytest.raises(FrameError, match=r"is too large: \d+x\d+ pixels, at most 134 million are read"):
            look()
    with pytest.raises(FrameError, match="is too large"):
        decode_16bit(BOMBS[kind], "bomb", (80, 60))


def test_a_sparse_file_is_dropped_and_the_rest_is_used(tmp_path: Path) -> None:
    walk = write_tum(tmp_path / "walk", n=3)
    for file in ("rgb/100.000000.png", "depth/100.104000.png"):
        with (walk / file).open("r+b") as stream:
            stream.truncate(60 << 30)
    recording = open_recording(walk)
    assert [entry.index for entry in recording.entries] == [2]
    assert [frame.reason for frame in recording.dropped] == [
        "colour image: the file is too large: 64425 MB, at most 537 MB",
        "depth image: the file is too large: 64425 MB, at most 537 MB",
    ]


def test_a_jpeg_is_made_smaller_while_it_is_decoded() -> None:
    whole = decode_color(JPEG, "a").astype(float)
    for reduce in (2, 4, 8):
        small = decode_color(JPEG, "a", reduce)
        height, width = -(-60 // reduce), -(-80 // reduce)
        assert small.shape == (height, width, 3)
        rows, columns = height - 1, width - 1
        means = whole[: rows * reduce, : columns * reduce].reshape(rows, reduce, columns, reduce, 3).mean(axis=(1, 3))
        assert np.abs(small[:rows, :columns] - means).mean() < 3
    assert decode_color(encoded(PICTURE, ".png"), "a", 4).shape == (60, 80, 3)


# --- what shows nothing ---


def test_remarks() -> None:
    noise = RNG.normal(0, 3, PICTURE.shape)
    assert remark_on_color(PICTURE) is None
    assert remark_on_color(np.clip(noise, 0, 255).astype(np.uint8)) == "the colour image is nearly black"
    assert remark_on_color((PICTURE // 17).astype(np.uint8)) == "the colour image is nearly black"
    assert remark_on_color((PICTURE // 4).astype(np.uint8)) is None
    assert remark_on_color(np.full_like(PICTURE, 200)) == "the colour image is nearly empty: one colour"
    assert remark_on_color(np.clip(200 + noise, 0, 255).astype(np.uint8)) is None
    depth = np.full((60, 80), np.nan, np.float32)
    assert remark_on_depth(depth) == "the depth image is nearly empty"
    depth[:2] = 1
    assert remark_on_depth(depth) is None


def test_frames_that_show_nothing_are_named_and_used(tmp_path: Path) -> None:
    walk = write_tum(tmp_path / "walk", n=4)
    black = np.zeros((48, 64, 3), np.uint8)
    (walk / "rgb/100.000000.png").write_bytes(encoded(black + 5, ".png"))
    (walk / "rgb/100.100000.png").write_bytes(encoded(black + 200, ".png"))
    (walk / "depth/100.204000.png").write_bytes(encoded(np.zeros((48, 64), np.uint16), ".png"))
    found = CliRunner().invoke(app, ["recording", str(walk), "--json"])
    assert found.exit_code == 0
    [content] = json.loads(found.stdout)
    assert content["usable"] == 4
    assert content["remarks"] == [
        {"name": "rgb/100.000000.png", "remark": "the colour image is nearly black"},
        {"name": "rgb/100.100000.png", "remark": "the colour image is nearly empty: one colour"},
        {"name": "rgb/100.200000.png", "remark": "the depth image is nearly empty"},
    ]
    text = CliRunner().invoke(app, ["recording", str(walk)]).stdout
    assert "look at      1 x the colour image is nearly black: rgb/100.000000.png" in text
