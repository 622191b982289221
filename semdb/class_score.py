"""The class score: how far a keyframe shows what the query shows, rare classes counting more.

By strengths (`strength_query`), the default: what a detector saw of a class, weak detections too, in the upper and in
the lower half of an image, is a number from 0 to 255, and the score is the weighted Jaccard index (Ruzicka similarity)
of the two sets of numbers: ``sum of w(c) * min(q, k)`` over ``sum of w(c) * max(q, k)``, both over classes and halves.
The part of the keyframe that the query does not ask for is weighed with the mean weight of the query, so that rows of
the query's classes are all that is read.

By counts (`class_query`), as the paper has it: ``sum of w(c) * min(n_query(c), n_keyframe(c))`` over the same sum with
``n_query`` alone, so that 1 means that everything in the query is there.

``w(c) = ln((1 + N) / (1 + df(c))) + 1`` (N keyframes in the map, df of them show c) is positive, and defined for a
class that no keyframe shows. All weights are integers: sums of integers do not depend on the order in which a server
adds, so every server, and an index in memory, gives the same scores to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from semdb.errors import UsageError
from semdb.types import Int64Array

SCALE = 1_000_000
MOST_OBJECTS = 255  # of a class that make a difference: an index keeps their number in 8 bits
UNITS = 16  # of strength for a detection of score 1
STRENGTH_SCALE = 1000  # of the weight of a unit of strength: keeps sums small
Number = TypeVar("Number", int, Int64Array)


class Part(StrEnum):
    """What of a class in a keyframe a term is about."""

    COUNT = "count"  # objects
    UPPER = "upper"  # strength in the upper half of the image
    LOWER = "lower"  # strength in the lower half


STRENGTHS = (Part.UPPER, Part.LOWER)


def word(category: str, part: Part) -> str:
    """The name of a row of an index. No class has a line break in its name."""
    return category if part is Part.COUNT else f"{category}\n{part}"


@dataclass(frozen=True, slots=True)
class ClassTerm:
    """What a class of a keyframe adds to its sum: ``min(full, per_object * n)`` for n objects, or units of strength."""

    category: str
    per_object: int
    full: int
    part: Part = Part.COUNT

    @property
    def word(self) -> str:
        return word(self.category, self.part)


@dataclass(frozen=True, slots=True)
class ClassQuery:
    """A query by classes: a keyframe's class score is the sum of its terms over `total`.

    With `per_held` it is the sum over ``total + per_held * held - sum``, where held is the strength of all that the
    keyframe shows. A class comes in one term of a part only. Raises UsageError for terms that contradict this, are not
    positive, or ask for more than `MOST_OBJECTS`, or than the total.
    """

    terms: tuple[ClassTerm, ...]
    total: int  # the sum of a keyframe that shows everything; may be more than all terms together
    per_held: int = 0

    def __post_init__(self) -> None:
        if len({term.word for term in self.terms}) != len(self.terms):
            raise UsageError("a class comes twice in a query: its terms have to be one")
        if any(term.per_object <= 0 or term.full <= 0 for term in self.terms):
            raise UsageError("the weights of the classes of a query are positive")
        if any(term.full > MOST_OBJECTS * term.per_object for term in self.terms):
            raise UsageError(f"more than {MOST_OBJECTS} objects of one class cannot be asked for")
        if self.terms and self.total <= 0:
            raise UsageError("the total of a query is positive")
        if self.per_held < 0 or (self.per_held and sum(term.full for term in self.terms) > self.total):
            raise UsageError("the terms of a query by strengths are not more than its total")

    @property
    def whole(self) -> int:
        """The points that stand for a score of 1."""
        return SCALE if self.per_held else max(1, self.total)

    def points(self, shared: Number, held: Number) -> Number:
        """The class score in integers, over `whole`: of the sum of terms, and the strength of the whole keyframe."""
        if not self.per_held:
            return shared
        return shared * SCALE // (self.total + self.per_held * held - shared)

    def least(self, minimum_share: float) -> int:
        """The fewest points that pass `minimum_share`; a keyframe that shares nothing never does."""
        return max(1, math.ceil(minimum_share * self.whole - 1e-6))


def class_query(counts: Mapping[str, float], keyframes: int, document_frequency: Mapping[str, int]) -> ClassQuery:
    """The query for objects per class (fractional numbers are allowed; zero means not there).

    `keyframes` are in the map, `document_frequency` of them show a class (0 where it is missing). Raises UsageError
    for a count that is negative or not finite.
    """
    for name, count in counts.items():
        if not math.isfinite(count) or count < 0:
            raise UsageError(f"the count of the class {name!r} is {count}: a finite number of objects is needed")
    terms = [
        class_term(name, counts[name], keyframes, document_frequency.get(name, 0))
        for name in sorted(counts)
        if counts[name] > 0
    ]
    terms = [term for term in terms if term.full > 0]  # less than a millionth of an object
    return ClassQuery(tuple(terms), sum(term.full for term in terms))


def class_term(category: str, wanted: float, keyframes: int, document_frequency: int) -> ClassTerm:
    """The term of a class of which the query shows `wanted` objects, by the formula above."""
    per_object = _weight(SCALE, keyframes, document_frequency)
    # rounded in this order n >= wanted objects give exactly `full`
    return ClassTerm(category, per_object, round(per_object * min(wanted, MOST_OBJECTS)))


def _weight(scale: int, keyframes: int, document_frequency: int) -> int:
    return round(scale * (math.log((1 + keyframes) / (1 + document_frequency)) + 1))


def strengths(found: Iterable[tuple[str, float, float]]) -> dict[str, tuple[int, int]]:
    """Strength per class in the upper and the lower half of an image, 0 to 255, from detections.

    A detection is a class, its score, and where the centre of its box is, from 0 at the top to 1 at the bottom. It
    counts `UNITS` times its score, wholly above in the upper quarter, wholly below in the lower one, and in between in
    both halves. The order of detections does not matter.
    """
    parts: dict[str, tuple[list[float], list[float]]] = {}
    for category, score, height in found:
        above = min(1.0, max(0.0, 0.5 + 2 * (0.5 - height)))
        upper, lower = parts.setdefault(category, ([], []))
        upper.append(score * above)
        lower.append(score * (1 - above))
    summed = {category: (_units(upper), _units(lower)) for category, (upper, lower) in sorted(parts.items())}
    return {category: pair for category, pair in summed.items() if any(pair)}


def _units(scores: list[float]) -> int:
    return min(MOST_OBJECTS, round(UNITS * math.fsum(scores)))


def strength_query(
    found: Mapping[str, tuple[int, int]],
    keyframes: int,
    document_frequency: Mapping[str, int],
    stands_for: Mapping[str, tuple[int, int]] | None = None,
) -> ClassQuery:
    """The query for the strengths of an image.

    `stands_for` are strengths of classes that the image's classes are taken for: where they are greater than what is
    seen, a keyframe that shows so much of the class is as good, but the image is not asked for more.
    """
    asked = [_strength_terms(name, pair, keyframes, document_frequency) for name, pair in sorted(found.items())]
    seen = [term for terms in asked for term in terms]
    total = sum(term.full for term in seen)
    units = sum(sum(pair) for pair in found.values())
    if not units:
        return ClassQuery((), 0)
    terms = {term.word: term for term in seen}
    for name, pair in sorted((stands_for or {}).items()):
        for term in _strength_terms(name, pair, keyframes, document_frequency):
            if term.word not in terms or term.full > terms[term.word].full:
                terms[term.word] = term
    # a keyframe may show a class beside what stands for it: then that is what it can share at most
    most = sum(term.full for term in terms.values())
    return ClassQuery(tuple(terms.values()), most, max(1, round(total / units)))


def _strength_terms(
    name: str, pair: tuple[int, int], keyframes: int, document_frequency: Mapping[str, int]
) -> list[ClassTerm]:
    weight = _weight(STRENGTH_SCALE, keyframes, document_frequency.get(name, 0))
    return [
        ClassTerm(name, weight, weight * wanted, part) for part, wanted in zip(STRENGTHS, pair, strict=True) if wanted
    ]


def expand(strengths: Mapping[str, int], weights: Mapping[str, Mapping[str, int]], share: float) -> dict[str, int]:
    """`strengths` of a query's classes, and of the classes that these are taken for.

    An object of class c stands for ``share * weight(c, d)`` of one of class d (`weights` in millionths); of what is
    seen of a class itself and what others stand for the greater counts. Integers throughout.
    """
    thousandths = round(1000 * share)
    stands: dict[str, int] = {}
    for name, strength in strengths.items():
        for other, weight in weights.get(name, {}).items():
            stands[other] = stands.get(other, 0) + strength * weight * thousandths
    result = dict(strengths)
    for other, total in stands.items():
        most = total // (1000 * SCALE)
        if most > result.get(other, 0):
            result[other] = most
    return result
