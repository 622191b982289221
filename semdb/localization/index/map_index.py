"""The index of a map: a mirror of the database in memory, kept up to date, and kept on disk for the next start."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from semdb.database.scanning import CoarseRows
from semdb.database.store import Store
from semdb.errors import CodecError
from semdb.localization.changes import ChangeReader, summary_of
from semdb.localization.coarse import MapChange
from semdb.localization.index.cache_files import CacheError
from semdb.localization.index.cache_folder import CacheFolder
from semdb.localization.index.loading import complete, load_mirror, same_as_database
from semdb.localization.index.mirror import IndexOptions, Mirror, reduced
from semdb.localization.index.state import State
from semdb.types import Int64Array

Progress = Callable[[int, int], None]
ATTEMPTS = 5  # to find a moment in which mirror and database can be compared
CHUNK = 2000  # keyframes that are read at once
REMEMBERED = 256  # refreshes whose changes are known to those who look again
FLUSH_ROWS = 8192  # vectors in memory from which they go to a file
SAVE_SHARE = 0.05  # of the keyframes that changed since the file was written, from which it is written again


class MapIndex:
    """A mirror of one map. Any number of threads and sources may share it; `refresh` is for all of them.

    Class scores are the integers of the SQL, cosines are exact in double precision. Up to `exact_up_to` keyframes
    `nearest` compares every vector; above, a scan of reduced vectors finds candidates that are then ranked exactly.
    """

    def __init__(self, store: Store, map_id: int, folder: CacheFolder | None, options: IndexOptions) -> None:
        """Use `open`."""
        self.store = store
        self.map_id = map_id
        self.options = options
        self.say: Callable[[str], None] | None = None
        self._folder = folder
        self._lock = threading.Lock()
        self._reader = ChangeReader(store, map_id)
        self._mirror = Mirror(options)
        self._unsaved = 0
        self._reducer: threading.Thread | None = None
        self._history: deque[tuple[int, MapChange]] = deque(maxlen=REMEMBERED)
        self._current: tuple[int, State] = (0, self._mirror.state())

    @classmethod
    def open(
        cls,
        store: Store,
        map_id: int,
        cache_dir: Path | None = None,
        *,
        options: IndexOptions | None = None,
        say: Callable[[str], None] | None = None,
        progress: Progress | None = None,
    ) -> MapIndex:
        """The index of a map, from its files below `cache_dir` where they are those of this database, else built.

        Files that are damaged, or do not agree with the database, are told of by `say` and built anew. Without
        `cache_dir`, or where it cannot be written, all is in memory. Raises DatabaseError, CodecError.
        """
        options = options or IndexOptions()
        folder = None if cache_dir is None else CacheFolder.of(cache_dir, store, map_id, say)
        index = cls(store, map_id, folder, options)
        index.say = say
        with index._lock:
            index._start(progress)
        return index

    def close(self) -> None:
        """Writes what is not on disk yet, for the next start."""
        self.settle()
        with self._lock:
            if self._unsaved:
                self._save()

    def __enter__(self) -> MapIndex:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def state(self) -> State:
        """The state as of the last refresh. It does not change, whatever happens to the map."""
        return self._current[1]

    @property
    def current(self) -> tuple[int, State]:
        """Number of the last refresh that changed anything, and the state as of it."""
        return self._current

    def changes_between(self, before: int, after: int) -> MapChange:
        """What changed after the refresh `before` up to the refresh `after`."""
        known = [change for number, change in list(self._history) if before < number <= after]
        if len(known) < after - before or any(change.everything for change in known):
            return MapChange(everything=True)
        added: set[int] = set()
        gone: set[int] = set()
        for change in known:
            added = (added - change.gone) | change.added
            gone |= change.gone
        return MapChange(frozenset(added), frozenset(gone))

    def refresh(self) -> None:
        """Takes in what changed in the database since the last call; the rest is not read again.

        A state that somebody holds stays as it is. Raises DatabaseError, CodecError.
        """
        with self._lock:
            before = self._reader.newest, self._reader.seen
            try:
                change = self._take_in()
            except BaseException:
                self._reader.restore(*before)  # the next call tries again; to take a change in twice does no harm
                raise
            if change:
                self._publish(change)
                self._tidy()

    def _take_in(self) -> MapChange:
        changes = self._reader.read()
        if changes is None:
            if not self._agrees():
                self._build("the log of changes was cut off, or the database is another one", None)
            return MapChange(everything=True)  # something may have been missed in between
        change = summary_of(changes)
        if change:
            self._apply(change)
        return change

    def _publish(self, change: MapChange) -> None:
        version = self._current[0] + 1
        self._history.append((version, change))
        self._current = (version, self._mirror.state())

    def _apply(self, change: MapChange) -> None:
        """Reads added and changed keyframes and drops what is gone."""
        state = self._mirror.state()
        added = np.array(sorted(change.added), np.int64)
        known = added[state.find(added)[1]]  # read when the index was built
        gone = np.array(sorted(change.gone), np.int64)
        self._mirror.remove(state, gone)
        wanted = np.setdiff1d(np.concatenate([added, gone]), known)
        for start in range(0, len(wanted), CHUNK):
            rows = self._rows(wanted[start : start + CHUNK], state.vectors.size)
            if len(rows.ids) and state.vectors.size not in (0, rows.vectors.shape[1]):
                self._build("its keyframes are described by another encoder now", None)
                return
            self._mirror.append(rows.ids, rows.vectors, rows.words)
        self._unsaved += len(gone) + len(wanted)
        if complete(self.store, self.map_id, self._mirror, changed=bool(change)):
            self._unsaved += len(self._mirror)

    def _rows(self, wanted: Int64Array, size: int) -> CoarseRows:
        """What is there of keyframes; vectors have `size` numbers where none says otherwise by being whole."""
        try:
            return self.store.coarse_rows(self.map_id, wanted, bad=self.store.left_out)
        except CodecError:
            if not size:
                raise
            return self.store.coarse_rows(self.map_id, wanted, size, self.store.left_out)

    def _agrees(self) -> bool:
        """Whether the mirror is as the database is; what is written while they are compared is taken in first."""
        if complete(self.store, self.map_id, self._mirror, changed=False):
            self._unsaved += len(self._mirror)
        for _ in range(ATTEMPTS):
            if same_as_database(self.store, self.map_id, self._mirror, self._mirror.state()):
                return True
            changes = self._reader.read()
            if not changes:
                return False
            self._apply(summary_of(changes))
        return False

    def _start(self, progress: Progress | None) -> None:
        if self._folder is not None:
            try:
                if self._load_files(self._folder):
                    return
                reason = ""
            except CacheError as error:
                reason = str(error)
            self._build(reason, progress)
        else:
            self._build("", progress)

    def _load_files(self, folder: CacheFolder) -> bool:
        """Whether there were files; they are up to date then. Raises CacheError when they cannot be used."""
        stored = folder.load(self.options)
        if stored is None:
            return False
        self._mirror = stored.mirror
        self._reader.restore(stored.newest, stored.seen)
        changes = self._reader.read()
        if changes is None:
            raise CacheError("the log of changes was cut off, or the database is another one")
        self._apply(summary_of(changes))
        if not self._agrees():
            raise CacheError("it does not agree with the database")
        self._publish(MapChange(everything=True))
        self._tidy()
        return True

    def _build(self, reason: str, progress: Progress | None) -> None:
        if reason and self.say is not None:
            self.say(f"the index of map {self.map_id} is built anew: {reason}")
        self._reader = ChangeReader(self.store, self.map_id)
        self._reader.skip()  # what is written from here on is read twice
        try:
            self._mirror = load_mirror(self.store, self.map_id, self._folder, self.options, progress)
        except OSError as error:
            if self.say is not None:
                self.say(f"the index is kept in memory alone: {error}")
            self._folder = None
            self._mirror = load_mirror(self.store, self.map_id, None, self.options, progress)
        self._unsaved = len(self._mirror)
        self._mirror.reduce()
        self._publish(MapChange(everything=True))
        self._save()

    def _tidy(self) -> None:
        """Writes to disk what has become much, and lets a map that has grown large be reduced."""
        mirror = self._mirror
        many = mirror.tail is not None and len(mirror.tail) >= FLUSH_ROWS
        if many or self._unsaved > max(FLUSH_ROWS // 8, SAVE_SHARE * len(mirror)):
            self._save()
        if mirror.wants_reduction() and not self._reducing():
            self._reducer = threading.Thread(target=self._reduce, args=(mirror,), name="index-reduce", daemon=True)
            self._reducer.start()

    def settle(self) -> None:
        """Waits until reduced vectors that are being worked out are in use."""
        while self._reducing() and self._reducer is not None:
            self._reducer.join()

    def _reducing(self) -> bool:
        return self._reducer is not None and self._reducer.is_alive()

    def _reduce(self, mirror: Mirror) -> None:
        """Works out reduced vectors beside the queries and refreshes, which go on without them until they are there."""
        with self._lock:
            vectors, renumbered = mirror.state().vectors, mirror.renumbered
        try:
            found = reduced(vectors, self.options.components)
        except OSError as error:
            if self.say is not None:
                self.say(f"the index of map {self.map_id} stays without reduced vectors for now: {error}")
            return
        with self._lock:
            if mirror is not self._mirror or mirror.renumbered != renumbered:
                return  # its rows are others now: the next refresh that changes anything starts again
            mirror.set_reduction(*found)
            self._unsaved += len(mirror)
            self._current = (self._current[0], mirror.state())
            self._save()

    def _save(self) -> None:
        if self._folder is None:
            self._unsaved = 0
            return
        self._folder.save(self._mirror, self._reader)
        self._unsaved = 0
        self._current = (self._current[0], self._mirror.state())
