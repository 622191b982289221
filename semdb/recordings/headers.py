"""What the header of an image file says, of each kind that is read, and whether the file is whole.

OpenCV decodes these kinds, half a file too and of any size, so size and end are looked at before. PNG and JPEG, which
recordings are made of, have files of their own (`png`, `jpeg`).
Sources: RFC 9649 (WebP), TIFF 6.0, the netpbm manual (PNM), GIF89a, ISO 15444-1 annex A (JPEG 2000), ISO 23008-12
(boxes of HEIF and AVIF), Windows' BITMAPINFOHEADER.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass

from semdb.recordings import png
from semdb.recordings.jpeg import JPEG_START, read_jpeg_header
from semdb.recordings.png import TRUNCATED, ImageFileError

MOST_PIXELS = 1 << 27
"""Of an image that is decoded in full: 134 million, 400 MB as RGB."""
_PNM = re.compile(rb"P([1-6])" + rb"(?:(?:\s|#[^\r\n]*[\r\n])+(\d{1,9}))" * 2)
_PNM_TO_THE_END = re.compile(rb"P[56](?:(?:\s|#[^\r\n]*[\r\n])+\d{1,9}){2}(?:\s|#[^\r\n]*[\r\n])+(\d{1,5})\s")
_TIFF_TYPES = {1: "B", 3: "H", 4: "I"}


class NotAnImageError(ImageFileError):
    """No image of a kind that is read."""

    def __init__(self) -> None:
        super().__init__("is not a PNG or JPEG image")


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What the header of an image file says; `bits` are those of a channel, a palette counts as 3 `channels`."""

    kind: str  # "png", "jpeg", "webp", ...
    width: int
    height: int
    bits: int
    channels: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.width, self.height


def read_header(data: bytes, most_pixels: int = MOST_PIXELS) -> ImageHeader:
    """The header of a whole image file in memory; the end of PNG and JPEG files is not looked at.

    Raises ImageFileError for what is no image of a kind that is read, ends too early, or is too large.
    """
    if not data:
        raise ImageFileError("the file is empty")
    other = _by_box if data[4:8] == b"ftyp" else _pnm
    read = next((read for start, read in _READERS if data.startswith(start)), other)
    try:
        header = read(data)
    except (struct.error, IndexError) as error:
        raise ImageFileError(TRUNCATED) from error
    return checked(header, most_pixels)


def checked(header: ImageHeader, most_pixels: int = MOST_PIXELS) -> ImageHeader:
    """`header` itself. Raises ImageFileError for one without pixels or with more than can be decoded."""
    if header.width < 1 or header.height < 1:
        raise ImageFileError(f"is damaged: an image of {header.width}x{header.height} pixels")
    if header.width * header.height > most_pixels:
        raise ImageFileError(
            f"is too large: {header.width}x{header.height} pixels, at most {most_pixels / 1e6:.0f} million are read"
        )
    return header


def _png(data: bytes) -> ImageHeader:
    header = png.read_header(data[: png.HEADER_BYTES])
    return ImageHeader("png", header.width, header.height, header.bits, header.channels)


def _jpeg(data: bytes) -> ImageHeader:
    return ImageHeader("jpeg", *read_jpeg_header(data))


def _bmp(data: bytes) -> ImageHeader:
    offset, size = struct.unpack_from("<II", data, 10)
    if size == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
        packed = 0
    else:
        width, height, _, bits, packed = struct.unpack_from("<iiHHI", data, 18)
    if packed in (0, 3) and offset + (abs(width) * bits + 31) // 32 * 4 * abs(height) > len(data):
        raise ImageFileError(TRUNCATED)
    return ImageHeader("bmp", width, abs(height), 8, 3)  # rows from below where the height is positive


def _webp(data: bytes) -> ImageHeader:
    if data[8:12] != b"WEBP":
        raise NotAnImageError
    if struct.unpack_from("<I", data, 4)[0] + 8 > len(data):
        raise ImageFileError(TRUNCATED)
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = (value & 0x3FFF for value in struct.unpack_from("<HH", data, 26))
    elif kind == b"VP8L":
        packed = struct.unpack_from("<I", data, 21)[0]
        width, height = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
    elif kind == b"VP8X":
        width, height = (1 + int.from_bytes(data[k : k + 3], "little") for k in (24, 27))
    else:
        raise ImageFileError("has a broken WebP header")
    return ImageHeader("webp", width, height, 8, 3)


def _gif(data: bytes) -> ImageHeader:
    if b"\x3b" not in data[-64:]:
        raise ImageFileError(TRUNCATED)
    width, height = struct.unpack_from("<HH", data, 6)
    return ImageHeader("gif", width, height, 8, 3)


def _pnm(data: bytes) -> ImageHeader:
    found = _PNM.match(data)
    if found is None:
        raise NotAnImageError
    kind, width, height = (int(value) for value in found.groups())
    channels, bits = 3 if kind in (3, 6) else 1, 8
    if kind in (5, 6):
        start = _PNM_TO_THE_END.match(data)
        if start is None:
            raise ImageFileError("has a broken PNM header")
        bits = 16 if int(start[1]) > 255 else 8
        if start.end() + width * height * channels * bits // 8 > len(data):
            raise ImageFileError(TRUNCATED)
    elif kind == 4 and found.end() + 1 + (width + 7) // 8 * height > len(data):
        raise ImageFileError(TRUNCATED)
    return ImageHeader("pnm", width, height, bits, channels)


def _tiff(data: bytes) -> ImageHeader:
    order = "<" if data.startswith(b"II") else ">"
    tags = _tiff_tags(data, order)
    for offsets, counts in ((273, 279), (324, 325)):  # of strips, of tiles
        ends = [offset + count for offset, count in zip(tags.get(offsets, ()), tags.get(counts, ()), strict=False)]
        if ends and max(ends) > len(data):
            raise ImageFileError(TRUNCATED)
    tile = tags.get(322, (0,))[0] * tags.get(323, (0,))[0]
    if tile > MOST_PIXELS:
        raise ImageFileError("is damaged: tiles of too many pixels")
    if not tags.get(256) or not tags.get(257):
        raise ImageFileError("has a broken TIFF header")
    palette = tags.get(262, (0,))[0] == 3
    channels = 3 if palette else tags.get(277, (1,))[0]
    return ImageHeader("tiff", tags[256][0], tags[257][0], tags.get(258, (1,))[0], channels)


def _tiff_tags(data: bytes, order: str) -> dict[int, tuple[int, ...]]:
    """The whole numbers of the first directory by their tag."""
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    tags = {}
    for k in range(count):
        place = start + 2 + 12 * k
        tag, kind, number = struct.unpack_from(f"{order}HHI", data, place)
        if kind not in _TIFF_TYPES or number > len(data):
            continue
        layout = f"{order}{number}{_TIFF_TYPES[kind]}"
        where = place + 8
        if struct.calcsize(layout) > 4:
            (where,) = struct.unpack_from(f"{order}I", data, where)
        tags[tag] = struct.unpack_from(layout, data, where)
    return tags


def _jpeg2000(data: bytes) -> ImageHeader:
    start = data.find(b"\xff\x4f\xff\x51")
    if start < 0:
        raise ImageFileError(TRUNCATED)
    right, bottom, left, top = struct.unpack_from(">IIII", data, start + 8)
    (channels,) = struct.unpack_from(">H", data, start + 40)
    bits = (data[start + 42] & 0x7F) + 1
    if b"\xff\xd9" not in data[-64:]:
        raise ImageFileError(TRUNCATED)
    return ImageHeader("jp2", right - left, bottom - top, 16 if bits > 8 else 8, channels)


def _by_box(data: bytes) -> ImageHeader:
    brand = data[8:12]
    if brand not in (b"avif", b"avis"):
        if brand[:3] in (b"hei", b"hev") or brand in (b"mif1", b"msf1"):
            raise ImageFileError("is a HEIC picture, which is not read: convert it to JPEG or PNG")
        raise NotAnImageError
    sizes = [struct.unpack_from(">II", data, found.end() + 4) for found in re.finditer(b"ispe", data[:65536])]
    if not sizes:
        raise ImageFileError("has a broken AVIF header")
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    return ImageHeader("avif", width, height, 8, 3)


_READERS: tuple[tuple[bytes, Callable[[bytes], ImageHeader]], ...] = (
    (png.SIGNATURE, _png),
    (JPEG_START, _jpeg),
    (b"BM", _bmp),
    (b"RIFF", _webp),
    (b"GIF87a", _gif),
    (b"GIF89a", _gif),
    (b"II*\0", _tiff),
    (b"MM\0*", _tiff),
    (b"\0\0\0\x0cjP  \r\n\x87\n", _jpeg2000),
    (b"\xff\x4f\xff\x51", _jpeg2000),
)
