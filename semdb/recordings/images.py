"""Image files: cheap checks of headers and ends, and decoding that never returns half an image.

OpenCV decodes a truncated PNG or JPEG in part and says nothing, so the structure of the file is checked first:
PNG chunks with their checksums up to IEND, JPEG markers up to EOI.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError
from semdb.recordings import png
from semdb.recordings.png import TRUNCATED, ImageFileError
from semdb.types import Float32Array, ImageArray

JPEG_START = b"\xff\xd8\xff"
JPEG_END = b"\xff\xd9"
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# In entropy-coded data a marker is 0xFF followed by anything but a stuffed zero, a restart or another fill byte.
JPEG_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
TAIL = 4096
NOT_AN_IMAGE = "is not a PNG or JPEG image"


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """What the header of an image file says; `channels` counts a palette image as 3."""

    kind: str  # "png" or "jpeg"
    width: int
    height: int
    bits: int
    channels: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.width, self.height


def inspect_file(path: Path) -> ImageHeader:
    """Header of a PNG or JPEG file, and a cheap check that its end is there; nothing is decoded.

    Raises FrameError whose message is the reason alone, without the name of the file.
    """
    try:
        with path.open("rb") as file:
            start = file.read(png.HEADER_BYTES)
            if not start:
                raise ImageFileError("the file is empty")
            if start.startswith(png.SIGNATURE):
                header = _header_of(png.read_header(start))
                _check_png_end(file)
            elif start.startswith(JPEG_START):
                header = _jpeg_header(file)
                _check_jpeg_end(file)
            else:
                raise ImageFileError(NOT_AN_IMAGE)
    except FileNotFoundError as error:
        raise FrameError("the file is missing") from error
    except OSError as error:
        raise FrameError(f"the file cannot be read: {error.strerror}") from error
    except ImageFileError as error:
        raise FrameError(str(error)) from error
    return header


def _header_of(header: png.PngHeader) -> ImageHeader:
    return ImageHeader("png", header.width, header.height, header.bits, header.channels)


def _check_png_end(file: BinaryIO) -> None:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - len(png.END)))
    if file.read() == png.END:
        return
    position = len(png.SIGNATURE)  # bytes may follow IEND: walk the chunks before calling it truncated
    while position + 12 <= size:
        file.seek(position)
        length, kind = struct.unpack(">I4s", file.read(8))
        position += length + 12
        if kind == b"IEND" and position <= size:
            return
    raise ImageFileError(TRUNCATED)


def _jpeg_header(file: BinaryIO) -> ImageHeader:
    file.seek(2)
    while True:
        marker = file.read(2)
        while len(marker) == 2 and marker == b"\xff\xff":
            marker = marker[1:] + file.read(1)
        if len(marker) < 2:
            raise ImageFileError(TRUNCATED)
        if marker[0] != 0xFF or marker[1] == 0xDA:
            raise ImageFileError("has a broken JPEG header")
        body = file.read(2)
        if len(body) < 2:
            raise ImageFileError(TRUNCATED)
        length = int.from_bytes(body, "big")
        if marker[1] in JPEG_FRAMES:
            frame = file.read(6)
            if len(frame) < 6:
                raise ImageFileError(TRUNCATED)
            bits, height, width, channels = struct.unpack(">BHHB", frame)
            return ImageHeader("jpeg", width, height, bits, channels)
        file.seek(length - 2, os.SEEK_CUR)


def _check_jpeg_end(file: BinaryIO) -> None:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - TAIL))
    if JPEG_END not in file.read():
        raise ImageFileError(TRUNCATED)


def _check_jpeg_bytes(data: bytes) -> None:
    """Walks the markers up to EOI, over entropy-coded data as well."""
    position, scans = 2, 0
    while position + 2 <= len(data):
        if data[position] != 0xFF:
            raise ImageFileError(f"is damaged: no JPEG marker at byte {position}")
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker == 0xD9:
            if scans == 0:
                raise ImageFileError("is damaged: a JPEG without image data")
            return
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
            if marker == 0xDA:
                scans += 1
                found = JPEG_MARKER_IN_SCAN.search(data, position)
                position = found.start() if found else len(data)
    raise ImageFileError(TRUNCATED)


def _decode(data: bytes, flags: int) -> npt.NDArray[Any]:
    """Pixels as OpenCV gives them with `flags`, but three channels of 8 bits are always RGB. Raises ImageFileError."""
    if not data:
        raise ImageFileError("the file is empty")
    if data.startswith(png.SIGNATURE):
        # all chunks are checked first: libpng would print, and give back what it has
        pixels = png.decode(png.read_header(data[: png.HEADER_BYTES]), list(png.chunks(data)))
        if pixels is not None and (pixels.ndim == 3 or flags == cv2.IMREAD_UNCHANGED):
            return pixels
    elif data.startswith(JPEG_START):
        _check_jpeg_bytes(data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageFileError(f"cannot be decoded: {error.err}") from error
    if image is None:
        raise ImageFileError("is not an image that can be decoded (PNG and JPEG can)")
    return np.asarray(image)


def decode_color(data: bytes, name: str) -> ImageArray:
    """RGB ``[H, W, 3]`` uint8 of a PNG, JPEG (or what else OpenCV decodes) in memory.

    Grey images get three equal channels, transparency is dropped, 16-bit images are scaled to 8 bits. An
    orientation mark of a telephone is not applied: intrinsics belong to the pixels as stored.
    `name` is for messages. Raises FrameError for what is no image, truncated or damaged.
    """
    try:
        rgb = _decode(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except ImageFileError as error:
        raise FrameError(f"{name}: {error}") from error
    return np.asarray(rgb, dtype=np.uint8)


def decode_16bit(data: bytes, name: str, size: tuple[int, int], what: str = "a depth image") -> npt.NDArray[np.uint16]:
    """The 16-bit values ``[H, W]`` of a PNG in memory; `size` is the expected (width, height).

    `what` names the content in messages. Raises FrameError, also for another size, type or channel count.
    """
    try:
        image = _decode(data, cv2.IMREAD_UNCHANGED)
    except ImageFileError as error:
        raise FrameError(f"{name}: {error}") from error
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise FrameError(
            f"{name}: {what} needs one channel of 16 bits, this has {channels} of {image.dtype.itemsize * 8} bits"
        )
    if image.shape != (size[1], size[0]):
        raise FrameError(
            f"{name}: {what} of {image.shape[1]}x{image.shape[0]} pixels, but {size[0]}x{size[1]} are needed"
        )
    return np.asarray(image)


def decode_gray(data: bytes, name: str) -> npt.NDArray[Any]:
    """The values ``[H, W]`` uint8 or uint16 of an image of one channel in memory, whatever its size.

    Raises FrameError that begins with `name`.
    """
    try:
        image = _decode(data, cv2.IMREAD_UNCHANGED)
    except ImageFileError as error:
        raise FrameError(f"{name}: {error}") from error
    if image.ndim != 2:
        raise FrameError(f"{name}: needs one channel, but has {image.shape[2]}")
    return image


def decode_depth(data: bytes, name: str, depth_scale: float, size: tuple[int, int]) -> Float32Array:
    """Depth ``[H, W]`` float32 metres, NaN where invalid, of a 16-bit PNG in memory, not yet registered.

    `depth_scale` is units per metre, `size` the expected (width, height), `name` for messages. The values 0 (no
    measurement) and 65535 (7-Scenes' mark, and saturation everywhere) are invalid. Raises FrameError.
    """
    return scaled_depth(decode_16bit(data, name, size), depth_scale)


def scaled_depth(raw: npt.NDArray[np.uint16], depth_scale: float) -> Float32Array:
    """Depth ``[H, W]`` float32 metres of 16-bit values of `depth_scale` a metre; NaN for 0 and 65535."""
    from semdb.recordings._png_rows import scaled

    depth = np.empty(raw.shape, np.float32)
    scaled(raw, np.float32(1.0 / depth_scale), depth)
    return depth


def encode_16bit(values: npt.NDArray[np.uint16]) -> bytes:
    """A PNG file of 16-bit values ``[H, W]``; `decode_16bit` gives them back."""
    return _encode(".png", np.ascontiguousarray(values), [cv2.IMWRITE_PNG_COMPRESSION, 1])


def encode_color(image: ImageArray) -> bytes:
    """A PNG file of RGB ``[H, W, 3]`` or grey ``[H, W]`` uint8; `decode_color` gives it back."""
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return _encode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _encode(kind: str, pixels: npt.NDArray[Any], parameters: list[int]) -> bytes:
    done, data = cv2.imencode(kind, pixels, parameters)
    if not done:
        raise FrameError(f"an image of {pixels.shape[1]}x{pixels.shape[0]} pixels cannot be written as {kind}")
    return bytes(data)


def read_bytes(path: Path) -> bytes:
    """The bytes of a file. Raises FrameError when it is missing or cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise FrameError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise FrameError(f"{path}: is a folder, not an image") from error
    except OSError as error:
        raise FrameError(f"{path}: cannot be read: {error.strerror}") from error


def read_query_image(path: Path) -> ImageArray:
    """RGB ``[H, W, 3]`` uint8 of an image file; see `decode_color`. Raises FrameError naming the file."""
    return decode_color(read_bytes(path), str(path))


def read_depth_image(path: Path, depth_scale: float, size: tuple[int, int]) -> Float32Array:
    """Depth ``[H, W]`` float32 metres of a 16-bit PNG file; see `decode_depth`. Raises FrameError naming the file."""
    return decode_depth(read_bytes(path), str(path), depth_scale, size)
