"""The class-attribute filter: which keyframes show the same kinds of objects as the query.

Score of a keyframe: sum over the classes of the query of ``idf(c) * min(n_query(c), n_keyframe(c))``, divided by the
same sum with ``n_query`` alone, so 1 means that everything in the query is there. ``idf(c) = ln((1 + N) / (1 +
df(c))) + 1`` (N keyframes in the map, df of them show c), which is positive and defined for a class no keyframe shows.

The weights are rounded to integers of a millionth, and so are weight times ``n_query``: sums of integers do not depend
on the order in which a server adds, so every server, and a mirror in memory, gives the same scores to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import Connection, Engine, Integer, case, func, literal, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.database import retry
from semdb.database.records import ScoredKeyframe
from semdb.database.tables import categories, keyframe_categories, keyframes, recordings
from semdb.errors import UsageError

SCALE = 1_000_000


@dataclass(frozen=True, slots=True)
class ClassWeight:
    """What a class of the query counts: `per_object` in a keyframe, at most `full` (integers, millionths)."""

    category_id: int | None  # None: no keyframe of the database ever showed it
    wanted: float  # objects in the query
    per_object: int
    full: int


def class_weight(category_id: int | None, wanted: float, keyframes_total: int, document_frequency: int) -> ClassWeight:
    """The weight of one class by the formula above."""
    idf = math.log((1 + keyframes_total) / (1 + document_frequency)) + 1
    return ClassWeight(category_id, wanted, round(SCALE * idf), round(SCALE * idf * wanted))


def class_weights(engine: Engine, map_id: int, counts: Mapping[str, float]) -> list[ClassWeight]:
    """The weights of the classes of a query (name -> number of objects, which may be fractional) in a map."""
    wanted = _positive(counts)
    return retry.read(engine, lambda connection: _weights(connection, map_id, wanted))


def _positive(counts: Mapping[str, float]) -> dict[str, float]:
    for name, count in counts.items():
        if not math.isfinite(count) or count < 0:
            raise UsageError(f"the count of the class {name!r} is {count}: a finite number of objects is needed")
    return {name: count for name, count in counts.items() if count > 0}


def _weights(connection: Connection, map_id: int, counts: Mapping[str, float]) -> list[ClassWeight]:
    if not counts:
        return []
    total = connection.execute(
        select(func.count()).select_from(keyframes.join(recordings)).where(recordings.c.map_id == map_id)
    ).scalar_one()
    frequency = (
        select(func.count())
        .where(
            keyframe_categories.c.map_id == map_id,
            keyframe_categories.c.category_id == categories.c.id,
        )
        .scalar_subquery()
    )
    query = select(categories.c.name, categories.c.id, frequency).where(categories.c.name.in_(list(counts)))
    known = {name: (category_id, df) for name, category_id, df in connection.execute(query)}
    weights: list[ClassWeight] = []
    for name in sorted(counts):
        category_id, df = known.get(name, (None, 0))
        weights.append(class_weight(category_id, counts[name], total, df))
    return weights


def class_filter(
    engine: Engine, map_id: int, counts: Mapping[str, float], minimum_share: float
) -> list[ScoredKeyframe]:
    """Keyframes of a map with a class score of at least `minimum_share`, best first, then by id.

    Keyframes that share no class with the query are never among them. One statement does the filter; a cheap one
    before it finds how rare the classes are.
    """
    wanted = _positive(counts)

    def work(connection: Connection) -> list[ScoredKeyframe]:
        weights = _weights(connection, map_id, wanted)
        total = sum(weight.full for weight in weights)
        known = [weight for weight in weights if weight.category_id is not None]
        if not known or total == 0:
            return []
        c = keyframe_categories.c
        overlap = func.sum(_contribution(known))
        query = (
            select(c.keyframe_id, overlap)
            .where(c.map_id == map_id, c.category_id.in_([weight.category_id for weight in known]))
            .group_by(c.keyframe_id)
            .having(overlap >= max(1, math.ceil(minimum_share * total - 1e-6)))
            .order_by(overlap.desc(), c.keyframe_id)
        )
        # The quotient is taken here: servers divide integers each in their own way.
        return [ScoredKeyframe(key, int(shared) / total) for key, shared in connection.execute(query)]

    return retry.read(engine, work)


def _contribution(weights: list[ClassWeight]) -> ColumnElement[int]:
    """What one row (category, keyframe, count) adds: min(n_query, n_keyframe) times the weight of its class."""
    c = keyframe_categories.c
    branches: list[tuple[ColumnElement[bool], ColumnElement[int]]] = []
    for weight in weights:
        full, per_object = literal(weight.full, Integer), literal(weight.per_object, Integer)
        enough = math.ceil(weight.wanted)
        branches.append(((c.category_id == weight.category_id) & (c.count >= enough), full))
        branches.append((c.category_id == weight.category_id, per_object * c.count))
    return case(*branches, else_=literal(0, Integer))
