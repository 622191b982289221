"""What is known of classes of things where a search for them found nothing, or nothing that surely is one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy import Connection, Engine, Integer, Select, bindparam, func, literal, or_, select

from semdb.database import retry
from semdb.database.landmark_search import NOT_NEAR, Shape, Wanted, conditions, ids_of, shape_of, values_of
from semdb.database.landmark_tables import landmark_relations, landmark_sightings, landmarks
from semdb.database.tables import categories, keyframes, maps, objects, recordings

MOST_LISTED = 5
MOST_COUNTED = 200  # landmarks, of which it is counted where they stand


@dataclass(frozen=True, slots=True)
class Unfound:
    """What is known of the classes of a search that found nothing.

    `there`, `gone`: landmarks of them that are not gone, whatever else was asked, and that are; a few, the last seen
    first. `anchors`: whether there are landmarks of the classes that it was to stand near, and on. `loose`, `others`:
    how many objects keyframes show of the classes that are in no landmark, and in one of another class, counted where
    no landmark is there. `usual`: see `_usual_places`.
    """

    there: list[Any]
    gone: list[Any]
    anchors: dict[str, bool]
    loose: int
    others: int
    usual: list[tuple[str, str, int]]


def unfound(engine: Engine, wanted: Wanted) -> Unfound:
    """What is known where `search` found nothing, as of one moment."""
    plain = Wanted(wanted.classes, map_id=wanted.map_id, limit=MOST_LISTED)

    def work(connection: Connection) -> Unfound:
        there, gone = (_listed(connection, plain, gone=gone) for gone in (False, True))
        parts = (("near", wanted.near), ("on", wanted.on))
        known = {name: _any_of(connection, classes, wanted.map_id) for name, classes in parts if classes}
        loose, others = (0, 0) if there or gone else _objects_of(connection, wanted.classes, wanted.map_id)
        return Unfound(there, gone, known, loose, others, _usual_places(connection, wanted.classes))

    return retry.read(engine, work)


def _listed(connection: Connection, wanted: Wanted, *, gone: bool) -> list[Any]:
    return list(connection.execute(_list_statement(shape_of(wanted), gone), values_of(wanted)))


@lru_cache(maxsize=16)
def _list_statement(wanted: Shape, gone: bool) -> Select[Any]:
    """A few landmarks, the last seen first: chosen before anything is looked up of them."""
    m = landmarks.c
    last, last_of = keyframes.alias("last"), recordings.alias("last_of")
    newest = (
        select(m.id, m.last_seen_ns)
        .where(m.category_id.in_(ids_of("classes")), *conditions(wanted, gone=gone))
        .order_by(m.last_seen_ns.desc(), m.id)
        .limit(bindparam("most", type_=Integer))
        .subquery("newest")
    )
    return (
        select(m.id, categories.c.name.label("category"), maps.c.name.label("map"), m.x, m.y, m.z, m.last_seen_ns)
        .add_columns(last_of.c.name.label("last_recording"), last.c.frame_index.label("last_frame_index"))
        .select_from(
            newest.join(landmarks, m.id == newest.c.id)
            .join(categories, categories.c.id == m.category_id)
            .join(maps, maps.c.id == m.map_id)
            .outerjoin(last, last.c.id == m.last_keyframe_id)
            .outerjoin(last_of, last_of.c.id == last.c.recording_id)
        )
        .order_by(newest.c.last_seen_ns.desc(), newest.c.id)
    )


def _any_of(connection: Connection, names: Sequence[str], map_id: int | None) -> bool:
    """Whether there are landmarks of these classes, gone or not."""
    statement, values = _any_statement(map_id is not None), {"classes": list(names), "map_id": map_id}
    return connection.execute(statement, values if map_id is not None else {"classes": list(names)}).first() is not None


@lru_cache(maxsize=2)
def _any_statement(in_map: bool) -> Select[Any]:
    found = select(literal(1)).select_from(landmarks).where(landmarks.c.category_id.in_(ids_of("classes"))).limit(1)
    return found.where(landmarks.c.map_id == bindparam("map_id")) if in_map else found


def _objects_of(connection: Connection, names: Sequence[str], map_id: int | None) -> tuple[int, int]:
    """How many objects of these classes keyframes show: in no landmark, and in one."""
    placed = func.count(landmark_sightings.c.object_id)
    joined = objects.join(keyframes).join(recordings)
    joined = joined.outerjoin(landmark_sightings, landmark_sightings.c.object_id == objects.c.id)
    query = select(func.count(), placed).select_from(joined).where(objects.c.category_id.in_(ids_of(names)))
    if map_id is not None:
        query = query.where(recordings.c.map_id == map_id)
    every, those = connection.execute(query).one()
    return int(every) - int(those), int(those)


def _usual_places(connection: Connection, names: Sequence[str]) -> list[tuple[str, str, int]]:
    """On, in or beside what the newest `MOST_COUNTED` landmarks of these classes stand in this database: kind, class,
    how many; most first.
    """
    rows = connection.execute(_usual_statement(), {"classes": list(names)})
    return [(str(kind), str(name), int(count)) for kind, name, count in rows]


@lru_cache(maxsize=1)
def _usual_statement() -> Select[Any]:
    """Counted by the ids of classes, which get their names afterwards."""
    r, m = landmark_relations.c, landmarks.c
    newest = select(m.id).where(m.category_id.in_(ids_of("classes"))).order_by(m.id.desc()).limit(MOST_COUNTED)
    counted = newest.subquery("newest")  # servers want no limit inside of IN
    numbers = (
        select(r.kind, r.other_category_id, func.count().label("number"))
        .select_from(counted.join(landmark_relations, r.landmark_id == counted.c.id))
        .where(r.score >= NOT_NEAR)
        .where(or_(r.kind == "on", r.kind == "in", r.kind == "next_to"))
        .group_by(r.kind, r.other_category_id)
        .subquery("numbers")
    )
    n = numbers.c
    return (
        select(n.kind, categories.c.name, n.number)
        .select_from(numbers.join(categories, categories.c.id == n.other_category_id))
        .order_by(n.number.desc(), n.kind.desc(), categories.c.name)
        .limit(MOST_LISTED)
    )
