"""The coarse step: which keyframes are worth matching, and in which order.

A cascade. First the keyframes that share enough of the query's objects (the class-attribute filter), ranked by
the cosine of the CNN vectors; where verification does not convince, all keyframes by cosine plus a term for the
shared objects; then all by cosine alone. Most queries are answered by the first stage, and a missed detection
costs time instead of the answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from semdb.types import Float32Array, FloatArray

FOLLOWING = 30  # keyframes after those of a batch that are looked through for a place that looks the same


class Stage:
    """Names of the stages, as results and the query log record them."""

    FILTERED = "filtered"
    SOFT = "soft"
    ALL = "all"
    GIVEN = "given"  # keyframes named by the caller


@dataclass(frozen=True, slots=True)
class CoarseOptions:
    """`*_batches` are numbers of keyframes to match before asking again whether the answer convinces."""

    use_classes: bool = True
    minimum_share: float = 0.5  # of the query's idf-weighted objects that a keyframe must share to pass
    class_weight: float = 0.15  # of the class score beside the cosine in the soft stage
    filtered_batches: tuple[int, ...] = (1, 2)
    soft_batches: tuple[int, ...] = (3,)
    all_batches: tuple[int, ...] = (4,)
    cascade: bool = True  # False: the filtered set alone, as the paper has it


@dataclass(frozen=True, slots=True)
class Proposal:
    """A keyframe to match."""

    keyframe_id: int
    class_score: float
    cosine: float


@dataclass(frozen=True, slots=True)
class Batch:
    """Keyframes to match next, and how many distinct keyframes were ranked by cosine so far."""

    stage: str
    proposals: tuple[Proposal, ...]
    ranked: int
    following: tuple[Proposal, ...] = ()  # what comes next in the same order, as far as it may look alike


class CoarseSource(Protocol):
    """Where class scores and vectors come from: SQL, or a mirror of the database in memory."""

    def refresh(self) -> bool:
        """Takes notice of what changed in the database since the last call; whether anything did."""

    def keyframe_ids(self) -> Sequence[int]:
        """All keyframes of the map, ascending."""

    def class_scores(self, counts: Mapping[str, float]) -> dict[int, float]:
        """Score 0..1 of every keyframe that shares a class with `counts`; the others are not in it."""

    def filtered(self, counts: Mapping[str, float], minimum_share: float) -> dict[int, float]:
        """Those whose score is at least `minimum_share`: the class-attribute filter."""

    def vectors(self, keyframe_ids: Sequence[int]) -> Float32Array:
        """Unit vectors ``[n, d]`` in the order of `keyframe_ids`."""


def rank_by_score(keyframe_ids: Sequence[int], scores: FloatArray) -> list[int]:
    """Positions in order of falling score; ties in ascending order of id, so that every source agrees."""
    return [int(i) for i in np.lexsort((np.asarray(keyframe_ids), -scores))]


class _Cosines:
    """Cosines of the query with keyframes, each fetched once."""

    def __init__(self, source: CoarseSource, query_vector: Float32Array) -> None:
        self._source = source
        self._query = query_vector
        self._known: dict[int, float] = {}

    def of(self, keyframe_ids: Sequence[int]) -> FloatArray:
        missing = [i for i in keyframe_ids if i not in self._known]
        if missing:
            cosines = self._source.vectors(missing).astype(np.float64) @ self._query.astype(np.float64)
            self._known.update(zip(missing, cosines.tolist(), strict=True))
        return np.array([self._known[i] for i in keyframe_ids], dtype=np.float64)

    def __len__(self) -> int:
        return len(self._known)


def cascade(
    source: CoarseSource, counts: Mapping[str, float], query_vector: Float32Array, options: CoarseOptions
) -> Iterator[Batch]:
    """Batches of keyframes in the order in which they are worth matching; none comes twice.

    `counts` are the objects of the query per class, `query_vector` ``[d]`` its unit CNN vector.
    """
    cosines = _Cosines(source, query_vector)
    seen: set[int] = set()
    use_classes = options.use_classes and bool(counts)
    if use_classes:
        passed = source.filtered(counts, options.minimum_share)
        yield from _stage(Stage.FILTERED, sorted(passed), passed, cosines, seen, options.filtered_batches, 0.0)
    if options.use_classes and not options.cascade:
        return  # the hard filter has the last word, also where no object is detected
    everything = list(source.keyframe_ids())
    scores = source.class_scores(counts) if use_classes else {}
    if use_classes:
        yield from _stage(Stage.SOFT, everything, scores, cosines, seen, options.soft_batches, options.class_weight)
        batches = options.all_batches
    else:
        batches = (*options.filtered_batches, *options.soft_batches, *options.all_batches)
    yield from _stage(Stage.ALL, everything, scores, cosines, seen, batches, 0.0)


def _stage(
    name: str,
    keyframe_ids: Sequence[int],
    class_scores: dict[int, float],
    cosines: _Cosines,
    seen: set[int],
    batches: Sequence[int],
    class_weight: float,
) -> Iterator[Batch]:
    if not keyframe_ids:
        return
    cosine = cosines.of(keyframe_ids)
    classes = np.array([class_scores.get(i, 0.0) for i in keyframe_ids])
    order = [p for p in rank_by_score(keyframe_ids, cosine + class_weight * classes) if keyframe_ids[p] not in seen]
    start = 0
    for size in batches:
        chosen = order[start : start + size]
        start += size
        if not chosen:
            return
        seen.update(keyframe_ids[p] for p in chosen)
        proposals, following = (
            tuple(Proposal(keyframe_ids[p], float(classes[p]), float(cosine[p])) for p in positions)
            for positions in (chosen, order[start : start + FOLLOWING])
        )
        yield Batch(name, proposals, len(cosines), following)
