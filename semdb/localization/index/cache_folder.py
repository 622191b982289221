"""The folder of one map's index: which files it has, and whether they are those of this database.

``CACHE/index/DATABASE/map-ID/`` holds ``index.sdb`` (ids, counts, codes, and what they were made from) and the files
of vectors that it names. A new ``index.sdb`` replaces the old one in one step; files of vectors never change.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semdb.database.engine import sqlite_path
from semdb.database.store import Store
from semdb.localization.changes import ChangeReader
from semdb.localization.index.cache_files import (
    CacheError,
    VectorFile,
    open_vectors,
    read_arrays,
    remove_abandoned,
    write_arrays,
    write_vectors,
)
from semdb.localization.index.mirror import IndexOptions, Mirror
from semdb.localization.index.reduction import Reduction
from semdb.localization.index.vectors import Part
from semdb.rights import folder_problem
from semdb.types import Float32Array

FORMAT = 1
MOST_PARTS = 8  # files of vectors from which the small ones become one
MOST_DEAD = 0.25  # of the rows from which the living are written anew
ATTEMPTS = 3  # another process may replace files while they are read


@dataclass(frozen=True, slots=True)
class StoredIndex:
    """A mirror from files, and how far it had followed the log of changes."""

    mirror: Mirror
    newest: int
    seen: tuple[int, ...]


class CacheFolder:
    """Reads and writes the files of one map's index."""

    def __init__(self, path: Path, store: Store, map_id: int, say: Callable[[str], None] | None = None) -> None:
        self.path = path
        self._store = store
        self._map_id = map_id
        self._say = say
        self._files: dict[str, VectorFile] = {}
        self._failed = False

    @classmethod
    def of(
        cls, cache_dir: Path, store: Store, map_id: int, say: Callable[[str], None] | None = None
    ) -> CacheFolder | None:
        """The folder of a map below the cache folder, made if need be; None where it cannot be made or trusted."""
        path = cache_dir.expanduser() / "index" / database_key(store) / f"map-{map_id}"
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            if say is not None:
                say(f"the index is kept in memory alone: {path} cannot be made ({error.strerror})")
            return None
        problem = folder_problem(path)
        if problem is not None:
            if say is not None:
                say(f"the index is kept in memory alone, because others could write its files: {problem}")
            return None
        return cls(path, store, map_id, say)

    @property
    def _index(self) -> Path:
        return self.path / "index.sdb"

    def load(self, options: IndexOptions) -> StoredIndex | None:
        """The mirror of the files; None where there are none. Raises CacheError when they cannot be used."""
        for attempt in range(ATTEMPTS):
            if not self._index.exists():
                return None
            try:
                return self._load(options)
            except FileNotFoundError as error:
                if attempt == ATTEMPTS - 1:
                    raise CacheError(f"{error.filename} is missing") from error
            except OSError as error:
                raise CacheError(f"{self.path} cannot be read ({error.strerror})") from error
            except (CacheError, KeyError, TypeError, ValueError) as error:
                raise CacheError(f"{self._index}: {error}") from error
        return None

    def _load(self, options: IndexOptions) -> StoredIndex:
        header, arrays = read_arrays(self._index)
        self._check_origin(header)
        files = [VectorFile(name, rows, tuple(checksums)) for name, rows, checksums in header["files"]]
        parts = [open_vectors(self.path, file, header["size"]) for file in files]
        ids, alive, counts = arrays["ids"], arrays["alive"], arrays["counts"]
        rows = sum(len(part) for part in parts)
        if not len(ids) == len(alive) == counts.shape[1] == rows or len(counts) != len(header["categories"]):
            raise CacheError("its arrays do not belong together")
        self._files = {file.name: file for file in files}
        mirror = Mirror(options)
        mirror.completion = header.get("completion")  # files of before have none
        mirror.set_rows(ids, alive, header["categories"], counts, parts)
        if "codes" in arrays and rows > options.exact_up_to and len(arrays["axes"]) == options.components:
            reduction = Reduction(arrays["mean"], arrays["axes"], arrays["scales"], header["fitted_on"])
            mirror.set_reduction(reduction, arrays["codes"])
        return StoredIndex(mirror, header["newest"], tuple(header["seen"]))

    def _check_origin(self, header: dict[str, Any]) -> None:
        if header["format"] != FORMAT:
            raise CacheError("it is of another version of semdb")
        if header["database"] != database_key(self._store) or header["map"] != self._store.map_identity(self._map_id):
            raise CacheError("it is of another database or map")
        newest = header["newest"]
        if newest and self._store.change_text(self._map_id, newest) != header["newest_change"]:
            raise CacheError("the database was made anew or restored, or its log of changes was cut off")

    def store_vectors(self, pieces: Iterable[Float32Array], size: int) -> list[Part]:
        """Writes vectors to a new file and maps it. Raises OSError."""
        file = write_vectors(self.path, pieces, size)
        self._files[file.name] = file
        return [open_vectors(self.path, file, size, check=False)]

    def save(self, mirror: Mirror, reader: ChangeReader) -> None:
        """Writes what is not on disk; tells once when that fails, and all stays in memory."""
        try:
            self._save_vectors(mirror)
            self._save_index(mirror, reader)
            self._failed = False
        except OSError as error:
            if not self._failed and self._say is not None:
                self._say(f"the index cannot be kept in {self.path}: {error.strerror or error}")
            self._failed = True

    def _save_vectors(self, mirror: Mirror) -> None:
        bounded = mirror.reduction is not None
        if mirror.tail is not None and len(mirror.tail):
            part = mirror.tail.part()
            mirror.parts += self.store_vectors([part.array], part.array.shape[1])
            mirror.tail = None
        in_memory = any(not part.name or not (self.path / part.name).exists() for part in mirror.parts)
        if mirror.dead > MOST_DEAD * len(mirror) or in_memory:
            pieces = mirror.living_vectors()
            mirror.keep_living(self.store_vectors(pieces, mirror.parts[0].array.shape[1]) if mirror.parts else [])
        elif len(mirror.parts) > MOST_PARTS:
            first = first_to_merge([len(part) for part in mirror.parts])
            small = mirror.parts[first:]
            mirror.parts[first:] = self.store_vectors((part.array for part in small), small[0].array.shape[1])
        if bounded:
            mirror.bound_memory()

    def _save_index(self, mirror: Mirror, reader: ChangeReader) -> None:
        files = [self._files[part.name] for part in mirror.parts]
        header = {
            "format": FORMAT,
            "database": database_key(self._store),
            "map": self._store.map_identity(self._map_id),
            "newest": reader.newest,
            "newest_change": self._store.change_text(self._map_id, reader.newest) if reader.newest else None,
            "seen": sorted(reader.seen),
            "categories": list(mirror.categories),
            "size": mirror.parts[0].array.shape[1] if mirror.parts else 0,
            "files": [[file.name, file.rows, file.checksums] for file in files],
            "completion": mirror.completion,
            "fitted_on": mirror.reduction.fitted_on if mirror.reduction is not None else 0,
        }
        write_arrays(self._index, header, mirror.arrays())
        for file in files:
            with contextlib.suppress(OSError):
                os.utime(self.path / file.name)
        self._files = {file.name: file for file in files}
        remove_abandoned(self.path, self._files)


def first_to_merge(rows: Sequence[int]) -> int:
    """From which of these files on they become one, so that each row is written again a few times only."""
    first = len(rows) - 1
    while first > 0 and rows[first - 1] < 2 * sum(rows[first:]):
        first -= 1
    return min(first, len(rows) - 2)


def database_key(store: Store) -> str:
    """A name for a database's folder: of where it is, not of who asks."""
    url = store.engine.url
    path = sqlite_path(url)
    where = str(path.resolve()) if path is not None else f"{url.host}:{url.port or 3306}/{url.database}"
    return hashlib.sha256(where.encode()).hexdigest()[:16]
