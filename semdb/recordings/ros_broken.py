"""What a bag that cannot be opened still holds: records are counted one after another, without its index."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path
from typing import BinaryIO

ROS1_MAGIC, MCAP_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
ROS1_CHUNK, ROS1_INDEX = 5, 4
MCAP_CHUNK, MCAP_MESSAGE = 6, 5
LONGEST_HEADER = 1 << 20


def what_is_left(path: Path) -> str:
    """A sentence about what can still be read of a damaged file and how. Never raises."""
    try:
        file = _first_file(path)
        if file is None:
            return "There is no file of a bag in it."
        size = file.stat().st_size
        with file.open("rb") as stream:
            start = stream.read(16)
            if not start.strip(b"\0"):
                return (
                    f"The file is empty ({size} bytes)." if not start else "The file begins with zeros: copy it again."
                )
            if start.startswith(ROS1_MAGIC):
                return _ros1(stream, size)
            if start.startswith(MCAP_MAGIC):
                return _mcap(stream, size)
            if start.startswith(b"SQLite format 3\0"):
                return "It is an SQLite file: `sqlite3 FILE .recover` gets out what is left of it."
        return "It does not begin as a bag does."
    except (OSError, ValueError, struct.error):
        return "Nothing of it can be read."


def _first_file(path: Path) -> Path | None:
    if path.is_file():
        return path
    files = sorted(file for file in path.iterdir() if file.is_file() and file.suffix in (".bag", ".db3", ".mcap"))
    return files[0] if files else None


def _ros1(stream: BinaryIO, size: int) -> str:
    """Counts whole chunks, and the messages that their index records name."""
    stream.seek(len(ROS1_MAGIC))
    chunks = messages = 0
    end = stream.tell()
    while True:
        head = stream.read(4)
        if len(head) < 4:
            break
        (length,) = struct.unpack("<I", head)
        if length > LONGEST_HEADER:
            break
        fields = _ros1_fields(stream.read(length))
        data = stream.read(4)
        if len(data) < 4:
            break
        (count,) = struct.unpack("<I", data)
        if stream.tell() + count > size:
            break
        stream.seek(count, 1)
        end = stream.tell()
        kind = fields.get(b"op", b"\0")[:1]
        chunks += kind == bytes([ROS1_CHUNK])
        if kind == bytes([ROS1_INDEX]) and len(fields.get(b"count", b"")) == 4:
            messages += struct.unpack("<I", fields[b"count"])[0]
    if not chunks:
        return f"No whole chunk lies in its {size} bytes."
    return (
        f"{chunks} chunks with {messages} messages, up to byte {end} of {size}, are whole: "
        "`rosbag reindex FILE` of ROS 1 makes a bag of them."
    )


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at + 4 <= len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        fields[name] = value
        at += 4 + length
    return fields


def _mcap(stream: BinaryIO, size: int) -> str:
    """Counts whole chunks and messages outside of chunks."""
    stream.seek(len(MCAP_MAGIC))
    kinds: Counter[int] = Counter()
    end = stream.tell()
    while True:
        head = stream.read(9)
        if len(head) < 9:
            break
        kind, length = struct.unpack("<BQ", head)
        if stream.tell() + length > size:
            break
        stream.seek(length, 1)
        end = stream.tell()
        kinds[kind] += 1
    if not kinds[MCAP_CHUNK] and not kinds[MCAP_MESSAGE]:
        return f"No whole chunk lies in its {size} bytes."
    outside = f" and {kinds[MCAP_MESSAGE]} messages" if kinds[MCAP_MESSAGE] else ""
    return (
        f"{kinds[MCAP_CHUNK]} chunks{outside}, up to byte {end} of {size}, are whole: "
        "`mcap recover FILE -o NEW` makes a bag of them."
    )
