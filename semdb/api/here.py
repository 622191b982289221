"""What a database has in memory in this process, and that a forked one begins with nothing."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol
from weakref import WeakSet

from semdb.database.store import Store, open_store
from semdb.errors import UsageError
from semdb.settings import Settings

if TYPE_CHECKING:
    from semdb.ingestion.run import Describers
    from semdb.landmarks.words import Vectors
    from semdb.localization.on_disk import RecordingsOnDisk
    from semdb.localization.open_maps import OpenMaps
    from semdb.types import Float32Array

MOST_WORDS = 10_000  # of which vectors are kept


class Here:
    """Connections, open maps, networks. Threads may share it."""

    def __init__(self, settings: Settings, say: Callable[[str], None]) -> None:
        self.settings = settings
        self.say = say
        self._turn = threading.RLock()
        self._store: Store | None = None
        self._maps: OpenMaps | None = None
        self._on_disk: RecordingsOnDisk | None = None
        self._describers: Describers = {}
        self._words: Vectors | None = None
        self._closed = False

    def anew(self) -> Here:
        """The same with nothing in memory."""
        other = Here(self.settings, self.say)
        other._closed = self._closed
        return other

    def check_open(self) -> None:
        """Raises UsageError where it was closed."""
        if self._closed:
            raise UsageError("this database is closed: open it again with semdb.open")

    def store(self, *, create: bool) -> Store:
        """The store, connected to when it is first asked for; with `create` a SQLite file may be made."""
        with self._turn:
            self.check_open()
            if self._store is None:
                self._store = open_store(self.settings.database_url, create=create, say=self.say)
            return self._store

    def maps(self) -> OpenMaps:
        """The maps, which stay open."""
        from semdb.localization.open_maps import OpenMaps

        with self._turn:
            store = self.store(create=False)
            if self._maps is None:
                self._maps = OpenMaps(store, self.settings, say=self.say)
            return self._maps

    def on_disk(self) -> RecordingsOnDisk:
        """The recordings on disk that images were seen in."""
        from semdb.localization.on_disk import RecordingsOnDisk

        with self._turn:
            if self._on_disk is None:
                self._on_disk = RecordingsOnDisk()
            return self._on_disk

    def words(self) -> Vectors | None:
        """What makes vectors of words, each of them once; None where `SEMDB_WORDS` is not set. Raises ModelError."""
        from semdb.perception.word_vectors import load_words

        with self._turn:
            self.check_open()
            if self._words is None:
                network = load_words(self.settings)
                self._words = None if network is None else _remembered(network.vectors)
            return self._words

    @contextmanager
    def describers(self) -> Iterator[Describers]:
        """The networks of earlier ingests; two ingests at once have their own."""
        with self._turn:
            self.check_open()
            lent, self._describers = self._describers, {}
        try:
            yield lent
        finally:
            with self._turn:
                if not self._closed:
                    self._describers = lent

    def close(self) -> None:
        """Lets go of everything; it cannot be used again."""
        with self._turn:
            self._closed = True
            store, maps = self._store, self._maps
            self._store, self._maps, self._describers, self._words = None, None, {}, None
        try:
            if maps is not None:
                maps.close()
        finally:
            if store is not None:
                store.close()


def _remembered(make: Vectors) -> Vectors:
    """`make`, which is asked for each text once."""
    import numpy as np

    known: dict[str, Float32Array] = {}

    def vectors(texts: Sequence[str]) -> Float32Array:
        new = [text for text in dict.fromkeys(texts) if text not in known]
        if len(known) + len(new) > MOST_WORDS:
            known.clear()
            new = list(dict.fromkeys(texts))
        known.update(zip(new, make(new), strict=True))
        return np.stack([known[text] for text in texts])

    return vectors


class HasHere(Protocol):
    """Something that keeps a `Here`."""

    _here: Here


_living: WeakSet[HasHere] = WeakSet()
_left_behind: list[Here] = []  # a forked process must not take down threads and connections that are its parent's


def forget_after_fork(owner: HasHere) -> None:
    """In a process that is forked off, `owner` has a `Here` of its own, with nothing in it."""
    _living.add(owner)


def _begin_anew() -> None:
    _give_opencv_threads_back()
    for owner in list(_living):
        _left_behind.append(owner._here)
        owner._here = owner._here.anew()


_opencv_threads: list[int] = []


def _end_opencv_threads() -> None:
    """OpenCV would wait for ever in the child for threads that are not there; it starts others when it needs them."""
    cv2 = sys.modules.get("cv2")
    if cv2 is not None and len(_living):
        _opencv_threads.append(cv2.getNumThreads())
        cv2.setNumThreads(1)


def _give_opencv_threads_back() -> None:
    if _opencv_threads:
        sys.modules["cv2"].setNumThreads(_opencv_threads.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_end_opencv_threads, after_in_parent=_give_opencv_threads_back, after_in_child=_begin_anew
    )
