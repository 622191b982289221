"""PNG files: their chunks, checked, and the two kinds that recordings are made of decoded in a third of OpenCV's time.

These are 8-bit RGB and 16-bit grey, not interlaced. Most of a decoder's time goes into the two steps done here by
ISA-L's inflate and by compiled loops over the filters of rows. Whoever needs another kind asks OpenCV.
Source: Portable Network Graphics, third edition (W3C), sections 5 (chunks), 9 (filters) and 11.2 (header).
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from isal import isal_zlib

SIGNATURE = b"\x89PNG\r\n\x1a\n"
END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
HEADER_BYTES = 33  # signature and first chunk
_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_BYTES_PER_PIXEL = {(2, 8): 3, (0, 16): 2}  # by colour type and bits: what `decode` does
_MEAN_OTHER_PIXELS = {b"tRNS", b"acTL"}  # transparency, animation
_MOST_BYTES = 1 << 28  # of pixels; OpenCV says whether it takes more
TRUNCATED = "the file ends too early (truncated); copy or record it again"


class ImageFileError(ValueError):
    """Why a file is no whole image; without the file's name."""


@dataclass(frozen=True, slots=True)
class PngHeader:
    """The header's fields. `colour` is the colour type: 0 grey, 2 RGB, 3 palette, 4 grey and alpha, 6 RGB and alpha."""

    width: int
    height: int
    bits: int
    colour: int
    interlaced: bool

    @property
    def channels(self) -> int:
        """Channels of a pixel, a palette's being 3."""
        return _CHANNELS[self.colour]


def read_header(start: bytes) -> PngHeader:
    """The header in the first `HEADER_BYTES` of a file that starts with `SIGNATURE`. Raises ImageFileError."""
    if len(start) < HEADER_BYTES:
        raise ImageFileError(TRUNCATED)
    length, kind, width, height, bits, colour, _, _, interlace = struct.unpack(">I4sIIBBBBB", start[8:29])
    if kind != b"IHDR" or length != 13 or colour not in _CHANNELS or not width or not height:
        raise ImageFileError("has a broken PNG header")
    return PngHeader(width, height, bits, colour, interlace != 0)


def chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and content of the chunks up to IEND, each after its checksum was found right.

    Raises ImageFileError, also when the data end before IEND.
    """
    view = memoryview(data)
    position = len(SIGNATURE)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            break
        if isal_zlib.crc32(view[position + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ImageFileError(f"is damaged: wrong checksum of PNG chunk at byte {position}")
        yield kind, view[position + 8 : end]
        if kind == b"IEND":
            return
        position = end + 4
    raise ImageFileError(TRUNCATED)


def decode(header: PngHeader, parts: list[tuple[bytes, memoryview]]) -> npt.NDArray[np.uint8 | np.uint16] | None:
    """RGB uint8 ``[H, W, 3]`` or grey uint16 ``[H, W]`` of the chunks `parts`; None for a PNG of any other kind.

    Raises ImageFileError for pixels that cannot be decompressed, or too few of them.
    """
    size = _BYTES_PER_PIXEL.get((header.colour, header.bits))
    if size is None or header.interlaced or header.width * header.height * size > _MOST_BYTES:
        return None
    if any(kind in _MEAN_OTHER_PIXELS for kind, _ in parts):
        return None
    from semdb.recordings._png_rows import unfilter

    rows, stride = header.height, header.width * size
    lines = _inflate(b"".join(part for kind, part in parts if kind == b"IDAT"), rows * (stride + 1))
    pixels = np.empty((rows, stride), np.uint8)
    if unfilter(np.frombuffer(lines, np.uint8).reshape(rows, stride + 1), size, pixels) < rows:
        raise ImageFileError("is damaged: a row with an unknown PNG filter")
    if size == 3:
        return pixels.reshape(rows, header.width, 3)
    return pixels.view(">u2").astype(np.uint16)


def _inflate(packed: bytes, size: int) -> bytes:
    """The first `size` bytes that `packed` holds: no more, whatever a broken file says that it has."""
    try:
        lines: bytes = isal_zlib.decompressobj().decompress(packed, size)
    except isal_zlib.error as error:  # type: ignore[misc]  # its stub has a variable
        raise ImageFileError("is damaged: its pixels cannot be decompressed") from error
    if len(lines) < size:
        raise ImageFileError("is damaged: it has fewer pixels than its header says")
    return lines
