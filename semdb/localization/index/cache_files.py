"""The files of an index: arrays with checksums, vectors that are mapped. A file that is visible is complete.

Everything is written under another name, flushed to disk and renamed, and never changed afterwards, so that any
number of processes may read and write one folder. Files are only trusted when sizes and checksums agree.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import struct
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32

from semdb.errors import SemdbError
from semdb.localization.index.vectors import Part
from semdb.types import Float32Array

ARRAYS_MAGIC = b"SDBINDX2"
VECTORS_MAGIC = b"SDBVECT1"
_ARRAYS = struct.Struct("<8sII")  # magic, bytes of the JSON, its checksum
_VECTORS = struct.Struct("<8s16sQI28x")  # magic, id, rows, numbers per row
CHECK_ROWS = 256  # rows of vectors per checksum
CHECKED_BYTES = 2**30  # of a file of vectors that are checked when it is opened: the whole of it, or evenly spaced
ABANDONED_S = 3600.0  # age from which a file that no index names is deleted


class CacheError(SemdbError):
    """A cache file that cannot be used; the message says why. The index is then built anew."""


@dataclass(frozen=True, slots=True)
class VectorFile:
    """A file of vectors as the index names it."""

    name: str
    rows: int
    checksums: tuple[int, ...]  # CRC-32 of every `CHECK_ROWS` rows


@contextlib.contextmanager
def _written(path: Path) -> Any:
    """A file that gets its name when it is complete."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_arrays(path: Path, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Writes a JSON header and named arrays. Raises OSError."""
    described, start = [], 0
    for name, array in arrays.items():
        flat = np.ascontiguousarray(array)
        described.append([name, flat.dtype.str, list(flat.shape), start, crc32(flat.data)])
        start += flat.nbytes
    text = json.dumps({"header": header, "arrays": described}).encode()
    with _written(path) as file:
        file.write(_ARRAYS.pack(ARRAYS_MAGIC, len(text), crc32(text)) + text)
        for array in arrays.values():
            file.write(np.ascontiguousarray(array).data)


def read_arrays(path: Path) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Header and arrays of a file of `write_arrays`. Raises CacheError, FileNotFoundError."""
    with path.open("rb") as file:
        start = file.read(_ARRAYS.size)
        if len(start) < _ARRAYS.size:
            raise CacheError("it is truncated")
        magic, size, checksum = _ARRAYS.unpack(start)
        if magic != ARRAYS_MAGIC:
            raise CacheError("it is of another kind or version")
        text = file.read(size)
        if len(text) != size or crc32(text) != checksum:
            raise CacheError("its header is damaged")
        content = json.loads(text)
        first = file.tell()
        arrays = {name: _read_array(file, first, name, *rest) for name, *rest in content["arrays"]}
    return content["header"], arrays


def _read_array(
    file: BinaryIO, first: int, name: str, dtype: str, shape: list[int], start: int, checksum: int
) -> npt.NDArray[Any]:
    array = np.empty(shape, np.dtype(dtype))
    file.seek(first + start)
    if array.nbytes and file.readinto(array.reshape(-1).view(np.uint8).data) != array.nbytes:  # type: ignore[attr-defined]
        raise CacheError(f"the array {name} is truncated")
    if crc32(array.data) != checksum:
        raise CacheError(f"the array {name} is damaged")
    return array


def write_vectors(folder: Path, pieces: Iterable[Float32Array], size: int) -> VectorFile:
    """Writes pieces ``[n, size]`` one after the other as one file. Raises OSError."""
    name = f"vectors-{uuid.uuid4().hex}.f32"
    rows, checksums = 0, [0]
    with _written(folder / name) as file:
        file.write(bytes(_VECTORS.size))
        for piece in pieces:
            data = np.ascontiguousarray(piece, "<f4")
            file.write(data.data)
            start = 0
            while start < len(data):  # up to where the next checksum begins
                stop = min(len(data), start + CHECK_ROWS - rows % CHECK_ROWS)
                checksums[-1] = crc32(data[start:stop].data, checksums[-1])
                rows, start = rows + stop - start, stop
                checksums += [0] * (rows % CHECK_ROWS == 0)
        checksums = checksums[: -(-rows // CHECK_ROWS)]
        file.seek(0)
        file.write(_VECTORS.pack(VECTORS_MAGIC, bytes.fromhex(name[8:40]), rows, size))
    return VectorFile(name, rows, tuple(checksums))


def open_vectors(folder: Path, file: VectorFile, size: int, *, check: bool = True) -> Part:
    """The rows of a file, mapped into memory. Raises CacheError, FileNotFoundError."""
    opened = (folder / file.name).open("rb")
    try:
        expected = _VECTORS.pack(VECTORS_MAGIC, bytes.fromhex(file.name[8:40]), file.rows, size)
        if opened.read(_VECTORS.size) != expected:
            raise CacheError(f"{file.name} is not what the index names")
        if os.fstat(opened.fileno()).st_size != _VECTORS.size + file.rows * size * 4:
            raise CacheError(f"{file.name} is truncated")
        # a private mapping may be written, so that kernels see one kind of array; nobody writes
        mapping = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_COPY)
        array = np.frombuffer(mapping, np.dtype("<f4"), file.rows * size, _VECTORS.size).reshape(file.rows, size)
        part = Part(array, file.name, mapping, opened, _VECTORS.size)
        if check:
            _check_vectors(part, file, size)
    except BaseException:
        opened.close()
        raise
    return part


def _check_vectors(part: Part, file: VectorFile, size: int) -> None:
    blocks = len(file.checksums)
    if blocks != -(-file.rows // CHECK_ROWS):
        raise CacheError(f"{file.name} has checksums for other rows")
    part.bounded = True  # while it is looked through
    most = max(1, CHECKED_BYTES // (CHECK_ROWS * size * 4))
    for block in np.unique(np.linspace(0, blocks - 1, min(blocks, most)).astype(int)).tolist():
        piece = part.array[block * CHECK_ROWS : (block + 1) * CHECK_ROWS]
        if crc32(piece.data) != file.checksums[block]:
            raise CacheError(f"{file.name} is damaged near row {block * CHECK_ROWS}")
        part.passed(len(piece))
    part.bounded = False


def remove_abandoned(folder: Path, named: Iterable[str], age_s: float = ABANDONED_S) -> None:
    """Deletes files of vectors that no index names, and what killed writers left, once they are old."""
    keep = set(named)
    for path in [*folder.glob("vectors-*.f32"), *folder.glob("*.tmp")]:
        with contextlib.suppress(OSError):
            if path.name not in keep and time.time() - path.stat().st_mtime > age_s:
                path.unlink()
