"""The vectors of a map, row after row, in parts: files that are mapped, and a tail in memory that grows."""

from __future__ import annotations

import itertools
import mmap
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semdb.localization.ranking import exact_cosines
from semdb.types import Float32Array, FloatArray, Int64Array

DROP_AFTER = 128 * 2**20  # bytes read at random after which the pages of a mapped file leave the process's memory


@dataclass(slots=True, eq=False)
class Part:
    """Rows ``array[:n]`` of a file (then `name` and `mapping` are set) or in memory; never changed once visible."""

    array: Float32Array  # [n, d]
    name: str = ""
    mapping: mmap.mmap | None = None
    bounded: bool = False  # pages of the file may leave memory
    _read: int = 0

    def __len__(self) -> int:
        return len(self.array)

    def touched(self, rows: int) -> None:
        """Counts what was read. Pages count as memory of this process until they are given back."""
        self._read += rows * self.array.shape[1] * 4
        if self.bounded and self.mapping is not None and self._read > DROP_AFTER:
            self._read = 0
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
            self.parts[0].touched(len(rows))
            return exact_cosines(self.parts[0].array, rows, vector)
        out = np.empty(len(rows), np.float64)
        for part, start in zip(self.parts, self.starts(), strict=False):
            inside = np.flatnonzero((rows >= start) & (rows < start + len(part)))
            if len(inside):
                out[inside] = exact_cosines(part.array, rows[inside] - start, vector)
                part.touched(len(inside))
        return out

    def take(self, rows: Int64Array) -> Float32Array:
        """These rows ``[n, d]``, copied."""
        out = np.empty((len(rows), self.size), np.float32)
        for part, start in zip(self.parts, self.starts(), strict=False):
            inside = np.flatnonzero((rows >= start) & (rows < start + len(part)))
            out[inside] = part.array[rows[inside] - start]
            part.touched(len(inside))
        return out

    def chunks(self, first: int = 0, size: int = 4096) -> Iterator[tuple[int, Float32Array]]:
        """Row number and rows of pieces that cover everything from the row `first` on."""
        for part, start in zip(self.parts, self.starts(), strict=False):
            for begin in range(max(0, first - start), len(part), size):
                piece = part.array[begin : begin + size]
                yield start + begin, piece
                part.touched(len(piece))


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
