"""Image files: cheap checks of headers and ends, and decoding that never returns half an image.

This is the one reader of pictures: of recordings, queries, training data and the database. OpenCV decodes a truncated
PNG or JPEG in part and says nothing, so the structure of the file is checked first, and its size before that.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from semdb import files
from semdb.errors import FrameError
from semdb.files import UnusableFileError
from semdb.recordings import png
from semdb.recordings.headers import MOST_PIXELS, ImageHeader, NotAnImageError, checked, read_header
from semdb.recordings.jpeg import JPEG_END, JPEG_START, check_jpeg, orientation_of, read_jpeg_header
from semdb.recordings.png import TRUNCATED, ImageFileError
from semdb.types import Float32Array, ImageArray

MOST_IMAGE_BYTES = 1 << 29
MOST_REDUCED_PIXELS = 1 << 28
"""Of a JPEG that is decoded at a half or less: 268 million."""
NOT_DECODED = "is not an image that can be decoded (PNG and JPEG can)"
START = 1 << 16
TAIL = 4096
DARK = 16  # of 255: nearly black is what has 99 of 100 pixels below
FLAT = 1.5  # of 255: nearly empty is what has a standard deviation below; noise and shading alone give more
LEAST_DEPTH = 0.01  # share of pixels with depth

__all__ = [
    "ImageHeader",
    "decode_16bit",
    "decode_color",
    "decode_color_grey",
    "decode_depth",
    "inspect_file",
    "orientation_of",
    "read_bytes",
    "read_depth_image",
    "read_query_image",
    "remark_on_color",
    "remark_on_depth",
]


def inspect_file(path: Path) -> ImageHeader:
    """Header of an image file, and a cheap check that its end is there; nothing is decoded.

    Raises FrameError whose message is the reason alone, without the name of the file.
    """
    try:
        with files.open_regular(path, MOST_IMAGE_BYTES) as file:
            return checked(_inspect(file))
    except OSError as error:
        raise FrameError(f"the file cannot be read: {error.strerror}") from error
    except (UnusableFileError, ImageFileError) as error:
        raise FrameError(str(error)) from error


def header_of(data: bytes, name: str) -> ImageHeader:
    """The header of an image file in memory; a JPEG may be as large as one that is made smaller. Raises FrameError."""
    most = MOST_REDUCED_PIXELS if data.startswith(JPEG_START) else MOST_PIXELS
    try:
        return read_header(data, most)
    except NotAnImageError as error:
        raise FrameError(f"{name}: {NOT_DECODED}") from error
    except ImageFileError as error:
        raise FrameError(f"{name}: {error}") from error


def _inspect(file: BinaryIO) -> ImageHeader:
    start = file.read(png.HEADER_BYTES)
    if start.startswith(png.SIGNATURE):
        header = read_header(start)
        _check_png_end(file)
        return header
    start += file.read(START)
    if not start.startswith(JPEG_START):
        return read_header(start + file.read())
    try:
        jpeg = read_jpeg_header(start)
    except ImageFileError:  # pictures and profiles may come before the header
        start += file.read()
        jpeg = read_jpeg_header(start)
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - TAIL))
    if JPEG_END not in file.read():  # a film may follow: look where the image ends
        file.seek(0)
        check_jpeg(file.read())
    return ImageHeader("jpeg", *jpeg)


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


def _decode(data: bytes, flags: int, most_pixels: int = MOST_PIXELS) -> npt.NDArray[Any]:
    """Pixels as OpenCV gives them with `flags`, but three channels of 8 bits are always RGB. Raises ImageFileError."""
    try:
        header = read_header(data, most_pixels)
    except NotAnImageError as error:
        raise ImageFileError(NOT_DECODED) from error
    if header.kind == "png":
        # all chunks are checked first: libpng would print, and give back what it has
        pixels = png.decode(png.read_header(data[: png.HEADER_BYTES]), list(png.chunks(data)))
        if pixels is not None and (pixels.ndim == 3 or flags == cv2.IMREAD_UNCHANGED):
            return pixels
    elif header.kind == "jpeg":
        check_jpeg(data)
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it would print what is in the error
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageFileError(f"cannot be decoded: {error.err}") from error
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise ImageFileError(NOT_DECODED)
    return np.asarray(image)


def decode_color(data: bytes, name: str, reduce: int = 1) -> ImageArray:
    """RGB ``[H, W, 3]`` uint8 of a PNG, JPEG (or what else OpenCV decodes) in memory.

    Grey images get three equal channels, transparency is dropped, 16-bit images are scaled to 8 bits: from the 10, 12
    or 14 that they use where their values go no further. An orientation mark of a telephone is not applied: intrinsics
    belong to the pixels as stored. `reduce` of 2, 4 or 8 makes a JPEG smaller while it is decoded, which takes less
    memory: ``ceil(W / reduce)`` pixels, each the mean of those that it covers; other kinds are decoded as they are.
    `name` is for messages. Raises FrameError for what is no image, truncated, damaged or too large.
    """
    try:
        return _decode_color(data, reduce)
    except ImageFileError as error:
        raise FrameError(f"{name}: {error}") from error


_REDUCED = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}


def _decode_color(data: bytes, reduce: int) -> ImageArray:
    if reduce > 1 and data.startswith(JPEG_START):
        bgr = _decode(data, _REDUCED[reduce] | cv2.IMREAD_IGNORE_ORIENTATION, MOST_REDUCED_PIXELS)
        return np.ascontiguousarray(bgr[..., ::-1])
    if _is_deep(data):
        deep = _decode(data, cv2.IMREAD_UNCHANGED)
        if deep.dtype == np.uint16:
            return _eight_bits(deep)
    return np.asarray(_decode(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION), dtype=np.uint8)


def _is_deep(data: bytes) -> bool:
    try:
        return read_header(data).bits == 16
    except NotAnImageError:
        return False


def bits_used(pixels: npt.NDArray[np.uint16]) -> int:
    """16, or the 10, 12 or 14 bits that a camera with so many writes into the lower bits of 16."""
    highest = int(pixels.max(initial=0))
    return next((bits for bits in (10, 12, 14) if highest < 1 << bits), 16) if highest > 255 else 16


def _eight_bits(pixels: npt.NDArray[np.uint16]) -> ImageArray:
    """RGB uint8 of grey, BGR or BGRA uint16."""
    colours = pixels[..., :3] if pixels.ndim == 3 else pixels[..., None]
    small = (colours >> (bits_used(colours) - 8)).astype(np.uint8)
    if small.shape[2] == 3:
        return np.ascontiguousarray(small[..., ::-1])
    return np.repeat(small[..., :1], 3, axis=2)


def decode_color_grey(data: bytes, name: str) -> ImageArray:
    """Grey ``[H, W]`` uint8 of an image in memory, turned as `decode_color` has it. Raises FrameError."""
    try:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        if data.startswith(JPEG_START):  # its brightness is stored as such
            return np.asarray(_decode(data, flags), dtype=np.uint8)
        colours = _decode_color(data, 1)  # checked first: libpng would print, and give back what it has
        if data.startswith(b"\x89PNG") and data[24:25] != b"\x10":  # of at most 8 bits: as the decoder weighs colours
            grey = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
            if grey is not None:
                return np.asarray(grey, dtype=np.uint8)
        return np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    except ImageFileError as error:
        raise FrameError(f"{name}: {error}") from error


def has_size(data: bytes, size: tuple[int, int]) -> bool:
    """Whether an image in memory is of this width and height, as its header has it; True where that cannot be told."""
    try:
        header = read_header(data)
    except (NotAnImageError, ImageFileError):
        return True  # whoever decodes it says what is wrong
    return header.size == size


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
            f"{', as colour images have' if channels >= 3 else ''}"
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
    image = decode_any(data, name)
    if image.ndim != 2:
        raise FrameError(f"{name}: needs one channel, but has {image.shape[2]}")
    return image


def decode_any(data: bytes, name: str) -> npt.NDArray[Any]:
    """The values of an image in memory as they are; colour in OpenCV's order. Raises FrameError."""
    try:
        return _decode(data, cv2.IMREAD_UNCHANGED)
    except ImageFileError as error:
        raise FrameError(f"{name}: {error}") from error


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
    return _encode_png(values)


def encode_color(image: ImageArray) -> bytes:
    """A PNG file of RGB ``[H, W, 3]`` or grey ``[H, W]`` uint8; `decode_color` gives it back."""
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return _encode_png(pixels)


def _encode_png(pixels: npt.NDArray[Any]) -> bytes:
    """With OpenCV's own parameters: twice as fast as with its level 1, which takes another strategy, and 3 % larger."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not done:
        raise FrameError(f"an image of {pixels.shape[1]}x{pixels.shape[0]} pixels cannot be written as PNG")
    return bytes(data)


def read_bytes(path: Path) -> bytes:
    """The bytes of an image file. Raises FrameError when it is missing, no file, too large or cannot be read."""
    try:
        return files.read_bytes(path, MOST_IMAGE_BYTES)
    except files.MissingFileError as error:
        raise FrameError(f"{path}: no such file") from error
    except UnusableFileError as error:
        raise FrameError(f"{path}: {error}") from error


def read_query_image(path: Path) -> ImageArray:
    """RGB ``[H, W, 3]`` uint8 of an image file; see `decode_color`. Raises FrameError naming the file."""
    return decode_color(read_bytes(path), str(path))


def read_depth_image(path: Path, depth_scale: float, size: tuple[int, int]) -> Float32Array:
    """Depth ``[H, W]`` float32 metres of a 16-bit PNG file; see `decode_depth`. Raises FrameError naming the file."""
    return decode_depth(read_bytes(path), str(path), depth_scale, size)


def remark_on_color(image: ImageArray) -> str | None:
    """What people should know of an image that shows next to nothing; None of others."""
    some = np.ascontiguousarray(image[::4, ::4])
    if np.count_nonzero(some.max(axis=2) >= DARK) < 0.01 * some.shape[0] * some.shape[1]:
        return "the colour image is nearly black"
    if float(cv2.meanStdDev(some)[1].max()) < FLAT:
        return "the colour image is nearly empty: one colour"
    return None


def remark_on_depth(depth: Float32Array) -> str | None:
    """What people should know of a depth image with next to no depth; None of others."""
    if np.isfinite(depth).mean() < LEAST_DEPTH:
        return "the depth image is nearly empty"
    return None
