"""The coarse step: which keyframes are worth matching, and in which order.

A cascade. First the keyframes that show most of what the query shows (the class-attribute filter: the best so many by
class score), ranked by the cosine of the CNN vectors plus a term for the class score; where verification does not
convince, all keyframes by the same sum; then all by cosine alone. Most queries are answered by the first stage, and a
missed detection costs time instead of the answer.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Protocol

from semdb.class_score import ClassQuery, class_query, expand, strength_query
from semdb.localization.ranking import best_first
from semdb.types import Float32Array, FloatArray, Int64Array

FOLLOWING = 30  # keyframes after those of a batch that are looked through for a place that looks the same


class Stage:
    """Names of the stages, as results and the query log record them."""

    FILTERED = "filtered"
    SOFT = "soft"
    ALL = "all"
    GIVEN = "given"  # keyframes named by the caller


class Scoring(StrEnum):
    """Which class score: see `semdb.class_score`."""

    STRENGTHS = "strengths"  # what was seen, weakly too, by half of the image
    COUNTS = "counts"  # objects, as the paper has it


@dataclass(frozen=True, slots=True)
class CoarseOptions:
    """`*_batches` are numbers of keyframes to match before asking again whether the answer convinces.

    The filter passes `filtered_share` of the map's keyframes, those with the best class score, but at least
    `filtered_at_least` of them (or a third of a map so small that this is less), and at most `filtered_at_most`.
    """

    use_classes: bool = True
    scoring: Scoring = Scoring.STRENGTHS
    minimum_share: float = 0.0  # class score below which a keyframe does not pass in any case
    filtered_share: float = 0.15
    filtered_at_least: int = 8
    filtered_at_most: int = 1000
    class_weight: float = 0.2  # of the class score beside the cosine, but in the last stage
    filtered_batches: tuple[int, ...] = (1, 2)
    soft_batches: tuple[int, ...] = (3,)
    all_batches: tuple[int, ...] = (4,)
    cascade: bool = True  # False: the filtered set alone, as the paper has it
    confusion: float = 0.5  # how far a class stands for those it is taken for (`semdb refine`); 0: not at all

    def passing(self, keyframes: int) -> int:
        """How many of so many keyframes pass the filter."""
        least = min(self.filtered_at_least, math.ceil(keyframes / 3))
        return min(self.filtered_at_most, max(least, math.ceil(self.filtered_share * keyframes)))


@dataclass(frozen=True, slots=True)
class QueryClasses:
    """What a query shows: objects per class, and strengths per class (`semdb.class_score.strengths`)."""

    counts: Mapping[str, float]
    strengths: Mapping[str, tuple[int, int]]
    stands_for: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # strengths of what classes are taken for

    def shown(self, scoring: Scoring) -> list[str]:
        """The classes that count."""
        return sorted(self.counts) if scoring is Scoring.COUNTS else sorted({*self.strengths, *self.stands_for})


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


@dataclass(frozen=True, slots=True)
class MapChange:
    """What changed in a map between two looks at it. An empty one is false."""

    added: frozenset[int] = frozenset()  # keyframes that were not there
    gone: frozenset[int] = frozenset()  # deleted, described anew or moved: what is kept of them is out of date
    everything: bool = False  # not known what: nothing that is kept can be relied on

    def __bool__(self) -> bool:
        return self.everything or bool(self.added) or bool(self.gone)


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """Keyframes with class scores, best first, equal ones by ascending id."""

    keyframe_ids: Int64Array  # [n]
    class_scores: FloatArray  # [n] 0..1


@dataclass(frozen=True, slots=True, eq=False)
class Ranked:
    """Keyframes with class scores and cosines in the order of a ranking."""

    keyframe_ids: Int64Array  # [n]
    class_scores: FloatArray  # [n] 0..1
    cosines: FloatArray  # [n]

    def __len__(self) -> int:
        return len(self.keyframe_ids)


class CoarseSource(Protocol):
    """Where the coarse step asks: SQL, which is the reference, or an index in memory. Both give the same answers.

    Between two calls of `refresh` an index answers from one state of the map. A source serves one thread.
    """

    def refresh(self) -> MapChange:
        """Takes notice of what changed in the database since the last call (the first one tells of no change)."""

    def keyframe_count(self) -> int:
        """How many keyframes the map holds."""

    def document_frequencies(self, categories: Collection[str]) -> dict[str, int]:
        """How many keyframes of the map show a class; one that none shows may be left out."""

    def filtered(self, query: ClassQuery, minimum_share: float, at_most: int | None) -> Scored:
        """The class-attribute filter: keyframes whose class score is at least `minimum_share` (and above 0).

        With `at_most`, only the best of them: by falling class score, then by ascending id.
        """

    def cosines(self, vector: Float32Array, keyframe_ids: Int64Array) -> FloatArray:
        """Cosines ``[n]`` of the unit vector ``[d]`` with these keyframes; NaN for one that is not there any more."""

    def nearest(self, vector: Float32Array, count: int, query: ClassQuery | None, class_weight: float) -> Ranked:
        """The best `count` keyframes of the whole map by ``cosine + class_weight * class score``, ties by id.

        Without `query` by cosine alone, all class scores 0. Cosines of those returned are exact. An index of a large
        map may find them by a reduced scan: then a keyframe is missed in at most one of a hundred places.
        """


def query_classes(
    counts: Mapping[str, float],
    strengths: Mapping[str, tuple[int, int]],
    confusions: Mapping[str, Mapping[str, int]],
    options: CoarseOptions,
) -> QueryClasses:
    """What a query shows, and what its classes stand for by `confusions` (millionths, as `semdb refine` finds them)."""
    upper, lower = (
        expand({name: pair[half] for name, pair in strengths.items()}, confusions, options.confusion) for half in (0, 1)
    )
    names = [name for name in {*upper, *lower} if (upper.get(name, 0), lower.get(name, 0)) != strengths.get(name)]
    stands_for = {name: (upper.get(name, 0), lower.get(name, 0)) for name in names} if confusions else {}
    return QueryClasses(counts, strengths, stands_for)


def cascade(
    source: CoarseSource, classes: QueryClasses, query_vector: Float32Array, options: CoarseOptions
) -> Iterator[Batch]:
    """Batches of keyframes in the order in which they are worth matching; none comes twice.

    `query_vector` ``[d]`` is the query's unit CNN vector.
    """
    seen: set[int] = set()
    ranked = 0
    query = _class_query(source, classes, options.scoring) if options.use_classes else None
    if query is not None:
        passed = _rank_filtered(source, query, query_vector, options)
        ranked = len(passed)
        yield from _batches(Stage.FILTERED, passed, seen, options.filtered_batches, ranked)
    if options.use_classes and not options.cascade:
        return  # the hard filter has the last word, also where no object is detected
    stages = [(Stage.ALL, (*options.filtered_batches, *options.soft_batches, *options.all_batches), 0.0)]
    if query is not None:
        stages = [(Stage.SOFT, options.soft_batches, options.class_weight), (Stage.ALL, options.all_batches, 0.0)]
    for stage, batches, weight in stages:
        everything = source.nearest(query_vector, len(seen) + sum(batches) + FOLLOWING, query, weight)
        ranked = max(ranked, source.keyframe_count()) if len(everything) else ranked
        yield from _batches(stage, everything, seen, batches, ranked)


def retrieve(
    source: CoarseSource, classes: QueryClasses, query_vector: Float32Array, count: int, options: CoarseOptions
) -> list[Proposal]:
    """The first `count` keyframes of the coarse step alone, in its order, as if no answer ever convinced."""
    ranking = replace(options, filtered_batches=(count,), soft_batches=(count,), all_batches=(count,))
    found: list[Proposal] = []
    for batch in cascade(source, classes, query_vector, ranking):
        found += batch.proposals
        if len(found) >= count:
            break
    return found[:count]


def _class_query(source: CoarseSource, classes: QueryClasses, scoring: Scoring) -> ClassQuery | None:
    """The query by classes; None where nothing is seen."""
    shown = classes.shown(scoring)
    if not shown:
        return None
    keyframes, frequencies = source.keyframe_count(), source.document_frequencies(shown)
    if scoring is Scoring.COUNTS:
        query = class_query(classes.counts, keyframes, frequencies)
    else:
        query = strength_query(classes.strengths, keyframes, frequencies, classes.stands_for)
    return query if query.terms else None


def _rank_filtered(
    source: CoarseSource, query: ClassQuery, query_vector: Float32Array, options: CoarseOptions
) -> Ranked:
    passed = source.filtered(query, options.minimum_share, options.passing(source.keyframe_count()))
    cosines = source.cosines(query_vector, passed.keyframe_ids)
    order = best_first(passed.keyframe_ids, cosines + options.class_weight * passed.class_scores)
    return Ranked(passed.keyframe_ids[order], passed.class_scores[order], cosines[order])


def _batches(name: str, ranked: Ranked, seen: set[int], sizes: Sequence[int], looked_at: int) -> Iterator[Batch]:
    """Batches of what was not seen before; only as much of the ranking is turned into proposals as they need."""
    wanted = len(seen) + sum(sizes) + FOLLOWING
    rows = zip(
        ranked.keyframe_ids[:wanted].tolist(),
        ranked.class_scores[:wanted].tolist(),
        ranked.cosines[:wanted].tolist(),
        strict=True,
    )
    new = [Proposal(*row) for row in rows if row[0] not in seen]
    start = 0
    for size in sizes:
        chosen = tuple(new[start : start + size])
        start += size
        if not chosen:
            return
        seen.update(proposal.keyframe_id for proposal in chosen)
        yield Batch(name, chosen, looked_at, tuple(new[start : start + FOLLOWING]))
