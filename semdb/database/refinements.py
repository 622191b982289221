"""What `semdb refine` computes of a map: which state of the map it belongs to, and its tables.

Nothing marks a refinement when the map changes, since every writer would have to change one row. Its row keeps the
state of the map that it was computed from, and whoever reads it compares that with the state now.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import BigInteger, Connection, Engine, Select, cast, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from semdb.database import retry
from semdb.database.records import ClassConfusion, MapObject, Refinement
from semdb.database.tables import categories, class_confusions, keyframes, maps, objects, recordings, refinements
from semdb.errors import NotFoundError
from semdb.geometry import pose_from, rotation_from_quat_wxyz

CLASSES, POINTS = "classes", "points"  # kinds: steps of `semdb refine`
CHUNK = 500
WRITE_CHUNK = 2000
_MICRO = 1_000_000
Progress = Callable[[int, int], None]


def map_state(engine: Engine, map_id: int) -> str:
    """What a map holds, in a line: equal lines, the same keyframes at the same poses.

    Number of keyframes, newest id, sum of ids, sum of the poses in millionths. Ids are never used again, so another
    set of keyframes has another line; the change log is not asked, since it may be trimmed.
    """
    return retry.read(engine, lambda connection: _map_state(connection, map_id))


def _map_state(connection: Connection, map_id: int) -> str:
    k = keyframes.c
    # weights, so that a turn or a move along any axis shows; integers, so that no order of adding does
    mixed = k.qw + 2 * k.qx + 3 * k.qy + 5 * k.qz + 7 * k.tx + 11 * k.ty + 13 * k.tz
    pose = cast(func.round(mixed * _MICRO), BigInteger)
    query = (
        select(
            func.count(),
            func.coalesce(func.max(k.id), 0),
            func.coalesce(func.sum(k.id), 0),
            func.coalesce(func.sum(pose), 0),
        )
        .select_from(keyframes.join(recordings))
        .where(recordings.c.map_id == map_id)
    )
    return " ".join(str(int(value)) for value in connection.execute(query).one())


def list_refinements(engine: Engine, map_id: int | None = None) -> list[Refinement]:
    """The refinements of a map, or of all maps, by map and kind; each says whether the map is still the same."""

    def work(connection: Connection) -> list[Refinement]:
        query = select(refinements, maps.c.name).join(maps).order_by(refinements.c.map_id, refinements.c.kind)
        if map_id is not None:
            query = query.where(refinements.c.map_id == map_id)
        rows = list(connection.execute(query))
        states = {key: _map_state(connection, key) for key in sorted({row.map_id for row in rows})}
        return [
            Refinement(
                map_id=row.map_id,
                map=row.name,
                kind=row.kind,
                current=row.map_state == states[row.map_id],
                computed_at=row.computed_at,
                parameters=json.loads(row.parameters),
                rows=int(row.row_count),
            )
            for row in rows
        ]

    return retry.read(engine, work)


def replace_refinement(
    engine: Engine,
    map_id: int,
    kind: str,
    state: str,
    parameters: Mapping[str, Any],
    write: Callable[[Connection], int],
) -> int:
    """Replace the result of one step in one transaction; `write` replaces its rows and returns how many there are.

    Of two that run at once one waits for the other. Raises NotFoundError when the map is gone; IntegrityError when
    `write` refers to what was deleted meanwhile.
    """

    def work(connection: Connection) -> int:
        if connection.execute(select(maps.c.id).where(maps.c.id == map_id)).scalar() is None:
            raise NotFoundError(f"the map {map_id} was deleted while it was refined")
        key = (refinements.c.map_id == map_id) & (refinements.c.kind == kind)
        values = {
            "map_state": state,
            "parameters": json.dumps(dict(parameters), sort_keys=True),
            "computed_at": func.current_timestamp(),
            "row_count": 0,
        }
        # first of all, so that its lock makes another one wait
        if connection.execute(update(refinements).where(key).values(values)).rowcount == 0:
            connection.execute(insert(refinements).values(map_id=map_id, kind=kind, **values))
        rows = write(connection)
        connection.execute(update(refinements).where(key).values(row_count=rows))
        return rows

    try:
        return retry.write(engine, work)
    except IntegrityError:
        return retry.write(engine, work)  # another one made the row of the step between the two statements


def iter_objects(engine: Engine, map_id: int, progress: Progress | None = None) -> Iterator[MapObject]:
    """All objects of a map that have a place in it, by recording's name, frame and ordinal.

    Read in chunks, each a transaction of its own: what is deleted meanwhile is left out.
    """
    k, r, o = keyframes.c, recordings.c, objects.c
    listing = (
        select(k.id, r.name, k.frame_index)
        .select_from(keyframes.join(recordings))
        .where(r.map_id == map_id)
        .order_by(k.id)
    )
    listed = _rows(engine, listing)
    listed.sort(key=lambda row: (row.name, row.frame_index))
    columns = (
        *(k.qw, k.qx, k.qy, k.qz, k.tx, k.ty, k.tz),
        *(o.keyframe_id, categories.c.name, o.score),
        *(o.centroid_x, o.centroid_y, o.centroid_z, o.extent_x, o.extent_y, o.extent_z),
    )
    for start in range(0, len(listed), CHUNK):
        ids = [row.id for row in listed[start : start + CHUNK]]
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
            for row in found.get(key, ()):
                yield _map_object(place, row)
        if progress is not None:
            progress(min(start + CHUNK, len(listed)), len(listed))


def _rows(engine: Engine, query: Select[Any]) -> list[Any]:
    return retry.read(engine, lambda connection: list(connection.execute(query)))


def _map_object(keyframe: int, row: Any) -> MapObject:
    return MapObject(
        keyframe=keyframe,
        category=row.name,
        score=row.score,
        world_from_camera=pose_from(
            rotation_from_quat_wxyz([row.qw, row.qx, row.qy, row.qz]), [row.tx, row.ty, row.tz]
        ),
        centroid=(row.centroid_x, row.centroid_y, row.centroid_z),
        extent=(row.extent_x, row.extent_y, row.extent_z),
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


def load_confusions(engine: Engine, map_id: int) -> list[ClassConfusion]:
    """The class confusions of a map, by the names of the classes."""
    c, one, other = class_confusions.c, categories.alias("one"), categories.alias("other")
    query = (
        select(one.c.name, other.c.name, c.pairs, c.weight)
        .select_from(
            class_confusions.join(one, one.c.id == c.category_id).join(other, other.c.id == c.other_category_id)
        )
        .where(c.map_id == map_id)
    )
    rows = _rows(engine, query)
    return [ClassConfusion(str(a), str(b), int(pairs), int(weight)) for a, b, pairs, weight in sorted(map(tuple, rows))]
