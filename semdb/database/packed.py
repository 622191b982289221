"""Many rows of a whole number and a blob in one piece of memory, which is used again for the next ones.

Python takes longer to make an object of each of many small blobs, and the system to find memory for them, than a server
takes to send them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.types import Int64Array

FIRST_BYTES = 1 << 20


class Numbers:
    """Whole numbers of rows that have nothing else, in the order in which they came."""

    def __init__(self) -> None:
        self._pieces: list[Int64Array] = [np.empty(0, np.int64)]

    def add_many(self, numbers: Int64Array) -> None:
        """More of them ``[n]``; copied."""
        self._pieces.append(numbers.copy())

    def all(self) -> Int64Array:
        """All ``[n]``."""
        return np.concatenate(self._pieces)


class PackedRows:
    """Keys int64 ``[n]``, and where in `data` (bytes) the blob of each begins and ends, int64 ``[n]`` each.

    Rows that are of another kind (no blob, one of more than a packet of a server) are in `others` instead.
    """

    def __init__(self) -> None:
        self.data: npt.NDArray[np.uint8] = np.empty(FIRST_BYTES, np.uint8)
        self.clear()

    def clear(self) -> None:
        """Forgets all rows; the memory stays."""
        self.used = 0  # bytes of `data`
        self.others: list[tuple[Any, Any]] = []
        self._tables: list[Int64Array] = []
        self._added: list[tuple[int, int, int]] = []

    def reserve(self, size: int) -> None:
        """Makes room for `size` bytes after those in use, which stay where they are."""
        if self.used + size > len(self.data):
            grown = np.empty(max(self.used + size, 2 * len(self.data)), np.uint8)
            grown[: self.used] = self.data[: self.used]
            self.data = grown

    def add_table(self, table: Int64Array) -> None:
        """Rows ``[n, 3]`` (key, first byte, end) whose blobs are in `data` already."""
        self._tables.append(table.copy())

    def add(self, key: Any, blob: Any) -> None:
        """One more row, as a driver has it."""
        if not (isinstance(key, int) and isinstance(blob, bytes)):
            self.others.append((key, blob))
            return
        self.reserve(len(blob))
        start, self.used = self.used, self.used + len(blob)
        self.data[start : self.used] = memoryview(blob)
        self._added.append((key, start, self.used))

    def keep(self, keys: Int64Array) -> None:
        """Forgets the rows of all keys but these, ascending."""
        table = self.table()
        place = np.minimum(np.searchsorted(keys, table[:, 0]), max(0, len(keys) - 1))
        self._tables, self._added = [table[keys[place] == table[:, 0]] if len(keys) else table[:0]], []
        known = set(keys.tolist()) if self.others else set()
        self.others = [row for row in self.others if row[0] in known]

    def __len__(self) -> int:
        return sum(map(len, self._tables)) + len(self._added) + len(self.others)

    def keys(self) -> set[int]:
        return {*self.table()[:, 0].tolist(), *(row[0] for row in self.others)}

    def table(self) -> Int64Array:
        """All rows ``[n, 3]`` by ascending key, but for `others`."""
        joined = np.concatenate([*self._tables, np.array(self._added, np.int64).reshape(-1, 3)])
        keys = joined[:, 0]
        return joined if (keys[1:] >= keys[:-1]).all() else joined[np.argsort(keys, kind="stable")]

    def rows(self) -> list[tuple[Any, Any]]:
        """All rows with their blobs as bytes, by ascending key."""
        view = self.data.data
        own = [(key, view[start:end].tobytes()) for key, start, end in self.table().tolist()]
        return sorted([*own, *self.others], key=lambda row: int(row[0])) if self.others else own
