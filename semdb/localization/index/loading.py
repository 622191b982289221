"""Building a mirror from the database, and comparing the two."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from semdb.class_score import MOST_OBJECTS, word
from semdb.database.scanning import MapSums
from semdb.database.store import Store
from semdb.localization.index.cache_folder import CacheFolder
from semdb.localization.index.mirror import IndexOptions, Mirror, category_matrix
from semdb.localization.index.state import State
from semdb.localization.index.vectors import Part
from semdb.types import Float32Array, Int64Array

Progress = Callable[[int, int], None]
COMPARED = 64  # vectors that are compared with the database's


def load_mirror(
    store: Store, map_id: int, folder: CacheFolder | None, options: IndexOptions, progress: Progress | None
) -> Mirror:
    """A mirror of the map; its vectors in a file of `folder`, or in memory. Raises DatabaseError, CodecError.

    It is read in many transactions: keyframes that are written meanwhile are in it wholly or not at all, and the log
    of changes has them after it.
    """
    expected, completion = store.keyframe_count(map_id), store.completion_of(map_id)
    read: list[Int64Array] = []

    def pieces() -> Iterator[Float32Array]:
        done = 0
        for ids, vectors in store.iter_vectors(map_id, bad=store.left_out, in_turn=folder is not None):
            read.append(ids)
            yield vectors
            done += len(ids)
            if progress is not None:
                progress(min(done, expected), expected)

    parts = _parts(pieces(), folder)
    ids = np.concatenate(read) if read else np.empty(0, np.int64)
    names, counts = category_matrix(ids, words_of_map(store, map_id, completed=completion is not None))
    mirror = Mirror(options)
    mirror.completion = completion
    mirror.set_rows(ids, np.ones(len(ids), np.bool_), names, counts, parts)
    return mirror


def words_of_map(store: Store, map_id: int, *, completed: bool) -> dict[str, tuple[Int64Array, Int64Array]]:
    """Keyframes (ascending) and numbers ``[n]`` of each word of a map; `completed`: as landmarks complete them."""
    columns: dict[str, tuple[Int64Array, Int64Array]] = {}
    for key, name in store.map_categories(map_id):
        keys, numbers = store.category_columns(map_id, key, completed)
        columns.update((word(name, part), (keys, column)) for part, column in numbers.items())
    return columns


def complete(store: Store, map_id: int, mirror: Mirror, *, changed: bool) -> bool:
    """Brings words as landmarks complete them into a mirror that is as the map is otherwise; whether there was need.

    Where landmarks complete none any more, they are as they were seen. All are read where the map has `changed`, or
    something else completes them.
    """
    completion = store.completion_of(map_id)
    if completion == mirror.completion and (completion is None or not changed):
        return False
    mirror.set_words(mirror.state(), words_of_map(store, map_id, completed=completion is not None))
    mirror.completion = completion
    return True


def _parts(pieces: Iterator[Float32Array], folder: CacheFolder | None) -> list[Part]:
    first = next((piece for piece in pieces if len(piece)), None)
    if first is None:
        return []

    def all_pieces() -> Iterator[Float32Array]:
        yield first
        yield from pieces

    if folder is not None:
        return folder.store_vectors(all_pieces(), first.shape[1])
    return [Part(np.concatenate(list(all_pieces())))]


def same_as_database(store: Store, map_id: int, mirror: Mirror, state: State) -> bool:
    """Whether the mirror has the keyframes and objects that the database has, as far as sums and samples tell."""
    living = state.ids if state.living == len(state.ids) else state.ids[state.alive]
    mine = MapSums(len(living), int(living.sum()), *mirror.sums(state))
    completed = mirror.completion is not None
    if store.map_sums(map_id, completed) != mine:
        return False
    if not len(living):
        return True
    sample = living[np.unique(np.linspace(0, len(living) - 1, COMPARED).astype(int))]
    rows = store.coarse_rows(map_id, sample, state.vectors.size, store.left_out, completed)
    if len(rows.ids) != len(np.unique(sample)) or rows.vectors.shape[1] != state.vectors.size:
        return False
    places, _ = state.find(rows.ids)
    if not np.array_equal(state.vectors.take(places), rows.vectors):
        return False
    place_of = dict(zip(rows.ids.tolist(), places.tolist(), strict=True))
    return all(
        name in state.categories
        and state.counts[state.categories[name], place_of[keyframe_id]] == min(number, MOST_OBJECTS)
        for keyframe_id, name, number in rows.words
    )
