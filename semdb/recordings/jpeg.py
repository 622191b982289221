"""JPEG files: their header, whether they are whole, and the orientation mark of telephones.

libjpeg decodes half a file and says nothing to its caller, so the markers are followed up to the end of the image
first. What comes after that (a film in a motion photo, a second picture, padding) does no harm.
Sources: ITU-T T.81 annex B (markers), Exif 2.32 section 4.6 (orientation, tag 0x0112).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator

from semdb.recordings.png import TRUNCATED, ImageFileError

JPEG_START = b"\xff\xd8\xff"
JPEG_END = b"\xff\xd9"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without content
_END, _SCAN, _EXIF = 0xD9, 0xDA, 0xE1
# In entropy-coded data a marker is 0xFF followed by anything but a stuffed zero, a restart or another fill byte.
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_ORIENTATION = 0x0112


def _markers(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Each marker with the begin and end of its content, over entropy-coded data as well, up to the end of the image.

    Raises ImageFileError where there is none, or the data end first.
    """
    position = 2
    while position + 2 <= len(data):
        if data[position] != 0xFF:
            raise ImageFileError(f"is damaged: no JPEG marker at byte {position}")
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker == _END:
            yield marker, position + 2, position + 2
            return
        elif marker in _ALONE:
            position += 2
        else:
            end = position + 2 + int.from_bytes(data[position + 2 : position + 4], "big")
            yield marker, position + 4, end
            position = end
            if marker == _SCAN:
                found = _MARKER_IN_SCAN.search(data, position)
                position = found.start() if found else len(data)
    raise ImageFileError(TRUNCATED)


def read_jpeg_header(data: bytes) -> tuple[int, int, int, int]:
    """Width, height, bits and channels in the first bytes of a JPEG. Raises ImageFileError.

    `data` may end after the header: TRUNCATED is raised only where it ends before.
    """
    for marker, begin, _ in _markers(data):
        if marker in _FRAMES:
            if begin + 6 > len(data):
                break
            bits, height, width, channels = struct.unpack_from(">BHHB", data, begin)
            return width, height, bits, channels
        if marker in (_SCAN, _END):
            raise ImageFileError("has a broken JPEG header")
    raise ImageFileError(TRUNCATED)


def check_jpeg(data: bytes) -> None:
    """Raises ImageFileError unless the markers of a JPEG go on to the end of its image."""
    scans = sum(marker == _SCAN for marker, _, _ in _markers(data))
    if scans == 0:
        raise ImageFileError("is damaged: a JPEG without image data")


def orientation_of(data: bytes) -> int:
    """The orientation mark of a JPEG, 1 (as stored) to 8; 1 where there is none that makes sense."""
    try:
        for marker, begin, end in _markers(data):
            if marker in (_SCAN, _END):
                break
            if marker == _EXIF and data[begin : begin + 6] == b"Exif\0\0":
                return _orientation_in(data[begin + 6 : end])
    except (ImageFileError, struct.error):
        return 1
    return 1


def _orientation_in(tiff: bytes) -> int:
    order = "<" if tiff[:2] == b"II" else ">"
    (start,) = struct.unpack_from(f"{order}I", tiff, 4)
    (count,) = struct.unpack_from(f"{order}H", tiff, start)
    for k in range(count):
        tag, kind, _, value = struct.unpack_from(f"{order}HHIH", tiff, start + 2 + 12 * k)
        if tag == _ORIENTATION and kind == 3 and 1 <= value <= 8:
            return int(value)
    return 1
