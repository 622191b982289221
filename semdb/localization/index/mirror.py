"""The arrays of an index while they grow: one writer adds and removes rows, readers have states that stay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from semdb.class_score import MOST_OBJECTS
from semdb.localization.index.kernels import ByteArray, CodeArray
from semdb.localization.index.reduction import Reduction, fit_reduction, sample_rows
from semdb.localization.index.state import State, order_of
from semdb.localization.index.vectors import Part, Tail, Vectors
from semdb.types import BoolArray, Float32Array, Int64Array, IntArray

Number = TypeVar("Number", bound=np.generic)
SPARE_CLASSES = 16
SPARE_ROWS = 1024
MOST_ROWS = 2**31


@dataclass(frozen=True, slots=True)
class IndexOptions:
    """How an index works. `threads` are those of one query."""

    exact_up_to: int = 20_000  # keyframes of a map up to which all vectors are compared exactly
    components: int = 128  # of a reduced vector
    rerank: int = 256  # keyframes that the reduced scan hands on to the exact ranking
    threads: int = 2


class Mirror:
    """Rows of a map: ids, objects per class, vectors. Rows are added at the end and die where they are."""

    def __init__(self, options: IndexOptions) -> None:
        self.options = options
        self.categories: dict[str, int] = {}
        self.parts: list[Part] = []  # of vectors, before those of the tail
        self.tail: Tail | None = None
        self.reduction: Reduction | None = None
        self._count = 0
        self._ids: Int64Array = np.empty(SPARE_ROWS, np.int64)
        self._alive: BoolArray = np.empty(0, np.bool_)  # replaced, never changed: states share it
        self._counts: ByteArray = np.zeros((SPARE_CLASSES, SPARE_ROWS), np.uint8)
        self._held: IntArray = np.zeros(SPARE_ROWS, np.int32)
        self._frequencies: Int64Array = np.zeros(SPARE_CLASSES, np.int64)
        self._codes: CodeArray | None = None
        self.renumbered = 0  # how often rows got other numbers
        self.completion: str | None = None  # state of the map of which landmarks complete its words; None: as seen

    def __len__(self) -> int:
        return self._count

    @property
    def dead(self) -> int:
        """Rows of deleted keyframes."""
        return self._count - int(np.count_nonzero(self._alive))

    def state(self) -> State:
        """What queries read from now on."""
        count = self._count
        ids = self._ids[:count]
        return State(
            ids=ids,
            alive=self._alive,
            living=count - self.dead,
            sorted_rows=order_of(ids, self._alive),
            categories=dict(self.categories),
            counts=self._counts,
            held=self._held[:count],
            frequencies=self._frequencies.copy(),
            vectors=self._vectors(),
            reduction=self.reduction,
            codes=self._codes,
            rerank=self.options.rerank,
            threads=self.options.threads,
        )

    def _vectors(self) -> Vectors:
        tail = (self.tail.part(),) if self.tail is not None and len(self.tail) else ()
        return Vectors((*self.parts, *tail))

    def set_rows(
        self, ids: Int64Array, alive: BoolArray, names: Sequence[str], counts: ByteArray, parts: Iterable[Part]
    ) -> None:
        """Takes over whole arrays; `counts` ``[classes, n]`` has its classes in the order of `names`."""
        self.renumbered += 1
        self._count = len(ids)
        self._ids, self._alive = ids, alive
        self.categories = {name: row for row, name in enumerate(names)}
        self._counts = np.zeros((len(names) + SPARE_CLASSES, counts.shape[1]), np.uint8)
        self._counts[: len(names)] = counts[: len(names)]
        self._frequencies = np.zeros(len(self._counts), np.int64)
        for row in range(len(names)):
            self._frequencies[row] = np.count_nonzero(counts[row, : self._count] * alive.view(np.uint8))
        self._held = np.zeros(counts.shape[1], np.int32)
        for row in self._strengths():
            self._held += self._counts[row]
        self.parts, self.tail = list(parts), None

    def set_words(self, state: State, columns: Mapping[str, tuple[Int64Array, Int64Array]]) -> None:
        """Puts other numbers in place of all; `state` is the latest, `columns` keyframes and numbers of each word."""
        names = sorted({*self.categories, *columns}, key=lambda name: (self.categories.get(name, MOST_ROWS), name))
        counts = np.zeros((len(names) + SPARE_CLASSES, self._counts.shape[1]), np.uint8)
        for row, name in enumerate(names):
            keys, numbers = columns.get(name, (np.empty(0, np.int64), np.empty(0, np.int64)))
            places, there = state.find(keys)
            counts[row, places[there]] = np.minimum(numbers[there], MOST_OBJECTS)
        self.categories = {name: row for row, name in enumerate(names)}
        self._counts, held = counts, np.zeros(len(self._held), np.int32)
        self._frequencies = np.count_nonzero(counts, axis=1).astype(np.int64)
        for row in self._strengths():
            held[: counts.shape[1]] += counts[row]
        self._held = held

    def _strengths(self) -> list[int]:
        """The rows of `counts` that are strengths, not numbers of objects."""
        return [row for name, row in self.categories.items() if "\n" in name]

    def append(self, ids: Int64Array, vectors: Float32Array, words: Iterable[tuple[int, str, int]]) -> None:
        """Adds keyframes ``ids[n]`` with vectors ``[n, d]``; `words` are keyframe, word and number."""
        if not len(ids):
            return
        first, count = self._count, self._count + len(ids)
        words = list(words)
        self._reserve(count, {name for _, name, _ in words})
        self._ids[first:count] = ids
        self._counts[:, first:count] = 0
        rows = {keyframe_id: first + place for place, keyframe_id in enumerate(ids.tolist())}
        for keyframe_id, name, number in words:
            at = self.categories[name], rows[keyframe_id]
            self._counts[at] = min(MOST_OBJECTS, int(self._counts[at]) + number)
        self._frequencies += np.count_nonzero(self._counts[:, first:count], axis=1)
        self._held[first:count] = self._counts[self._strengths(), first:count].sum(axis=0, dtype=np.int32)
        if self.tail is None:
            self.tail = Tail(vectors.shape[1])
        self.tail.append(vectors)
        if self.reduction is not None and self._codes is not None:
            self._codes[first:count] = self.reduction.encode(vectors)
        self._alive = np.concatenate([self._alive, np.ones(len(ids), np.bool_)])
        self._count = count

    def _reserve(self, count: int, names: Iterable[str]) -> None:
        """Room for so many rows and for these classes. States keep the arrays that they have."""
        for name in sorted(names):
            self.categories.setdefault(name, len(self.categories))
        classes, room = self._counts.shape
        if count > room or len(self.categories) > classes:
            if count > room:
                room = count + count // 4 + SPARE_ROWS
            if len(self.categories) > classes:
                classes = len(self.categories) + SPARE_CLASSES
            counts = np.zeros((classes, room), np.uint8)
            counts[: len(self._counts), : self._count] = self._counts[:, : self._count]
            self._counts = counts
            self._frequencies = np.concatenate(
                [self._frequencies, np.zeros(classes - len(self._frequencies), np.int64)]
            )
        self._ids = _grown(self._ids, self._count, room)
        self._held = _grown(self._held, self._count, room)
        if self._codes is not None:
            self._codes = _grown(self._codes, self._count, room)

    def remove(self, state: State, ids: Int64Array) -> None:
        """Lets the rows of these keyframes die; `state` is the latest. Unknown keyframes are passed over."""
        rows, there = state.find(ids)
        rows = np.unique(rows[there])
        if len(rows):
            self._alive = self._alive.copy()
            self._alive[rows] = False
            self._frequencies = self._frequencies - np.count_nonzero(self._counts[:, rows], axis=1)

    def wants_reduction(self) -> bool:
        """Whether the map has become large enough for reduced vectors, or much larger than when they were found."""
        fitted = self.reduction.fitted_on if self.reduction is not None else 0
        return self._count > self.options.exact_up_to and (not fitted or self._count >= 2 * fitted)

    def reduce(self) -> None:
        """Finds components and codes where `wants_reduction` says so."""
        if self.wants_reduction():
            self.bound_memory()
            self.set_reduction(*reduced(self._vectors(), self.options.components))

    def set_reduction(self, reduction: Reduction, codes: CodeArray) -> None:
        """Takes over components and the codes of the first rows ``[n, components]``; works out those of the rest."""
        self.reduction = reduction
        first, self._codes = len(codes), _grown(codes, len(codes), len(self._ids))
        for start, piece in self._vectors().chunks(first=first):
            self._codes[start : start + len(piece)] = reduction.encode(piece)
        self.bound_memory()

    def bound_memory(self) -> None:
        """Lets pages of mapped files leave memory: with a reduced scan few of them are needed at a time."""
        for part in self.parts:
            part.bounded = True

    def living_vectors(self, size: int = 4096) -> Iterator[Float32Array]:
        """Vectors of the rows that are alive, in pieces."""
        for start, piece in self._vectors().chunks(size=size):
            alive = self._alive[start : start + len(piece)]
            yield piece if alive.all() else piece[alive]

    def keep_living(self, parts: Iterable[Part]) -> None:
        """Forgets dead rows; `parts` have the vectors of the others. States that readers hold stay as they are."""
        self.renumbered += 1
        rows = np.flatnonzero(self._alive)
        self._ids = self._ids[rows]
        self._counts = self._counts[:, rows]
        self._held = self._held[rows]
        if self._codes is not None:
            self._codes = self._codes[rows]
        self._alive = np.ones(len(rows), np.bool_)
        self._count = len(rows)
        self.parts, self.tail = list(parts), None

    def arrays(self) -> dict[str, npt.NDArray[np.generic]]:
        """All arrays but the vectors, for a file."""
        count = self._count
        found: dict[str, npt.NDArray[np.generic]] = {
            "ids": self._ids[:count],
            "alive": self._alive,
            "counts": self._counts[: len(self.categories), :count],
        }
        if self.reduction is not None and self._codes is not None:
            found |= {
                "mean": self.reduction.mean,
                "axes": self.reduction.axes,
                "scales": self.reduction.scales,
                "codes": self._codes[:count],
            }
        return found

    def sums(self, state: State) -> tuple[int, int]:
        """Pairs of a living keyframe and a word that it has, and the sum of their numbers."""
        pairs = total = 0
        for row in range(len(state.categories)):
            column = self._counts[row, : self._count]
            living = column if state.living == self._count else column[self._alive]
            pairs += int(np.count_nonzero(living))
            total += int(living.sum(dtype=np.int64))
        return pairs, total


def reduced(vectors: Vectors, components: int) -> tuple[Reduction, CodeArray]:
    """Components of `vectors`, and the codes of all of them int8 ``[n, components]``."""
    reduction = fit_reduction(vectors.take(sample_rows(len(vectors))), components, len(vectors))
    codes = np.empty((len(vectors), len(reduction.axes)), np.int8)
    for start, piece in vectors.chunks():
        codes[start : start + len(piece)] = reduction.encode(piece)
    return reduction, codes


def _grown(array: npt.NDArray[Number], count: int, room: int) -> npt.NDArray[Number]:
    """`array` with its first `count` rows and room for `room`; itself where it has it."""
    if len(array) >= room:
        return array
    grown = np.empty((room, *array.shape[1:]), array.dtype)
    grown[:count] = array[:count]
    return grown


def category_matrix(
    ids: Int64Array, columns: Mapping[str, tuple[Int64Array, Int64Array]]
) -> tuple[list[str], ByteArray]:
    """Class names and the matrix uint8 ``[classes, n]`` of objects per class and keyframe; `ids` ``[n]`` ascend."""
    names = sorted(columns)
    counts = np.zeros((len(names), len(ids)), np.uint8)
    for row, name in enumerate(names):
        keys, numbers = columns[name]
        place = np.minimum(np.searchsorted(ids, keys), max(0, len(ids) - 1))
        there = ids[place] == keys if len(ids) else np.zeros(len(keys), np.bool_)
        held = np.zeros(len(ids), np.int64)
        np.add.at(held, place[there], numbers[there])
        counts[row] = np.minimum(held, MOST_OBJECTS)
    return names, counts
