"""Arrays and masks as blobs: little-endian, with dtype, shape, version and checksum, refused when anything is off.

Layout of an array: magic ``SDBA``, version (1 byte), dtype code (1), number of dimensions (1), zero (1), CRC-32 of
all other bytes (4), shape (4 each), data in C order. A mask (magic ``SDBM``) is the same with a one-dimensional
uint16 array: height, width, then the lengths of the runs of the row-major mask, the first run being background; a run
of more than 65535 pixels is several with runs of 0 between. Before there was version 2, which knows uint16, masks were
of uint32, and those of images with a side above 65535 still are. Keypoints may be compact: `semdb.database.compact`.
Descriptors of float that are stored as bytes (magic ``SDBQ``) are uint8, 128 more than `semdb.byte_descriptors` has.
"""

from __future__ import annotations

import math
import struct
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32

from semdb.byte_descriptors import are_bytes, to_bytes
from semdb.database.checked import MOST_PIXELS
from semdb.database.checked import blob as checked_blob
from semdb.database.compact import compact, expand
from semdb.errors import CodecError
from semdb.types import BoolArray, Features, Float32Array, Int64Array, IntArray, Keypoints

ARRAY_MAGIC = b"SDBA"
MASK_MAGIC = b"SDBM"
COMPACT_MAGIC = b"SDBK"
BYTES_MAGIC = b"SDBQ"
ZERO = 128  # the byte that stands for zero
VERSION = 2
LONGEST_RUN = 65535
KEYPOINT_COLUMNS = ("x", "y", "size", "angle", "response", "laplacian", "X", "Y", "Z")

_HEADER = struct.Struct("<4sBBBBI")
HEAD = _HEADER.size
_CHECKED = 8  # bytes of the header before the checksum
_DTYPES: dict[int, np.dtype[Any]] = {
    1: np.dtype("<f4"),
    2: np.dtype("u1"),
    3: np.dtype("<f8"),
    4: np.dtype("<i4"),
    5: np.dtype("<u4"),
    6: np.dtype("<f2"),
    7: np.dtype("<u2"),
}
_CODES = {dtype: code for code, dtype in _DTYPES.items()}
_SINCE = {7: 2}  # the version that dtype codes came with; 1 where not named


def encode_array(array: npt.NDArray[Any], *, magic: bytes = ARRAY_MAGIC) -> bytes:
    """`array` as a blob. Raises CodecError for a dtype that has no code (float16 to 64, uint8 to 32, int32)."""
    dtype = array.dtype.newbyteorder("<")
    code = _CODES.get(dtype)
    if code is None or array.ndim > 8:
        raise CodecError(f"an array of {array.dtype} with {array.ndim} dimensions cannot be stored")
    values = np.ascontiguousarray(array, dtype=dtype)
    sizes, data = struct.pack(f"<{array.ndim}I", *array.shape), values.reshape(-1).view(np.uint8).data
    start = _HEADER.pack(magic, _SINCE.get(code, 1), code, array.ndim, 0, 0)[:_CHECKED]
    checksum = crc32(data, crc32(sizes, crc32(start)))
    return b"".join((start, struct.pack("<I", checksum), sizes, data))


def decode_array(blob: bytes, where: str, *, magic: bytes = ARRAY_MAGIC) -> npt.NDArray[Any]:
    """The read-only array of a blob. `where` names the row for the message of the CodecError that it raises."""
    if len(blob) < _HEADER.size:
        raise CodecError(f"{where}: the blob is truncated ({len(blob)} bytes)")
    found, version, code, ndim, _, checksum = _HEADER.unpack_from(blob)
    if found != magic:
        raise CodecError(f"{where}: not a blob of this kind (it starts with {found!r}, expected {magic!r})")
    if not 1 <= version <= VERSION:
        raise CodecError(f"{where}: blob format {version} is unknown, this semdb reads 1 to {VERSION}; upgrade semdb")
    dtype = _DTYPES.get(code)
    if dtype is None or ndim > 8 or len(blob) < _HEADER.size + 4 * ndim:
        raise CodecError(f"{where}: the blob's header is damaged (dtype code {code}, {ndim} dimensions)")
    shape = struct.unpack_from(f"<{ndim}I", blob, _HEADER.size)
    start = _HEADER.size + 4 * ndim
    expected = start + dtype.itemsize * int(np.prod(shape, dtype=object)) if ndim else start + dtype.itemsize
    if len(blob) != expected:
        kind = "truncated" if len(blob) < expected else "too long"
        raise CodecError(f"{where}: the blob is {kind} ({len(blob)} bytes, shape {shape} needs {expected})")
    view = memoryview(blob)
    if crc32(view[_HEADER.size :], crc32(view[:_CHECKED])) != checksum:
        raise CodecError(f"{where}: the blob's checksum is wrong; delete the recording and ingest it again")
    try:
        return np.frombuffer(blob, dtype=dtype, offset=start).reshape(shape)
    except ValueError:  # nothing, in more dimensions than there is memory
        raise CodecError(f"{where}: no array has the shape {shape}") from None


def decode_vectors(
    blobs: Sequence[Any],
    keys: Int64Array,
    size: int | None = None,
    bad: Callable[[int, CodecError], None] | None = None,
) -> Float32Array:
    """CNN vectors float32 ``[n, d]`` of many blobs (``[0, 0]`` for none) of the keyframes `keys` ``[n]``.

    Each is checked as by `decode_array`, is normalised, and has `size` numbers, or as many as most have. One that is
    not is a row of zeros, unlike every other, and told to `bad`; without it, or where none is right, CodecError.
    """
    if not len(blobs):
        return np.empty((0, size or 0), np.float32)
    found = [_vector(blob, int(key)) for blob, key in zip(blobs, keys, strict=True)]
    sizes = Counter(len(vector) for vector in found if not isinstance(vector, CodecError))
    if size is None and sizes:
        size = max(sizes, key=lambda length: (sizes[length], length))
    matrix = np.zeros((len(blobs), size or 0), np.float32)
    for row, vector in enumerate(found):
        if isinstance(vector, CodecError):
            error = vector
        elif len(vector) == size:
            matrix[row] = vector
            continue
        else:
            error = CodecError(f"{_VECTOR} {keys[row]} has {len(vector)} numbers, and others have {size}")
        if bad is None or size is None:
            raise error
        bad(int(keys[row]), error)
    return matrix


_VECTOR = "cnn_vectors.vector of keyframe"
_MOST_OF_UNIT = 1.01  # a number of a vector of length one


def decode_packed(
    data: npt.NDArray[np.uint8],
    table: Int64Array,
    size: int | None = None,
    room: Float32Array | None = None,
) -> Float32Array | None:
    """The same of blobs that are in `data`, as the rows of `table` ``[n, 3]`` say (key, first byte, end).

    None where any is damaged or of another length, which `decode_vectors` tells apart. The vectors are in `room`
    ``[n or more, d]`` where it is given and fits.
    """
    lengths = table[:, 2] - table[:, 1]
    count, start = len(table), HEAD + 4
    length = int(lengths[0]) if count else 0
    numbers = (length - start) // 4
    if length <= start or (length - start) % 4 or (lengths != length).any() or size not in (None, numbers):
        return None
    if sys.byteorder != "little":
        return None  # numbers would have to be turned round
    if room is None or len(room) < count or room.shape[1] != numbers:
        room = np.empty((count, numbers), np.float32)
    head = _HEADER.pack(ARRAY_MAGIC, 1, _CODES[np.dtype("<f4")], 1, 0, 0)[:_CHECKED]
    sizes = struct.pack("<I", numbers)
    heads = data[table[:, 1:2] + np.arange(start)]
    if (heads[:, :_CHECKED] != np.frombuffer(head, np.uint8)).any() or (
        heads[:, HEAD:] != np.frombuffer(sizes, np.uint8)
    ).any():
        return None
    found, sums = room[:count], []
    given, out, at, seed = data.data, found.reshape(-1).view(np.uint8).data, 0, crc32(sizes, crc32(head))
    for first, last in table[:, 1:].tolist():
        end = at + length - start
        out[at:end] = given[first + start : last]
        sums.append(crc32(out[at:end], seed))
        at = end
    right = np.array_equal(np.array(sums, np.uint32), np.ascontiguousarray(heads[:, _CHECKED:HEAD]).view("<u4")[:, 0])
    in_range = found.max() <= _MOST_OF_UNIT and found.min() >= -_MOST_OF_UNIT  # neither holds for NaN
    return found if right and in_range else None


def _vector(blob: Any, key: int) -> Float32Array | CodecError:
    """One vector ``[d]``, or what is wrong with it."""
    where = f"{_VECTOR} {key}"
    try:
        found = decode_array(checked_blob(blob, where), where)
    except CodecError as error:
        return error
    if found.ndim != 1 or found.dtype != np.dtype("<f4") or not len(found):
        return CodecError(f"{where}: {found.dtype} {list(found.shape)} is not a vector")
    if not (np.abs(found) <= _MOST_OF_UNIT).all():
        return CodecError(f"{where} has numbers that no vector of length 1 has")
    return np.asarray(found, np.float32)


def encode_mask(mask: BoolArray) -> bytes:
    """A mask ``[H, W]`` as run lengths."""
    if mask.ndim != 2:
        raise CodecError(f"a mask has two dimensions, not {mask.ndim}")
    from semdb.database._runs import run_lengths

    if max(mask.shape) > LONGEST_RUN:
        runs = run_lengths(mask, max(1, mask.size))
        return encode_array(np.concatenate([mask.shape, runs]).astype("<u4"), magic=MASK_MAGIC)
    return encode_array(np.concatenate([mask.shape, run_lengths(mask, LONGEST_RUN)]).astype("<u2"), magic=MASK_MAGIC)


def decode_mask(blob: bytes, where: str, size: tuple[int, int] | None = None) -> BoolArray:
    """The mask ``[H, W]`` of a blob. Raises CodecError, also for one of another `size` (H, W), which is not made."""
    numbers = decode_array(blob, where, magic=MASK_MAGIC)
    if numbers.ndim != 1 or len(numbers) < 2 or numbers.dtype not in (np.dtype("<u2"), np.dtype("<u4")):
        raise CodecError(f"{where}: the mask has no size")
    height, width = int(numbers[0]), int(numbers[1])
    if size is not None and (height, width) != size:
        raise CodecError(f"{where}: a mask of {width}x{height} pixels, but the camera has {size[1]}x{size[0]}")
    if height * width > MOST_PIXELS:
        raise CodecError(f"{where}: a mask of {width}x{height} pixels is larger than any image that semdb reads")
    runs = numbers[2:].astype(np.int64)
    if int(runs.sum()) != height * width:
        raise CodecError(f"{where}: the mask's runs do not fill {width}x{height} pixels")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(height, width)


def encode_descriptors(descriptors: npt.NDArray[np.generic], dtype: str = "float32") -> bytes:
    """Descriptors ``[n, d]`` as a blob, those of float as `dtype`: ``float32``, ``float16`` or ``uint8``.

    Those of bits (uint8) stay as they are, and those of float that do not fit bytes (`semdb.byte_descriptors`).
    """
    if descriptors.dtype == np.int8:
        return encode_array((descriptors.astype(np.int16) + ZERO).astype(np.uint8), magic=BYTES_MAGIC)
    if descriptors.dtype == np.uint8:
        return encode_array(descriptors)
    if dtype != "uint8":
        return encode_array(descriptors.astype(dtype) if descriptors.dtype == np.float32 else descriptors)
    small = to_bytes(descriptors)
    return encode_array(descriptors) if small is None else encode_descriptors(small)


def dtype_of(head: bytes) -> str:
    """How descriptors of float are stored, by the first `HEAD` bytes of a blob: ``float32``, ``float16`` or ``uint8``.

    ``float32``, so that nothing is rounded, where the blob does not say it: its descriptors are of bits, or it is none.
    """
    if len(head) < _HEADER.size:
        return "float32"
    if head[:4] == BYTES_MAGIC:
        return "uint8"
    half = head[:4] == ARRAY_MAGIC and _DTYPES.get(_HEADER.unpack_from(head)[2]) == np.float16
    return "float16" if half else "float32"


def decode_descriptors(blob: bytes, where: str) -> npt.NDArray[np.generic]:
    """Descriptors ``[n, d]`` of a blob: float32, float16, uint8 of bits, or int8 of `semdb.byte_descriptors`.

    Raises CodecError for what is none of these.
    """
    small = blob[:4] == BYTES_MAGIC
    found = decode_array(blob, where, magic=BYTES_MAGIC if small else ARRAY_MAGIC)
    if found.ndim != 2 or found.dtype not in ((np.uint8,) if small else (np.float32, np.float16, np.uint8)):
        raise CodecError(f"{where}: {found.dtype} {list(found.shape)} are no descriptors")
    if not small:
        return found
    values: npt.NDArray[np.int8] = (found.astype(np.int16) - ZERO).astype(np.int8)
    if not are_bytes(values):
        raise CodecError(f"{where}: a descriptor of bytes is longer than a unit vector")
    return values


def encode_keypoints(keypoints: Keypoints, *, small: bool = False) -> bytes:
    """Keypoints packed as float32 ``[n, 9]``: x, y, size, angle, response, laplacian, X, Y, Z (camera frame, m).

    `small`: rounded to 16 bytes each (`semdb.database.compact`) where they can be.
    """
    features = keypoints.features
    packed = np.empty((len(features), 9), dtype=np.float32)
    packed[:, 0:2] = features.xy
    packed[:, 2] = features.size
    packed[:, 3] = features.angle
    packed[:, 4] = features.response
    packed[:, 5] = features.laplacian
    packed[:, 6:9] = keypoints.points
    return encode_packed(packed, small=small)


def encode_packed(packed: Float32Array, *, small: bool) -> bytes:
    """Rows float32 ``[n, 9]`` of keypoints as a blob; `small` as in `encode_keypoints`."""
    numbers = compact(packed) if small else None
    return encode_array(packed) if numbers is None else encode_array(numbers, magic=COMPACT_MAGIC)


def keypoint_rows(blob: bytes, where: str) -> Float32Array:
    """The rows float32 ``[n, 9]`` (`KEYPOINT_COLUMNS`) of keypoints of either kind. Raises CodecError."""
    if blob[:4] == COMPACT_MAGIC:
        with np.errstate(all="ignore"):  # what is no number is found by whoever looks at the values
            expanded = expand(decode_array(blob, where, magic=COMPACT_MAGIC))
        if expanded is None:
            raise CodecError(f"{where}: compact keypoints are uint16 [26 + 8 n]; these are not")
        return expanded
    packed = decode_array(blob, where)
    if packed.ndim != 2 or packed.shape[1] != 9 or packed.dtype != np.dtype("<f4"):
        raise CodecError(f"{where}: keypoints are float32 [n, 9], not {packed.dtype} {packed.shape}")
    return packed


def decode_keypoints(
    blob: bytes, descriptors: npt.NDArray[np.generic] | None, object_index: IntArray, where: str
) -> Keypoints:
    """Keypoints of a packed row. `descriptors` None leaves them out (shape ``[n, 0]``). Raises CodecError."""
    packed = keypoint_rows(blob, where)
    count = len(packed)
    if descriptors is None:
        descriptors = np.empty((count, 0), dtype=np.float32)
    if descriptors.dtype == np.float16:  # how they are stored; they are compared as float32
        descriptors = descriptors.astype(np.float32)
    if descriptors.ndim != 2 or len(descriptors) != count or len(object_index) != count:
        raise CodecError(
            f"{where}: {count} keypoints, descriptors {descriptors.shape}, {len(object_index)} in object slices"
        )
    columns: Float32Array = np.ascontiguousarray(packed.T, dtype=np.float32)
    features = Features(
        xy=np.ascontiguousarray(packed[:, 0:2], dtype=np.float32),
        size=columns[2],
        angle=columns[3],
        response=columns[4],
        laplacian=columns[5].astype(np.int8),
        descriptors=descriptors,
    )
    return Keypoints(features, object_index, np.ascontiguousarray(packed[:, 6:9], dtype=np.float32))


@dataclass(frozen=True, slots=True)
class Header:
    """What the head of a blob says; `size` is width and height of a mask."""

    magic: bytes
    dtype: str
    shape: tuple[int, ...]
    size: tuple[int, int] | None = None


def peek(blob: bytes) -> Header | None:
    """The head of an array, a mask or compact keypoints, unchecked; None for what is none or does not fit its size."""
    if len(blob) < _HEADER.size or blob[:4] not in (ARRAY_MAGIC, MASK_MAGIC, COMPACT_MAGIC, BYTES_MAGIC):
        return None
    magic, version, code, ndim, _, _ = _HEADER.unpack_from(blob)
    dtype = _DTYPES.get(code)
    start = _HEADER.size + 4 * ndim
    if dtype is None or ndim > 8 or not 1 <= version <= VERSION or len(blob) < start:
        return None
    shape = struct.unpack_from(f"<{ndim}I", blob, _HEADER.size)
    if len(blob) != start + dtype.itemsize * math.prod(shape):
        return None
    if magic != MASK_MAGIC:
        return Header(magic, dtype.name, shape)
    if math.prod(shape) < 2 or code not in (_CODES[np.dtype("<u2")], _CODES[np.dtype("<u4")]):
        return None
    height, width = np.frombuffer(blob, dtype, 2, start).tolist()
    return Header(magic, dtype.name, shape, (width, height))


def image_format(data: bytes | None) -> str:
    """``png``, ``jpeg`` or ``""`` by the first bytes of a file."""
    if data is None:
        return ""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    return "jpeg" if data.startswith(b"\xff\xd8\xff") else ""
