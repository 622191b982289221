"""A blob of the database in a few words: what it is, by its first bytes, and its size. Nothing is decoded."""

from __future__ import annotations

import struct

from semdb.database import codecs

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8\xff"


def describe_blob(blob: bytes) -> str:
    """``vector float32[2048], 8.0 KiB``; ``blob, 3 bytes`` for what semdb does not know, or is damaged."""
    return f"{_kind(blob) or 'blob'}, {size_text(len(blob))}"


def size_text(count: int) -> str:
    """``812 bytes``, ``8.0 KiB``, ``1.4 MiB``."""
    if count < 1024:
        return f"{count} byte" if count == 1 else f"{count} bytes"
    size, unit = count / 1024, "KiB"
    for larger in ("MiB", "GiB"):
        if size < 1023.95:
            break
        size, unit = size / 1024, larger
    return f"{size:.1f} {unit}"


def _kind(blob: bytes) -> str | None:
    if blob.startswith(PNG) and len(blob) >= 24:
        width, height = struct.unpack_from(">II", blob, 16)
        return f"png {width}x{height}"
    if blob.startswith(JPEG):
        size = _jpeg_size(blob)
        return "jpeg" if size is None else f"jpeg {size[0]}x{size[1]}"
    header = codecs.peek(blob)
    if header is None:
        return None
    shape = ", ".join(map(str, header.shape))
    if header.size is not None:
        return f"mask {header.size[0]}x{header.size[1]}"
    if header.magic == codecs.COMPACT_MAGIC:
        return f"compact keypoints {header.dtype}[{shape}]"
    if header.magic == codecs.BYTES_MAGIC:
        return f"descriptors {header.dtype}[{shape}]"
    return f"{'vector' if len(header.shape) == 1 else 'array'} {header.dtype}[{shape}]"


def _jpeg_size(blob: bytes) -> tuple[int, int] | None:
    """Width and height by the marker that begins the frame."""
    position = 2
    while position + 9 <= len(blob) and blob[position] == 0xFF:
        marker, length = blob[position + 1], int.from_bytes(blob[position + 2 : position + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", blob, position + 5)
            return width, height
        if marker == 0xFF:
            position += 1
        elif marker == 0xDA or length < 2:
            return None
        else:
            position += 2 + length
    return None
