"""The class-attribute filter in SQL: which keyframes show the same kinds of objects as the query.

The score is that of `semdb.class_score`. What is here is the reference that an index in memory is compared with.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from sqlalchemy import Connection, Engine, Integer, Select, case, func, literal, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.class_score import ClassQuery, ClassTerm, class_query
from semdb.database import retry
from semdb.database.records import ScoredKeyframe
from semdb.database.tables import categories, keyframe_categories, keyframes, recordings

CHUNK = 500


def keyframe_count(engine: Engine, map_id: int) -> int:
    """How many keyframes a map holds."""
    return retry.read(engine, lambda connection: _keyframe_count(connection, map_id))


def _keyframe_count(connection: Connection, map_id: int) -> int:
    query = select(func.count()).select_from(keyframes.join(recordings)).where(recordings.c.map_id == map_id)
    return int(connection.execute(query).scalar_one())


def document_frequencies(engine: Engine, map_id: int, names: Collection[str]) -> dict[str, int]:
    """How many keyframes of a map show a class; a class that no keyframe of the database shows is left out."""
    return retry.read(engine, lambda connection: _frequencies(connection, map_id, names))


def _frequencies(connection: Connection, map_id: int, names: Collection[str]) -> dict[str, int]:
    if not names:
        return {}
    frequency = (
        select(func.count())
        .where(
            keyframe_categories.c.map_id == map_id,
            keyframe_categories.c.category_id == categories.c.id,
        )
        .scalar_subquery()
    )
    query = select(categories.c.name, frequency).where(categories.c.name.in_(sorted(names)))
    return {name: int(df) for name, df in connection.execute(query)}


def query_for(engine: Engine, map_id: int, counts: Mapping[str, float]) -> ClassQuery:
    """The class query for objects per class in a map. Raises UsageError for an impossible count."""

    def work(connection: Connection) -> ClassQuery:
        total = _keyframe_count(connection, map_id)
        return class_query(counts, total, _frequencies(connection, map_id, counts))

    return retry.read(engine, work)


def class_filter(
    engine: Engine, map_id: int, query: ClassQuery, minimum_share: float, at_most: int | None = None
) -> list[ScoredKeyframe]:
    """Keyframes of a map with a class score of at least `minimum_share`: the best `at_most` of them (None: all).

    Best first, equal ones by id. Keyframes that share no class with the query are never among them.
    """

    def work(connection: Connection) -> list[ScoredKeyframe]:
        known = _known(connection, query)
        if not known:
            return []
        statement, overlap = _scores(map_id, known)
        statement = (
            statement.having(overlap >= query.least(minimum_share))
            .order_by(overlap.desc(), keyframe_categories.c.keyframe_id)
            .limit(at_most)
        )
        # The quotient is taken here: servers divide integers each in their own way.
        return [ScoredKeyframe(row[0], int(row[1]) / query.total) for row in connection.execute(statement)]

    return retry.read(engine, work)


def class_scores(engine: Engine, map_id: int, query: ClassQuery, keyframe_ids: Sequence[int]) -> dict[int, float]:
    """Class scores of these keyframes; those that share no class with the query are left out."""
    keys = [int(key) for key in keyframe_ids]

    def work(connection: Connection) -> dict[int, float]:
        known = _known(connection, query)
        found: dict[int, float] = {}
        for start in range(0, len(keys) if known else 0, CHUNK):
            statement, _ = _scores(map_id, known)
            chunk = statement.where(keyframe_categories.c.keyframe_id.in_(keys[start : start + CHUNK]))
            found.update((row[0], int(row[1]) / query.total) for row in connection.execute(chunk))
        return found

    return retry.read(engine, work)


def _known(connection: Connection, query: ClassQuery) -> list[tuple[int, ClassTerm]]:
    """The terms of classes that the database knows, with the ids of these."""
    if not query.terms:
        return []
    terms = {term.category: term for term in query.terms}
    statement = select(categories.c.id, categories.c.name).where(categories.c.name.in_(list(terms)))
    return sorted((int(key), terms[name]) for key, name in connection.execute(statement))


def _scores(map_id: int, known: list[tuple[int, ClassTerm]]) -> tuple[Select[tuple[int, int]], ColumnElement[int]]:
    """Keyframe and sum of its terms, grouped by keyframe; and the sum for conditions on it."""
    c = keyframe_categories.c
    overlap = func.sum(_contribution(known))
    ids = [category_id for category_id, _ in known]
    query = select(c.keyframe_id, overlap).where(c.map_id == map_id, c.category_id.in_(ids)).group_by(c.keyframe_id)
    return query, overlap


def _contribution(known: list[tuple[int, ClassTerm]]) -> ColumnElement[int]:
    """What one row (category, keyframe, count) adds: ``min(full, per_object * count)``."""
    c = keyframe_categories.c
    branches: list[tuple[ColumnElement[bool], ColumnElement[int]]] = []
    for category_id, term in known:
        full, per_object = literal(term.full, Integer), literal(term.per_object, Integer)
        enough = -(-term.full // term.per_object)
        branches.append(((c.category_id == category_id) & (c.count >= enough), full))
        branches.append((c.category_id == category_id, per_object * c.count))
    return case(*branches, else_=literal(0, Integer))
