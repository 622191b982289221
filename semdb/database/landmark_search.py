"""Landmarks by class, by what they stand near or on, by when they were seen: one statement, the same on every server.

Scores are computed by the database. Who asks gets the best few with all that is known of them, and where nothing is
found, what is known of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy import (
    CompoundSelect,
    Connection,
    Double,
    Engine,
    Integer,
    Select,
    and_,
    bindparam,
    case,
    exists,
    func,
    literal,
    or_,
    select,
    union_all,
)
from sqlalchemy.sql.elements import ColumnElement
from sqlalchemy.sql.selectable import Subquery

from semdb.database import retry
from semdb.database.landmark_tables import (
    landmark_categories,
    landmark_relations,
    landmark_sightings,
    landmark_views,
    landmarks,
)
from semdb.database.tables import categories, keyframes, maps, objects, recordings

NEAR = ("near", "next_to", "on", "in")
ON = ("on",)
TENTATIVE = 0.5  # of the score of a confirmed landmark
WALK_M = 5.0  # from the origin: a landmark so far away has half the score
NOT_NEAR = 0.5  # a relation of this score is one
MOST_SIGHTINGS = 20  # of a hit
MOST_LISTED = 5  # of what is known where nothing is found
MOST_COUNTED = 200  # landmarks, of which it is counted where they stand
CONFIRMED, GONE = "confirmed", "gone"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is looked for, by names of classes; empty: not asked. `seen_in`: the name of a recording that shows it.

    `perhaps`: also what is rather something else, and stands near what is. In many maps it doubles the time.
    """

    classes: tuple[str, ...]
    near: tuple[str, ...] = ()
    on: tuple[str, ...] = ()
    not_near: tuple[str, ...] = ()
    map_id: int | None = None
    seen_after_ns: int | None = None
    seen_in: str | None = None
    origin: tuple[float, float, float] | None = None
    limit: int = 10
    perhaps: bool = False


@dataclass(frozen=True, slots=True)
class _Shape:
    """What a search asks for, without the values: such statements are made once."""

    near: bool
    on: bool
    not_near: bool
    map_id: bool
    seen_after_ns: bool
    seen_in: bool
    origin: bool
    perhaps: bool


def _shape(wanted: Wanted) -> _Shape:
    return _Shape(
        *(bool(wanted.near), bool(wanted.on), bool(wanted.not_near), wanted.map_id is not None),
        *(wanted.seen_after_ns is not None, wanted.seen_in is not None, wanted.origin is not None),
        wanted.perhaps,
    )


def _values(wanted: Wanted) -> dict[str, Any]:
    """The values of the parameters of its statement."""
    shape, found = _shape(wanted), {"classes": list(wanted.classes), "most": wanted.limit}
    found |= {name: list(getattr(wanted, name)) for name in ("near", "on", "not_near") if getattr(shape, name)}
    names = ("map_id", "seen_after_ns", "seen_in")
    found |= {name: getattr(wanted, name) for name in names if getattr(shape, name)}
    if wanted.origin is not None:
        found |= dict(zip(("from_x", "from_y", "from_z"), wanted.origin, strict=True))
    return found


def _ids_of(names: str | Sequence[str]) -> Any:
    """Ids of classes by their names, or by those of a parameter."""
    listed: Any = bindparam(names, expanding=True) if isinstance(names, str) else names
    return select(categories.c.id).where(categories.c.name.in_(listed))


def _related(names: str, kinds: Sequence[str]) -> Select[Any]:
    """Relations of the landmark of the query around to any of the classes."""
    r = landmark_relations.c  # of landmarks that are gone there are none
    return (
        select(r.score)
        .where(r.landmark_id == landmarks.c.id, r.other_category_id.in_(_ids_of(names)), r.kind.in_(kinds))
        .correlate(landmarks)
    )


def statement(wanted: Wanted) -> Select[Any]:
    """The search as one statement: the best landmarks, the best first, with the parts of their scores."""
    return _statement(_shape(wanted)).params(**_values(wanted))


@lru_cache(maxsize=128)
def _statement(wanted: _Shape) -> Select[Any]:
    m = landmarks.c
    conditions = _conditions(wanted)
    one: ColumnElement[Any] = literal(1.0)
    near = one if not wanted.near else _relation("near", NEAR, perhaps=wanted.perhaps)
    on = one if not wanted.on else _relation("on", ON, perhaps=wanted.perhaps)
    state = case((m.state == CONFIRMED, 1.0), else_=TENTATIVE)
    squared: ColumnElement[Any] = literal(0.0)
    if wanted.origin:
        x, y, z = (bindparam(name, type_=Double) for name in ("from_x", "from_y", "from_z"))
        squared = (m.x - x) * (m.x - x) + (m.y - y) * (m.y - y) + (m.z - z) * (m.z - z)
    parts = (
        near.label("near_score"),
        on.label("on_score"),
        state.label("state_score"),
        (WALK_M * WALK_M / (WALK_M * WALK_M + squared)).label("distance_score"),
        squared.label("distance_squared"),
    )
    rows = select(m.id.label("landmark_id"), m.probability.label("class_score"), *parts).where(
        m.category_id.in_(_ids_of("classes")), *conditions
    )
    scored = (_with_others(rows, parts, conditions, wanted) if wanted.perhaps else rows).subquery("scored")
    s = scored.c
    score = (s.class_score * s.near_score * s.on_score * s.state_score * s.distance_score).label("score")
    best = (
        select(*s, score)
        .where(s.near_score.is_not(None), s.on_score.is_not(None))
        .order_by(score.desc(), s.landmark_id)
        .limit(bindparam("most", type_=Integer))
        .subquery("best")
    )
    return _with_details(best)


def _with_others(rows: Select[Any], parts: Any, conditions: Sequence[Any], wanted: _Shape) -> CompoundSelect[Any]:
    """`rows`, and those of landmarks that are rather of another class."""
    m, rather = landmarks.c, _rather_something_else(wanted)
    others = select(m.id.label("landmark_id"), rather.c.class_score, *parts)
    others = others.select_from(rather.join(landmarks, m.id == rather.c.landmark_id))
    return union_all(rows, others.where(m.category_id.not_in(_ids_of("classes")), *conditions))


def _rather_something_else(wanted: _Shape) -> Subquery:
    """Landmarks that are rather of another class, but may be of one that is looked for, and how likely."""
    c = landmark_categories.c
    found = select(c.landmark_id, func.sum(c.probability).label("class_score")).where(
        c.category_id.in_(_ids_of("classes"))
    )
    if wanted.map_id:
        found = found.where(c.map_id == bindparam("map_id"))
    return found.group_by(c.landmark_id).subquery("rather")


def _relation(names: str, kinds: Sequence[str], *, perhaps: bool) -> ColumnElement[Any]:
    """The highest score of a relation of the landmark of the query around to any of the classes; null without any.

    With `perhaps`, where it has none, one to what may be of them counts as much less as it is less likely. How likely
    is asked for each relation of the landmark, not the other way round: of a class there may be many in a map.
    """
    r, c = landmark_relations.c, landmark_categories.c
    sure = _related(names, kinds).with_only_columns(func.max(r.score)).correlate(landmarks).scalar_subquery()
    if not perhaps:
        return sure
    likely = (
        select(func.max(c.probability))
        .where(c.category_id.in_(_ids_of(names)), c.map_id == landmarks.c.map_id, c.landmark_id == r.other_landmark_id)
        .correlate(landmarks, landmark_relations)
        .scalar_subquery()
    )
    possible = (
        select(func.max(r.score * likely))
        .where(r.landmark_id == landmarks.c.id, r.kind.in_(kinds))
        .correlate(landmarks)
        .scalar_subquery()
    )
    return func.coalesce(sure, possible)


def _conditions(wanted: _Shape, *, gone: bool = False) -> list[ColumnElement[bool]]:
    """What a landmark has to be besides of a class."""
    m = landmarks.c
    found = [m.state == GONE if gone else m.state != GONE]
    if wanted.map_id:
        found.append(m.map_id == bindparam("map_id"))
    if wanted.not_near:
        there = _related("not_near", NEAR).where(landmark_relations.c.score >= NOT_NEAR)
        found.append(~exists(there.with_only_columns(literal(1))))
    if wanted.seen_after_ns:
        found.append(m.last_seen_ns >= bindparam("seen_after_ns"))
    if wanted.seen_in:
        seen = (
            select(literal(1))
            .select_from(landmark_sightings.join(objects).join(keyframes, keyframes.c.id == objects.c.keyframe_id))
            .join(recordings, recordings.c.id == keyframes.c.recording_id)
            .where(landmark_sightings.c.landmark_id == m.id, recordings.c.name == bindparam("seen_in"))
            .correlate(landmarks)
        )
        found.append(exists(seen))
    return found


def _with_details(best: Any) -> Select[Any]:
    """The rows of `best` with names, box, last sighting and the view from which each is seen best."""
    m, b = landmarks.c, best.c
    last, last_of = keyframes.alias("last"), recordings.alias("last_of")
    view, seen, at, at_of = (
        landmark_views.alias("view"),
        objects.alias("seen"),
        keyframes.alias("at_"),
        recordings.alias("at_of"),
    )
    joined = (
        best.join(landmarks, m.id == b.landmark_id)
        .join(categories, categories.c.id == m.category_id)
        .join(maps, maps.c.id == m.map_id)
        .outerjoin(last, last.c.id == m.last_keyframe_id)
        .outerjoin(last_of, last_of.c.id == last.c.recording_id)
        .outerjoin(view, and_(view.c.landmark_id == m.id, view.c.place == 0))
        .outerjoin(seen, seen.c.id == view.c.object_id)
        .outerjoin(at, at.c.id == seen.c.keyframe_id)
        .outerjoin(at_of, at_of.c.id == at.c.recording_id)
    )
    columns = [column for column in m if column.name not in ("id", "appearance", "evidence", "category_id", "map_id")]
    pose = [at.c[name].label(f"view_{name}") for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz")]
    box = [seen.c[name].label(f"view_{name}") for name in ("x1", "y1", "x2", "y2")]
    return (
        select(*b, *columns, categories.c.name.label("category"), maps.c.name.label("map"))
        .add_columns(last_of.c.name.label("last_recording"), last.c.frame_index.label("last_frame_index"))
        .add_columns(at.c.id.label("view_keyframe_id"), at.c.frame_index.label("view_frame_index"))
        .add_columns(at_of.c.name.label("view_recording"), view.c.distance.label("view_distance"), *pose, *box)
        .select_from(joined)
        .order_by(b.score.desc(), b.landmark_id)
    )


def as_text(engine: Engine, wanted: Wanted) -> str:
    """The statement as this server gets it, values in place."""
    return str(statement(wanted).compile(engine, compile_kwargs={"literal_binds": True}))


def search(engine: Engine, wanted: Wanted) -> tuple[list[Any], dict[int, list[Any]]]:
    """The rows of `statement`, and the sightings that speak for each landmark (see `sightings_of`)."""
    query = statement(wanted)

    def work(connection: Connection) -> tuple[list[Any], dict[int, list[Any]]]:
        found = list(connection.execute(query))
        return found, sightings_of(connection, [int(row.landmark_id) for row in found])

    return retry.read(engine, work)


def sightings_of(connection: Connection, ids: Sequence[int]) -> dict[int, list[Any]]:
    """Up to `MOST_SIGHTINGS` sightings of each of a few landmarks, the clearest first."""
    found: dict[int, list[Any]] = {key: [] for key in ids}
    if not ids:
        return found
    for row in connection.execute(_sightings_statement(), {"ids": list(ids)}):
        found[int(row.landmark_id)].append(row)
    for rows in found.values():
        rows.sort(key=lambda row: (-row.visibility * row.coverage, row.recording, row.frame_index, row.object_id))
        del rows[MOST_SIGHTINGS:]
    return found


@lru_cache(maxsize=1)
def _sightings_statement() -> Select[Any]:
    s, o, k = landmark_sightings.c, objects.c, keyframes.c
    return (
        select(s.landmark_id, s.object_id, s.coverage, s.visibility, o.keyframe_id, o.score, categories.c.name)
        .add_columns(recordings.c.name.label("recording"), k.frame_index)
        .select_from(
            landmark_sightings.join(objects, o.id == s.object_id)
            .join(keyframes, k.id == o.keyframe_id)
            .join(recordings, recordings.c.id == k.recording_id)
            .join(categories, categories.c.id == o.category_id)
        )
        .where(s.landmark_id.in_(bindparam("ids", expanding=True)))
    )


@dataclass(frozen=True, slots=True)
class Unfound:
    """What is known of the classes of a search that found nothing.

    `there`, `gone`: landmarks of them that are not gone, whatever else was asked, and that are; a few, the last seen
    first. `anchors`: whether there are landmarks of the classes that it was to stand near, and on. `objects`: how many
    objects keyframes show of the classes, counted where no landmark is there. `usual`: see `_usual_places`.
    """

    there: list[Any]
    gone: list[Any]
    anchors: dict[str, bool]
    objects: int
    usual: list[tuple[str, str, int]]


def unfound(engine: Engine, wanted: Wanted) -> Unfound:
    """What is known where `search` found nothing, as of one moment."""
    plain = Wanted(wanted.classes, map_id=wanted.map_id, limit=MOST_LISTED)

    def work(connection: Connection) -> Unfound:
        there, gone = (_listed(connection, plain, gone=gone) for gone in (False, True))
        parts = (("near", wanted.near), ("on", wanted.on))
        known = {name: _any_of(connection, classes, wanted.map_id) for name, classes in parts if classes}
        number = 0 if there or gone else _objects_of(connection, wanted.classes, wanted.map_id)
        return Unfound(there, gone, known, number, _usual_places(connection, wanted.classes))

    return retry.read(engine, work)


def _listed(connection: Connection, wanted: Wanted, *, gone: bool) -> list[Any]:
    return list(connection.execute(_list_statement(_shape(wanted), gone), _values(wanted)))


@lru_cache(maxsize=16)
def _list_statement(wanted: _Shape, gone: bool) -> Select[Any]:
    """A few landmarks, the last seen first: chosen before anything is looked up of them."""
    m = landmarks.c
    last, last_of = keyframes.alias("last"), recordings.alias("last_of")
    newest = (
        select(m.id, m.last_seen_ns)
        .where(m.category_id.in_(_ids_of("classes")), *_conditions(wanted, gone=gone))
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
    found = select(literal(1)).select_from(landmarks).where(landmarks.c.category_id.in_(_ids_of("classes"))).limit(1)
    return found.where(landmarks.c.map_id == bindparam("map_id")) if in_map else found


def _objects_of(connection: Connection, names: Sequence[str], map_id: int | None) -> int:
    """How many objects of these classes keyframes show."""
    query = select(func.count()).select_from(objects.join(keyframes).join(recordings))
    query = query.where(objects.c.category_id.in_(_ids_of(names)))
    if map_id is not None:
        query = query.where(recordings.c.map_id == map_id)
    return int(connection.execute(query).scalar() or 0)


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
    newest = select(m.id).where(m.category_id.in_(_ids_of("classes"))).order_by(m.id.desc()).limit(MOST_COUNTED)
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


def known_classes(engine: Engine) -> list[str]:
    """Names of all classes."""
    return [str(name) for name in retry.read(engine, lambda c: list(c.execute(select(categories.c.name)).scalars()))]
