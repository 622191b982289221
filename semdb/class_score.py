"""The class score: how many of the query's objects a keyframe shows too, rare classes counting more.

Score of a keyframe: sum over the classes of the query of ``idf(c) * min(n_query(c), n_keyframe(c))``, divided by the
same sum with ``n_query`` alone, so 1 means that everything in the query is there. ``idf(c) = ln((1 + N) / (1 +
df(c))) + 1`` (N keyframes in the map, df of them show c), which is positive and defined for a class no keyframe shows.

The weights are integers of a millionth: sums of integers do not depend on the order in which a server adds, so every
server, and an index in memory, gives the same scores to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from semdb.errors import UsageError

SCALE = 1_000_000
MOST_OBJECTS = 255  # of a class that make a difference: an index keeps their number in 8 bits


@dataclass(frozen=True, slots=True)
class ClassTerm:
    """What one class of keyframes adds to their sum: ``min(full, per_object * n)`` for n objects (millionths)."""

    category: str
    per_object: int
    full: int


@dataclass(frozen=True, slots=True)
class ClassQuery:
    """A query by classes: a keyframe's class score is the sum of its terms over `total`.

    A class comes in one term only. Raises UsageError for terms that contradict this or are not positive or ask for
    more than `MOST_OBJECTS`.
    """

    terms: tuple[ClassTerm, ...]
    total: int  # the sum of a keyframe that shows everything; may be more than all terms together

    def __post_init__(self) -> None:
        if len({term.category for term in self.terms}) != len(self.terms):
            raise UsageError("a class comes twice in a query: its terms have to be one")
        if any(term.per_object <= 0 or term.full <= 0 for term in self.terms):
            raise UsageError("the weights of the classes of a query are positive")
        if any(term.full > MOST_OBJECTS * term.per_object for term in self.terms):
            raise UsageError(f"more than {MOST_OBJECTS} objects of one class cannot be asked for")
        if self.terms and self.total <= 0:
            raise UsageError("the total of a query is positive")

    def least(self, minimum_share: float) -> int:
        """The smallest sum that passes `minimum_share`; a keyframe that shares nothing never does."""
        return max(1, math.ceil(minimum_share * self.total - 1e-6))


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
    per_object = round(SCALE * (math.log((1 + keyframes) / (1 + document_frequency)) + 1))
    # rounded in this order n >= wanted objects give exactly `full`
    return ClassTerm(category, per_object, round(per_object * min(wanted, MOST_OBJECTS)))
