"""Images are decoded whole or not at all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.errors import FrameError
from semdb.recordings import decode_color, decode_depth, read_depth_image, read_query_image
from semdb.recordings.images import inspect_file

RNG = np.random.default_rng(5)
PICTURE = cv2.resize(RNG.integers(0, 256, (8, 10, 3), dtype=np.uint8), (80, 60))


def encoded(image: np.ndarray, suffix: str, *options: int) -> bytes:
    return bytes(cv2.imencode(suffix, image, list(options))[1])


JPEG = encoded(PICTURE, ".jpg")
PROGRESSIVE = encoded(PICTURE, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
RESTARTS = encoded(PICTURE, ".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
PNG = encoded(PICTURE, ".png")


def test_query_image_is_rgb(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(PNG)
    image = read_query_image(tmp_path / "a.png")
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, PICTURE[..., ::-1])


@pytest.mark.parametrize("data", [JPEG, PROGRESSIVE, RESTARTS], ids=["baseline", "progressive", "restarts"])
def test_jpeg_of_each_kind_is_decoded(data: bytes) -> None:
    difference = np.abs(decode_color(data, "a.jpg").astype(int) - PICTURE[..., ::-1])
    assert difference.mean() < 4


def test_grey_rgba_and_16_bit_images_become_rgb() -> None:
    grey = decode_color(encoded(PICTURE[..., 0], ".png"), "grey")
    np.testing.assert_array_equal(grey, np.repeat(PICTURE[..., :1], 3, axis=2))
    rgba = decode_color(encoded(np.dstack([PICTURE, np.full((60, 80), 9, np.uint8)]), ".png"), "rgba")
    np.testing.assert_array_equal(rgba, PICTURE[..., ::-1])
    deep = decode_color(encoded(PICTURE.astype(np.uint16) * 256, ".png"), "deep")
    np.testing.assert_array_equal(deep, PICTURE[..., ::-1])


def test_an_orientation_mark_does_not_turn_the_pixels() -> None:
    exif = (
        b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00\x00\x00\x00\x00"
    )
    marked = JPEG[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + JPEG[2:]
    np.testing.assert_array_equal(decode_color(marked, "a.jpg"), decode_color(JPEG, "a.jpg"))


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([JPEG, PROGRESSIVE, RESTARTS, PNG]), st.floats(0, 1, exclude_max=True))
def test_every_truncation_is_an_error(data: bytes, share: float) -> None:
    with pytest.raises(FrameError):
        decode_color(data[: int(share * len(data))], "cut")


@pytest.mark.parametrize("data", [JPEG, PNG], ids=["jpeg", "png"])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.99])
def test_truncation_is_found_without_decoding(tmp_path: Path, data: bytes, share: float) -> None:
    (tmp_path / "cut").write_bytes(data[: max(4, int(share * len(data)))])
    with pytest.raises(FrameError, match=r"truncated|not a PNG or JPEG"):
        inspect_file(tmp_path / "cut")


def test_bytes_after_the_end_do_no_harm(tmp_path: Path) -> None:
    for name, data in (("a.png", PNG), ("a.jpg", JPEG)):
        (tmp_path / name).write_bytes(data + bytes(100))
        assert inspect_file(tmp_path / name).size == (80, 60)
        assert read_query_image(tmp_path / name).shape == (60, 80, 3)


def test_header_of_a_depth_image(tmp_path: Path) -> None:
    (tmp_path / "d.png").write_bytes(encoded(np.ones((6, 8), np.uint16), ".png"))
    header = inspect_file(tmp_path / "d.png")
    assert (header.kind, header.size, header.bits, header.channels) == ("png", (8, 6), 16, 1)


def test_what_is_no_image(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.png").write_text("a poem about a picture")
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    for name, message in (
        ("a.png", "not an image"),
        ("empty.jpg", "empty"),
        ("no.png", "no such file"),
        ("folder.png", "is a folder"),
    ):
        with pytest.raises(FrameError, match=message) as caught:
            read_query_image(tmp_path / name)
        assert name in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_depth_is_metres_with_nan_where_invalid(tmp_path: Path) -> None:
    raw = np.array([[0, 5000, 65535], [1, 65534, 2500]], np.uint16)
    (tmp_path / "d.png").write_bytes(encoded(raw, ".png"))
    depth = read_depth_image(tmp_path / "d.png", 5000, (3, 2))
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[np.nan, 1, np.nan], [0.0002, 13.1068, 0.5]], rtol=1e-6)


def test_depth_of_another_size_or_type(tmp_path: Path) -> None:
    (tmp_path / "d.png").write_bytes(encoded(np.ones((6, 8), np.uint16), ".png"))
    with pytest.raises(FrameError, match=r"d\.png: a depth image of 8x6 pixels, but 640x480 are needed"):
        read_depth_image(tmp_path / "d.png", 1000, (640, 480))
    with pytest.raises(FrameError, match="this has 1 of 8 bits"):
        decode_depth(encoded(np.ones((6, 8), np.uint8), ".png"), "d8", 1000, (8, 6))
    with pytest.raises(FrameError, match="this has 3 of 16 bits"):
        decode_depth(encoded(np.ones((6, 8, 3), np.uint16), ".png"), "d3", 1000, (8, 6))
    with pytest.raises(FrameError, match="no such file"):
        read_depth_image(tmp_path / "none.png", 1000, (8, 6))
