"""The vectors of a map, row after row, in parts: files that are mapped, and a tail in memory that grows."""

from __future__ import annotations

import errno
import itertools
import mmap
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from semdb.localization.ranking import exact_cosines
from semdb.types import Float32Array, FloatArray, Int64Array

DROP_AFTER = 128 * 2**20  # bytes of a mapped file after which its pages leave the memory of this process

PIECE = 4096  # rows that are looked at together


@dataclass(slots=True, eq=False)
class Part:
    """Rows ``array[:n]`` in memory or of a mapped file (then `name` and the rest are set); they never change."""

    array: Float32Array  # [n, d]
    name: str = ""
    mapping: mmap.mmap | None = None
    file: BinaryIO | None = None
    offset: int = 0  # of the first row in the file
    bounded: bool = False  # little of the file is to be in memory at a time
    _passed: int = 0

    def __len__(self) -> int:
        return len(self.array)

    def take(self, rows: Int64Array) -> Float32Array:
        """These rows ``[n, d]``, copied.

        Of a file that is to take little memory they are read, not mapped: the kernel maps many pages around each one
        that is touched, and they all count as memory of this process. Raises OSError.
        """
        if not self.bounded or self.file is None:
            return self.array[rows]
        out = np.empty((len(rows), self.array.shape[1]), np.float32)
        size, number = out.shape[1] * 4, self.file.fileno()
        view = out.reshape(-1).view(np.uint8).data
        for place, row in enumerate(rows.tolist()):
            if os.preadv(number, [view[place * size : (place + 1) * size]], self.offset + row * size) != size:
                raise OSError(errno.EIO, f"{self.name} is shorter than it was")
        return out

    def cosines(self, rows: Int64Array, vector: Float32Array) -> FloatArray:
        """Exact cosines float64 ``[n]`` of these rows with `vector` ``[d]``."""
        if not self.bounded or self.file is None:
            return exact_cosines(self.array, rows, vector)
        out = np.empty(len(rows), np.float64)
        for start in range(0, len(rows), PIECE):
            piece = self.take(rows[start : start + PIECE])
            out[start : start + PIECE] = exact_cosines(piece, np.arange(len(piece)), vector)
        return out

    def passed(self, rows: int) -> None:
        """Counts what was read in order. Pages count as memory of this process until they are given back."""
        self._passed += rows * self.array.shape[1] * 4
        if self.bounded and self.mapping is not None and self._passed > DROP_AFTER:
            self._passed = 0
            self.mapping.madvise(mmap.MADV_DONTNEED)


@dataclass(frozen=True, slots=True, eq=False)
class Vectors:
    """The parts of one state of a map; part p holds the rows ``starts[p]`` to ``starts[p + 1]``."""

    parts: tuple[Part, ...] = ()

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def size(self) -> int:
        """Numbers in a vector; 0 where there is none."""
        return self.parts[0].array.shape[1] if self.parts else 0

    def starts(self) -> list[int]:
        return list(itertools.accumulate((len(part) for part in self.parts), initial=0))

    def cosines(self, rows: Int64Array, vector: Float32Array) -> FloatArray:
        """Exact cosines float64 ``[n]`` of these rows with `vector` ``[d]``."""
        if len(self.parts) == 1:
            return self.parts[0].cosines(rows, vector)
        out = np.empty(len(rows), np.float64)
        for part, start in zip(self.parts, self.starts(), strict=False):
            inside = np.flatnonzero((rows >= start) & (rows < start + len(part)))
            if len(inside):
                out[inside] = part.cosines(rows[inside] - start, vector)
        return out

    def take(self, rows: Int64Array) -> Float32Array:
        """These rows ``[n, d]``, copied."""
        out = np.empty((len(rows), self.size), np.float32)
        for part, start in zip(self.parts, self.starts(), strict=False):
            inside = np.flatnonzero((rows >= start) & (rows < start + len(part)))
            out[inside] = part.take(rows[inside] - start)
        return out

    def chunks(self, first: int = 0, size: int = PIECE) -> Iterator[tuple[int, Float32Array]]:
        """Row number and rows of pieces that cover everything from the row `first` on."""
        for part, start in zip(self.parts, self.starts(), strict=False):
            for begin in range(max(0, first - start), len(part), size):
                piece = part.array[begin : begin + size]
                yield start + begin, piece
                part.passed(len(piece))


class Tail:
    """Rows in memory that grow at the end; what was given out stays as it is."""

    def __init__(self, size: int) -> None:
        self._rows = np.empty((64, size), np.float32)
        self._count = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return self._count

    def append(self, vectors: Float32Array) -> None:
        with self._lock:
            needed = self._count + len(vectors)
            if needed > len(self._rows):
                grown = np.empty((max(needed, 2 * len(self._rows)), self._rows.shape[1]), np.float32)
                grown[: self._count] = self._rows[: self._count]
                self._rows = grown
            self._rows[self._count : needed] = vectors
            self._count = needed

    def part(self) -> Part:
        return Part(self._rows[: self._count])
