"""The class-attribute filter in SQL: which keyframes show the same kinds of objects as the query.

The score is that of `semdb.class_score`. What is here is the reference that an index in memory is compared with.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from decimal import Decimal
from typing import Any

from sqlalchemy import BigInteger, Connection, Engine, Table, func, literal, literal_column, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.class_score import SCALE, ClassQuery, ClassTerm, Part, class_query
from semdb.database import retry
from semdb.database.checked import LARGEST
from semdb.database.records import ScoredKeyframe
from semdb.database.tables import categories, completed_categories, keyframe_categories, keyframes, recordings

CHUNK = 500
_COLUMNS = {Part.COUNT: "count", Part.UPPER: "upper_strength", Part.LOWER: "lower_strength"}


def classes_of_keyframes(completed: bool) -> Table:
    """Where the classes of keyframes are: as they were seen, or completed (see `semdb.database.completions`)."""
    return completed_categories if completed else keyframe_categories


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
            keyframe_categories.c.count > 0,
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
    engine: Engine,
    map_id: int,
    query: ClassQuery,
    minimum_share: float,
    at_most: int | None = None,
    completed: bool = False,
) -> list[ScoredKeyframe]:
    """Keyframes of a map with a class score of at least `minimum_share`: the best `at_most` of them (None: all).

    Best first, equal ones by id. Keyframes that share no class with the query are never among them. `completed`: by
    the classes that landmarks complete, where `completions.completion_of` says that they are to be used.
    """

    def work(connection: Connection) -> list[ScoredKeyframe]:
        known = _known(connection, query)
        if not known:
            return []
        keyframe_id, points = _scores(classes_of_keyframes(completed), map_id, query, known)
        statement = select(keyframe_id, points).where(points >= query.least(minimum_share))
        statement = statement.order_by(points.desc(), keyframe_id).limit(at_most)
        rows = connection.execute(statement)
        return [ScoredKeyframe(row[0], int(row[1]) / query.whole) for row in rows if _is_score(row[1], query)]

    return retry.read(engine, work)


def class_scores(engine: Engine, map_id: int, query: ClassQuery, keyframe_ids: Sequence[int]) -> dict[int, float]:
    """Class scores of these keyframes; those that share no class with the query are left out."""
    keys = [int(key) for key in keyframe_ids]

    def work(connection: Connection) -> dict[int, float]:
        known = _known(connection, query)
        found: dict[int, float] = {}
        for start in range(0, len(keys) if known else 0, CHUNK):
            keyframe_id, points = _scores(keyframe_categories, map_id, query, known, keys[start : start + CHUNK])
            rows = connection.execute(select(keyframe_id, points).where(points > 0))
            found.update((row[0], int(row[1]) / query.whole) for row in rows if _is_score(row[1], query))
        return found

    return retry.read(engine, work)


def _is_score(points: Any, query: ClassQuery) -> bool:
    """Not of a keyframe whose strength, which SQLite may have as anything, divides by nothing.

    That of all there is may be a little more than one, by rounding.
    """
    return isinstance(points, int | float | Decimal) and 0 <= points <= 2 * query.whole


def _known(connection: Connection, query: ClassQuery) -> list[tuple[int, ClassTerm]]:
    """The terms of classes that the database knows, with the ids of these."""
    if not query.terms:
        return []
    names = sorted({term.category for term in query.terms})
    statement = select(categories.c.name, categories.c.id).where(categories.c.name.in_(names))
    ids = {str(name): int(key) for name, key in connection.execute(statement)}
    return sorted(
        ((ids[term.category], term) for term in query.terms if term.category in ids), key=lambda pair: pair[0]
    )


def _scores(
    table: Table,
    map_id: int,
    query: ClassQuery,
    known: list[tuple[int, ClassTerm]],
    keyframe_ids: Sequence[int] | None = None,
) -> tuple[ColumnElement[int], ColumnElement[int]]:
    """Keyframe and points of all keyframes of a map, or of these, that have a row of a class of the query.

    The sums are in a subquery, so that a server adds once, however often a condition or an order names them. A
    quotient is taken of what can be divided: servers round each in their own way.
    """
    c = table.c
    ids = sorted({category_id for category_id, _ in known})
    columns = [c.keyframe_id, func.sum(_contribution(table, known)).label("shared")]
    if query.per_held:
        columns.append(func.max(c.keyframe_strength).label("held"))
    rows = select(*columns).where(c.map_id == map_id).group_by(c.keyframe_id)
    if keyframe_ids is not None:
        rows = rows.where(c.category_id.in_(ids), c.keyframe_id.in_(keyframe_ids))
    else:
        # Class by class: MariaDB otherwise prefers to read the index entries of all classes of the map.
        rows = rows.join_from(categories, table, c.category_id == categories.c.id)
        rows = rows.where(categories.c.id.in_(ids)).prefix_with("STRAIGHT_JOIN", dialect="mysql")
    sums = rows.subquery("sums").c
    if not query.per_held:
        return sums.keyframe_id, sums.shared
    whole = literal(query.total, BigInteger) + literal(query.per_held, BigInteger) * sums.held
    scaled, union = sums.shared * literal(SCALE, BigInteger), whole - sums.shared
    return sums.keyframe_id, (scaled - scaled % union) // union


def _contribution(table: Table, known: list[tuple[int, ClassTerm]]) -> ColumnElement[int]:
    """What one row (category, keyframe) adds: the sum of ``min(full, per_object * value)`` of its parts.

    Written out, since expressions for dozens of terms take SQLAlchemy longer to compile than servers to run. All that
    goes into it are integers and names of columns.
    """
    of_category: dict[int, list[str]] = {}
    for category_id, term in known:
        value, enough = f"{table.name}.{_COLUMNS[term.part]}", -(-term.full // term.per_object)
        # what is no number of objects, on SQLite, is in no range
        added = f"CASE WHEN {value} BETWEEN {enough:d} AND {LARGEST:d} THEN {term.full:d} "
        added += f"WHEN {value} BETWEEN 1 AND {enough:d} THEN {term.per_object:d} * {value} ELSE 0 END"
        of_category.setdefault(int(category_id), []).append(added)
    branches = " ".join(f"WHEN {key:d} THEN {' + '.join(added)}" for key, added in of_category.items())
    return literal_column(f"CASE {table.name}.category_id {branches} ELSE 0 END", BigInteger)
