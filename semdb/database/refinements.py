"""What `semdb refine` computes of a map: which state of the map it belongs to, and its tables.

Nothing marks a refinement when the map changes, since every writer would have to change one row. Its row keeps the
state of the map that it was computed from, and whoever reads it compares that with the state now.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from sqlalchemy import BigInteger, Connection, Engine, Select, case, cast, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.sql.elements import ColumnElement

from semdb.database import checked, retry
from semdb.database.columns import POSE_COLUMNS
from semdb.database.exact_sums import exact_sum, whole
from semdb.database.keyframe_rows import FARTHEST_POINT_M, pose_of
from semdb.database.point_rows import listed_keyframes
from semdb.database.reading import Bad
from semdb.database.records import ClassConfusion, MapObject, Refinement
from semdb.database.tables import categories, class_confusions, keyframes, maps, objects, recordings, refinements
from semdb.errors import CodecError, NotFoundError
from semdb.geometry import FARTHEST_POSE_M
from semdb.types import FloatArray

CLASSES, POINTS = "classes", "points"  # kinds: steps of `semdb refine`
FRAMES = "frames"  # none: says when frames beside keyframes were last written, to programs that keep a map
CHUNK = 500
PLACE_COLUMNS = 6  # of an object: centroid and extent
WRITE_CHUNK = 2000
MICRO = 1_000_000
Progress = Callable[[int, int], None]


def map_state(engine: Engine, map_id: int) -> str:
    """What a map holds, in a line: equal lines, the same keyframes at the same poses.

    Number of keyframes, newest id, sum of ids, sum of the poses in millionths. Ids are never used again, so another
    set of keyframes has another line; the change log is not asked, since it may be trimmed.
    """
    return retry.read(engine, lambda connection: map_state_of(connection, map_id))


def map_state_of(connection: Connection, map_id: int) -> str:
    """As `map_state`, within a transaction."""
    k = keyframes.c
    # weights, so that a turn or a move along any axis shows; integers, so that no order of adding does
    mixed = within(k.qw, 1) + 2 * within(k.qx, 1) + 3 * within(k.qy, 1) + 5 * within(k.qz, 1)
    mixed = mixed + 7 * within(k.tx) + 11 * within(k.ty) + 13 * within(k.tz)
    pose = cast(func.round(mixed * MICRO), BigInteger)
    ids, poses = exact_sum(connection.engine, k.id), exact_sum(connection.engine, pose)
    query = select(func.count(), func.coalesce(func.max(k.id), 0), *ids, *poses)
    query = query.select_from(keyframes.join(recordings)).where(recordings.c.map_id == map_id)
    number, newest, *sums = connection.execute(query).one()
    return f"{int(number)} {int(newest)} {whole(sums[: len(ids)])} {whole(sums[len(ids) :])}"


def within(column: ColumnElement[float], most: float = FARTHEST_POSE_M) -> ColumnElement[float]:
    """A number of a pose; 0 for one that no pose has, which could overflow, and which is left out elsewhere."""
    return case((column.between(-2 * most, 2 * most), column), else_=0.0)


def list_refinements(
    engine: Engine, map_id: int | None = None, say: Callable[[str], None] | None = None
) -> list[Refinement]:
    """The refinements of a map, or of all maps, by map and kind; each says whether the map is still the same.

    Frames beside keyframes are none: they are not out of date when a map grows.

    A row that is none is left out and told to `say`, or raises CodecError.
    """
    parameters = checked.up_to(refinements.c.parameters, checked.MOST_JSON)
    columns = [parameters if column.name == "parameters" else column for column in refinements.c]

    def work(connection: Connection) -> list[Refinement]:
        query = select(*columns, maps.c.name).join(maps).order_by(refinements.c.map_id, refinements.c.kind)
        query = query.where(refinements.c.kind != FRAMES)
        if map_id is not None:
            query = query.where(refinements.c.map_id == map_id)
        rows = list(connection.execute(query))
        states = {key: map_state_of(connection, key) for key in sorted({row.map_id for row in rows})}
        found = []
        for row in rows:
            try:
                found.append(_refinement(row, states[row.map_id]))
            except CodecError as error:
                if say is None:
                    raise
                say(f"a result of semdb refine is left out, run semdb refine --force: {error}")
        return found

    return retry.read(engine, work)


def _refinement(row: Any, state: str) -> Refinement:
    where = f"of step {checked.shown(row.kind)} of map {row.map_id}"
    return Refinement(
        map_id=row.map_id,
        map=checked.text(row.name, f"maps.name of map {row.map_id}"),
        kind=checked.text(row.kind, f"refinements.kind of map {row.map_id}", 32),
        current=row.map_state == state,
        computed_at=checked.moment(row.computed_at, f"refinements.computed_at {where}"),
        parameters=checked.mapping(row.parameters, f"refinements.parameters {where}"),
        rows=checked.integer(row.row_count, f"refinements.row_count {where}", 0, 2**63 - 1),
    )


def replace_refinement(
    engine: Engine,
    map_id: int,
    kind: str,
    state: str | None,
    parameters: Mapping[str, Any],
    write: Callable[[Connection], int],
) -> int:
    """Replace the result of one step in one transaction; `write` replaces its rows and returns how many there are.

    `state` is what the map held when it was read; None: what it holds when `write` is done, which changes it.

    Of two that run at once one waits for the other. Raises NotFoundError when the map is gone; IntegrityError when
    `write` refers to what was deleted meanwhile.
    """

    def work(connection: Connection) -> int:
        if connection.execute(select(maps.c.id).where(maps.c.id == map_id)).scalar() is None:
            raise NotFoundError(f"the map {map_id} was deleted while it was refined")
        key = (refinements.c.map_id == map_id) & (refinements.c.kind == kind)
        values = {
            "map_state": state or "",
            "parameters": json.dumps(dict(parameters), sort_keys=True),
            "computed_at": func.current_timestamp(),
            "row_count": 0,
        }
        # first of all, so that its lock makes another one wait
        if connection.execute(update(refinements).where(key).values(values)).rowcount == 0:
            connection.execute(insert(refinements).values(map_id=map_id, kind=kind, **values))
        rows = write(connection)
        after = {} if state is not None else {"map_state": map_state_of(connection, map_id)}
        connection.execute(update(refinements).where(key).values(row_count=rows, **after))
        return rows

    try:
        return retry.write(engine, work)
    except IntegrityError:
        return retry.write(engine, work)  # another one made the row of the step between the two statements


def forget(engine: Engine, map_id: int, kind: str) -> None:
    """Makes a step be computed again, whatever its map holds; its rows stay until then."""
    key = (refinements.c.map_id == map_id) & (refinements.c.kind == kind)
    retry.write(engine, lambda connection: connection.execute(update(refinements).where(key).values(map_state="")))


def iter_objects(
    engine: Engine, map_id: int, progress: Progress | None = None, bad: Bad | None = None
) -> Iterator[MapObject]:
    """All objects of a map that have a place in it, by recording's name, frame and ordinal.

    Read in chunks, each a transaction of its own: what is deleted meanwhile is left out. A keyframe with a damaged row
    is left out and told to `bad`, or raises CodecError.
    """
    k, o = keyframes.c, objects.c
    listed = [item.id for item in listed_keyframes(engine, map_id)]
    columns = (
        *(k.qw, k.qx, k.qy, k.qz, k.tx, k.ty, k.tz),
        *(o.keyframe_id, categories.c.name, o.score),
        *(o.centroid_x, o.centroid_y, o.centroid_z, o.extent_x, o.extent_y, o.extent_z),
    )
    for start in range(0, len(listed), CHUNK):
        ids = listed[start : start + CHUNK]
        query = (
            select(*columns)
            .select_from(objects.join(keyframes).join(categories))
            .where(o.keyframe_id.in_(ids), o.centroid_x.is_not(None), o.extent_x.is_not(None))
            .order_by(o.keyframe_id, o.ordinal)
        )
        found: dict[int, list[Any]] = {}
        for row in _rows(engine, query):
            found.setdefault(row.keyframe_id, []).append(row)
        for place, key in enumerate(ids, start):
            try:
                yield from _map_objects(place, found.get(key, ()))
            except CodecError as error:
                if bad is None:
                    raise
                bad(key, error)
        if progress is not None:
            progress(min(start + CHUNK, len(listed)), len(listed))


def _rows(engine: Engine, query: Select[Any]) -> list[Any]:
    return retry.read(engine, lambda connection: list(connection.execute(query)))


def _map_objects(keyframe: int, rows: Sequence[Any]) -> list[MapObject]:
    """The objects of one keyframe."""
    if not rows:
        return []
    pose = pose_of([getattr(rows[0], name) for name in POSE_COLUMNS], f"keyframe {rows[0].keyframe_id}")
    numbers = checked.numbers_of([tuple(row)[-PLACE_COLUMNS:] for row in rows], PLACE_COLUMNS)
    if not (np.abs(numbers) <= FARTHEST_POINT_M).all():
        return [_map_object(keyframe, pose, row) for row in rows]  # raises for the one that is none
    found = []
    for row, (x, y, z, *extent) in zip(rows, numbers.tolist(), strict=True):
        name = checked.text(row.name, f"categories.name of an object of keyframe {row.keyframe_id}")
        score = checked.real(row.score, f"objects.score of an object of keyframe {row.keyframe_id}", 0.0, 1.0)
        found.append(MapObject(keyframe, name, score, pose, (x, y, z), (extent[0], extent[1], extent[2])))
    return found


def _map_object(keyframe: int, world_from_camera: FloatArray, row: Any) -> MapObject:
    where = f"of an object of keyframe {row.keyframe_id}"

    def place(name: str) -> tuple[float, float, float]:
        limits = (-FARTHEST_POINT_M, FARTHEST_POINT_M)
        x, y, z = (checked.real(getattr(row, f"{name}_{a}"), f"objects.{name}_{a} {where}", *limits) for a in "xyz")
        return x, y, z

    return MapObject(
        keyframe=keyframe,
        category=checked.text(row.name, f"categories.name {where}"),
        score=checked.real(row.score, f"objects.score {where}", 0.0, 1.0),
        world_from_camera=world_from_camera,
        centroid=place("centroid"),
        extent=place("extent"),
    )


def replace_confusions(connection: Connection, map_id: int, confusions: Sequence[ClassConfusion]) -> int:
    """Write the class confusions of a map in place of those that are there. Returns how many."""
    connection.execute(delete(class_confusions).where(class_confusions.c.map_id == map_id))
    names = sorted({name for found in confusions for name in (found.category, found.other)})
    known: dict[str, int] = {}
    for start in range(0, len(names), CHUNK):
        query = select(categories.c.name, categories.c.id).where(categories.c.name.in_(names[start : start + CHUNK]))
        known.update((name, key) for name, key in connection.execute(query))
    rows = [
        {
            "map_id": map_id,
            "category_id": known[found.category],
            "other_category_id": known[found.other],
            "pairs": found.pairs,
            "weight": found.weight,
        }
        for found in confusions
    ]
    for start in range(0, len(rows), WRITE_CHUNK):
        connection.execute(insert(class_confusions), rows[start : start + WRITE_CHUNK])
    return len(rows)


def load_confusions(engine: Engine, map_id: int, say: Callable[[str], None] | None = None) -> list[ClassConfusion]:
    """The class confusions of a map, by the names of the classes.

    A row that is none is left out and told to `say`, or raises CodecError.
    """
    c, one, other = class_confusions.c, categories.alias("one"), categories.alias("other")
    query = (
        select(one.c.name, other.c.name, c.pairs, c.weight)
        .select_from(
            class_confusions.join(one, one.c.id == c.category_id).join(other, other.c.id == c.other_category_id)
        )
        .where(c.map_id == map_id)
    )
    found = []
    for row in _rows(engine, query):
        try:
            found.append(_confusion(map_id, *row))
        except CodecError as error:
            if say is None:
                raise
            say(f"a confusion of classes is left out, run semdb refine --force: {error}")
    return sorted(found, key=lambda item: (item.category, item.other))


def _confusion(map_id: int, category: Any, other: Any, pairs: Any, weight: Any) -> ClassConfusion:
    where = f"of {checked.shown(category)} and {checked.shown(other)} in map {map_id}"
    return ClassConfusion(
        checked.text(category, f"categories.name {where}"),
        checked.text(other, f"categories.name {where}"),
        checked.integer(pairs, f"class_confusions.pairs {where}", 0, 2**63 - 1),
        checked.integer(weight, f"class_confusions.weight {where}", 0, MICRO),
    )
