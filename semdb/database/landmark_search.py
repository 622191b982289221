"""Landmarks by class, by what they stand near or on, by when they were seen: one statement, the same on every server.

Scores are computed by the database. Who asks gets the best few with all that is known of them, and where nothing is
found, what is known of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

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
    null,
    or_,
    select,
    union_all,
)
from sqlalchemy.sql.elements import ColumnElement
from sqlalchemy.sql.selectable import FromClause, Subquery

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
CONFIRMED, GONE = "confirmed", "gone"
THERE = (CONFIRMED, "tentative")
UNIT = 1e12  # probabilities are summed as whole multiples of its inverse


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
class Shape:
    """What a search asks for, without the values: such statements are made once."""

    near: bool
    on: bool
    not_near: bool
    map_id: bool
    seen_after_ns: bool
    seen_in: bool
    origin: bool
    perhaps: bool


def shape_of(wanted: Wanted) -> Shape:
    return Shape(
        *(bool(wanted.near), bool(wanted.on), bool(wanted.not_near), wanted.map_id is not None),
        *(wanted.seen_after_ns is not None, wanted.seen_in is not None, wanted.origin is not None),
        wanted.perhaps,
    )


def values_of(wanted: Wanted) -> dict[str, Any]:
    """The values of the parameters of its statement."""
    shape, found = shape_of(wanted), {"classes": list(wanted.classes), "most": wanted.limit}
    found |= {name: list(getattr(wanted, name)) for name in ("near", "on", "not_near") if getattr(shape, name)}
    names = ("map_id", "seen_after_ns", "seen_in")
    found |= {name: getattr(wanted, name) for name in names if getattr(shape, name)}
    if wanted.origin is not None:
        found |= dict(zip(("from_x", "from_y", "from_z"), wanted.origin, strict=True))
    return found


def ids_of(names: str | Sequence[str]) -> Any:
    """Ids of classes by their names, or by those of a parameter."""
    listed: Any = bindparam(names, expanding=True) if isinstance(names, str) else names
    return select(categories.c.id).where(categories.c.name.in_(listed))


def statement(wanted: Wanted) -> Select[Any]:
    """The search as one statement: the best landmarks, the best first, with the parts of their scores."""
    return _statement(shape_of(wanted)).params(**values_of(wanted))


@lru_cache(maxsize=128)
def _statement(wanted: Shape) -> Select[Any]:
    rows = _placed(wanted) if wanted.near or wanted.on else _all(wanted)
    scored = rows.subquery("scored")
    s, joined = scored.c, cast("FromClause", scored)
    apart: ColumnElement[Any] = literal(1.0)
    likely: list[ColumnElement[bool]] = [s.class_score.is_not(None)]
    if wanted.not_near:
        there = _related_to("not_near", NEAR, wanted).subquery("there")
        nearest = (
            select(there.c.landmark_id, func.max(there.c.sure).label("sure"))
            .add_columns(func.max(func.coalesce(there.c.sure, there.c.possible)).label("score"))
            .group_by(there.c.landmark_id)
            .subquery("nearest")
        )
        joined = scored.outerjoin(nearest, nearest.c.landmark_id == s.landmark_id)
        likely.append(or_(nearest.c.sure.is_(None), nearest.c.sure < NOT_NEAR))
        apart = 1.0 - func.coalesce(nearest.c.score, 0.0)
    score = (s.class_score * s.near_score * s.on_score * apart * s.state_score * s.distance_score).label("score")
    best = (
        select(*s, apart.label("not_near_score"), score)
        .select_from(joined)
        .where(*likely)
        .order_by(score.desc(), s.landmark_id)
        .limit(bindparam("most", type_=Integer))
        .subquery("best")
    )
    return _with_details(best)


def _parts(wanted: Shape, near: Any = None, on: Any = None) -> tuple[ColumnElement[Any], ...]:
    """What the score of a landmark is made of besides its class, and how far away it is."""
    m = landmarks.c
    one: ColumnElement[Any] = literal(1.0)
    squared: ColumnElement[Any] = literal(0.0)
    if wanted.origin:
        x, y, z = (bindparam(name, type_=Double) for name in ("from_x", "from_y", "from_z"))
        squared = (m.x - x) * (m.x - x) + (m.y - y) * (m.y - y) + (m.z - z) * (m.z - z)
    return (
        (one if near is None else near.c.score).label("near_score"),
        (one if on is None else on.c.score).label("on_score"),
        case((m.state == CONFIRMED, 1.0), else_=TENTATIVE).label("state_score"),
        (WALK_M * WALK_M / (WALK_M * WALK_M + squared)).label("distance_score"),
        squared.label("distance_squared"),
    )


def _all(wanted: Shape) -> Select[Any] | CompoundSelect[Any]:
    """Landmarks of the classes, and with `perhaps` those that are rather of another one."""
    m, parts = landmarks.c, _parts(wanted)
    rows = select(m.id.label("landmark_id"), m.probability.label("class_score"), *parts)
    rows = rows.where(m.category_id.in_(ids_of("classes")), *conditions(wanted))
    if not wanted.perhaps:
        return rows
    rather = _rather_something_else(wanted)
    others = select(m.id.label("landmark_id"), rather.c.class_score, *parts)
    others = others.select_from(rather.join(landmarks, m.id == rather.c.landmark_id))
    others = others.where(m.category_id.not_in(ids_of("classes")), *conditions(wanted))
    return union_all(rows, others)


def _placed(wanted: Shape) -> Select[Any]:
    """As `_all`, of landmarks that stand so: begins with their relations, which are few of those of a large map."""
    m = landmarks.c
    near = _relation("near", NEAR, wanted).subquery("near") if wanted.near else None
    on = _relation("on", ON, wanted).subquery("on_") if wanted.on else None
    first, second = (near, on) if near is not None else (on, None)
    assert first is not None
    joined: Any = first
    if second is not None:
        joined = joined.join(second, second.c.landmark_id == first.c.landmark_id)
    joined = joined.join(landmarks, m.id == first.c.landmark_id)
    is_one = m.category_id.in_(ids_of("classes"))
    likely = case((is_one, m.probability))
    if wanted.perhaps:  # asked of the few that are no such thing, and not of all of a large map
        c = landmark_categories.c
        rather = _perhaps("classes", wanted, _likely()).where(c.landmark_id == m.id).correlate(landmarks)
        likely = case((is_one, m.probability), else_=rather.scalar_subquery())
    rows = select(m.id.label("landmark_id"), likely.label("class_score"), *_parts(wanted, near, on)).select_from(joined)
    return rows.where(*conditions(replace(wanted, map_id=False)))  # relations are of the map


def _rather_something_else(wanted: Shape) -> Subquery:
    """Landmarks that are rather of another class, but may be of one that is looked for, and how likely."""
    c = landmark_categories.c
    found = _perhaps("classes", wanted, c.landmark_id, _likely().label("class_score"))
    return found.group_by(c.landmark_id).subquery("rather")


def _likely() -> ColumnElement[Any]:
    """How likely it is of one of some classes: a sum of whole numbers, which does not depend on their order."""
    return func.sum(func.round(landmark_categories.c.probability * UNIT)) / UNIT


def _perhaps(names: str, wanted: Shape, *columns: Any, of: Any = landmark_categories) -> Select[Any]:
    """Rows of landmarks that may be of the classes, but are rather of another."""
    found = select(*columns).where(of.c.category_id.in_(ids_of(names)))
    return found.where(of.c.map_id == bindparam("map_id")) if wanted.map_id else found


def _relation(names: str, kinds: Sequence[str], wanted: Shape) -> Select[Any]:
    """Landmarks that are looked for, and the highest score of a relation of each to any of the classes `names`.

    With `perhaps`, where it has none, one to what may be of them counts as much less as it is less likely.
    """
    every = _related_to(names, kinds, wanted).subquery("every")
    score = func.coalesce(func.max(every.c.sure), func.max(every.c.possible)).label("score")
    return select(every.c.landmark_id, score).group_by(every.c.landmark_id)


def _related_to(names: str, kinds: Sequence[str], wanted: Shape) -> Select[Any] | CompoundSelect[Any]:
    """Landmarks that are looked for with each of their relations to any of the classes `names`: the score as `sure`.

    What of one class stands so to another is one range of an index. With `perhaps` also relations to what may be of
    them, with their scores times how likely that is as `possible`. Of landmarks that are gone there are none.
    """
    r, other = landmark_relations.c, landmark_categories.alias("other")
    to_them, nothing = (r.other_category_id.in_(ids_of(names)), r.kind.in_(kinds)), null().label("possible")
    sure = select(r.landmark_id, r.score.label("sure"), nothing).where(r.category_id.in_(ids_of("classes")), *to_them)
    if wanted.map_id:
        sure = sure.where(r.map_id == bindparam("map_id"))
    if not wanted.perhaps:
        return sure
    rather = landmark_categories.alias("rather_")
    others = _perhaps("classes", wanted, r.landmark_id, r.score, nothing, of=rather)
    others = others.select_from(rather.join(landmark_relations, r.landmark_id == rather.c.landmark_id)).where(*to_them)
    either: ColumnElement[bool] = r.category_id.in_(ids_of("classes"))
    if names != "not_near":  # there it changes little of what is little already, at the price of most of the time
        either = or_(either, r.landmark_id.in_(_perhaps("classes", wanted, landmark_categories.c.landmark_id)))
    possible = _perhaps(names, wanted, r.landmark_id, null(), r.score * other.c.probability, of=other)
    possible = possible.select_from(other.join(landmark_relations, r.other_landmark_id == other.c.landmark_id))
    return union_all(sure, others, possible.where(r.kind.in_(kinds), either))


def conditions(wanted: Shape, *, gone: bool = False) -> list[ColumnElement[bool]]:
    """What a landmark has to be besides of a class."""
    m = landmarks.c
    found = [m.state == GONE if gone else m.state.in_(THERE)]
    if wanted.map_id:
        found.append(m.map_id == bindparam("map_id"))
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
    query, values = _statement(shape_of(wanted)), values_of(wanted)  # apart: what is made of a statement is kept

    def work(connection: Connection) -> tuple[list[Any], dict[int, list[Any]]]:
        found = list(connection.execute(query, values))
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


def known_classes(engine: Engine) -> list[str]:
    """Names of all classes."""
    return [str(name) for name in retry.read(engine, lambda c: list(c.execute(select(categories.c.name)).scalars()))]
