"""A map's rows from one database into another: every table that hangs from it, ids new, blobs as they are.

What maps share (models, cameras, categories) is found by what makes it unique, and added where it is not there. A
keyframe is written with all its children in one transaction, and what is there already is left, so that a copy that was
cut off is finished by starting it again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection, Engine, Table, insert, or_, select

from semdb.database import checked, landmark_tables, retry, tables
from semdb.database.copying_landmarks import copy_landmarks
from semdb.database.ids import new_id
from semdb.database.links import LARGEST_ID
from semdb.database.reading import encoder_id
from semdb.database.records import ChangeKind
from semdb.database.refinements import map_state
from semdb.database.statement import HIDDEN
from semdb.errors import DatabaseError, UsageError

SHARED = {"models": "digest", "cameras": "digest", "categories": "name"}
ORDER = ("maps", "recordings", "keyframes", "objects")  # what else hangs from, each from the one before
# logs, and what links two keyframes, which goes when both are there
LANDMARKS = (
    "landmarks",
    "landmark_sightings",
    "landmark_views",
    "landmark_visits",
    "landmark_relations",
    "landmark_categories",
    "landmark_merges",
    "completed_categories",
    "map_completions",
    "landmark_parts",
)
NOT_COPIED = ("queries", "keyframe_changes", "pose_operations", "pose_revisions", "loop_closures", *LANDMARKS)
CHUNK = 16  # keyframes that are read at a time
Progress = Callable[[int, int], None]


@dataclass(slots=True)
class Copied:
    """What a copy of `map` did. `skipped` keyframes were there already."""

    map: str = ""
    recordings: int = 0
    keyframes: int = 0
    skipped: int = 0


@dataclass(slots=True)
class _Copy:
    source: Engine
    target: Engine
    ids: dict[str, dict[int, int]] = field(default_factory=dict)  # table -> source id -> target id
    done: Copied = field(default_factory=Copied)


def copy_map(source: Engine, map_id: int, target: Engine, name: str, *, progress: Progress | None = None) -> Copied:
    """Copies a map into `target` under `name`, or goes on with it.

    Raises UsageError where another map has the name, DatabaseError where the map is described by another encoder
    meanwhile: keyframes that were copied before have no vector of it.
    """
    copy = _Copy(source, target, done=Copied(name))
    encoder = _encoder(source, map_id)
    _copy_map_row(copy, map_id, name)
    total = _count(source, map_id)
    for row in _rows(source, select(tables.recordings).where(tables.recordings.c.map_id == map_id)):
        _copy_recording(copy, row, name, total, progress)
    _copy_links(copy, map_id)
    for table in _hanging_from("maps"):
        if table.name not in ("recordings", *NOT_COPIED):
            _copy_rows(copy, table, "map_id", map_id)
    if _encoder(source, map_id) != encoder:
        raise DatabaseError(
            f"the map {name!r} was described anew by another encoder while it was copied: remove the copy and start "
            "again"
        )
    of_map = (landmark_tables.landmarks, landmark_tables.landmark_categories, tables.completed_categories)
    used = [tables.categories.c.id.in_(select(t.c.category_id).where(t.c.map_id == map_id)) for t in of_map]
    names = _rows(source, select(tables.categories.c.id).where(or_(*used)))
    known = retry.write(target, lambda connection: _categories(copy, connection, names))
    copy_landmarks(source, map_id, target, copy.ids["maps"][map_id], known)
    _keep_current(source, map_id, target, copy.ids["maps"][map_id])
    return copy.done


def _encoder(source: Engine, map_id: int) -> int | None:
    return retry.read(source, lambda connection: encoder_id(connection, map_id))


def _keep_current(source: Engine, map_id: int, target: Engine, target_id: int) -> None:
    """What refinements were computed of is written with ids: those that were current are so in the copy."""
    before, after = map_state(source, map_id), map_state(target, target_id)

    def work(connection: Connection) -> None:
        for table in (tables.refinements, tables.map_completions):
            same = (table.c.map_id == target_id, table.c.map_state == before)
            connection.execute(table.update().where(*same).values(map_state=after))

    retry.write(target, work)


def _categories(copy: _Copy, connection: Connection, rows: Sequence[Mapping[str, Any]]) -> dict[int, int]:
    """The ids of classes in the target by those in the source."""
    known = copy.ids.setdefault("categories", {})
    for row in rows:
        if int(row["id"]) not in known:
            known[int(row["id"])] = _shared(copy, connection, tables.categories, int(row["id"]))
    return known


def _hanging_from(parent: str) -> list[Table]:
    """The tables that refer to `parent`, and to nothing that hangs from it, parents first."""
    below = ORDER[ORDER.index(parent) + 1 :]
    found = []
    for table in tables.metadata.sorted_tables:
        parents = {key.column.table.name for column in table.columns for key in column.foreign_keys}
        if table.name in HIDDEN:  # what is of this database alone
            continue
        if parent in parents and not parents & set(below):
            found.append(table)
    return found


def _reference(table: Table, parent: str) -> str:
    """The column of `table` that refers to `parent`."""
    return next(
        column.name for column in table.columns for key in column.foreign_keys if key.column.table.name == parent
    )


def _rows(engine: Engine, query: Any) -> list[dict[str, Any]]:
    return retry.read(engine, lambda connection: [dict(row) for row in connection.execute(query).mappings()])


def _count(engine: Engine, map_id: int) -> int:
    k, r = tables.keyframes.c, tables.recordings.c
    query = select(k.id).join(tables.recordings, r.id == k.recording_id).where(r.map_id == map_id)
    return len(_rows(engine, query))


def _copy_map_row(copy: _Copy, map_id: int, name: str) -> None:
    def work(connection: Connection) -> int:
        found = connection.execute(select(tables.maps.c.id).where(tables.maps.c.name == name)).scalar()
        return int(found) if found is not None else new_id(connection, tables.maps, {"name": name})

    copy.ids["maps"] = {map_id: retry.write(copy.target, work)}


def _translate(copy: _Copy, connection: Connection, table: Table, row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with the ids of the target; what maps share is added where it is missing."""
    found = dict(row)
    for column in table.columns:
        for key in column.foreign_keys:
            parent = key.column.table.name
            if found[column.name] is None:
                continue
            old = int(found[column.name])
            known = copy.ids.setdefault(parent, {})
            if old not in known:
                if parent not in SHARED:
                    raise DatabaseError(f"a row of {table.name} refers to {parent} {old}, which is not of this map")
                known[old] = _shared(copy, connection, key.column.table, old)
            found[column.name] = known[old]
    return found


def _shared(copy: _Copy, connection: Connection, table: Table, old: int) -> int:
    """The id in the target of a model, camera or category."""
    found_rows = _rows(copy.source, select(table).where(table.c.id == old))
    if not found_rows:
        raise DatabaseError(f"{table.name} {old}, which the map refers to, is missing: restore the database")
    row = found_rows[0]
    unique = table.c[SHARED[table.name]]
    query = select(table.c.id).where(unique == row[SHARED[table.name]])
    found = connection.execute(query).scalar()
    if found is None:
        found = new_id(connection, table, {key: value for key, value in row.items() if key != "id"})
    return int(found)


def _copy_recording(copy: _Copy, row: dict[str, Any], name: str, total: int, progress: Progress | None) -> None:
    old = int(row["id"])
    r = tables.recordings.c

    def work(connection: Connection) -> tuple[int, bool]:
        new = _translate(copy, connection, tables.recordings, row)
        same = (r.map_id == new["map_id"], r.name == row["name"])
        there = connection.execute(select(r.id, r.fingerprint).where(*same)).one_or_none()
        if there is None:
            new.pop("id")
            new |= {"state": "ingesting", "finished_at": None}
            return new_id(connection, tables.recordings, new), True
        if there.fingerprint != row["fingerprint"]:
            raise UsageError(
                f"the map {name!r} has another recording {row['name']!r} already: import under another name with --map"
            )
        return int(there.id), False

    new_key, created = retry.write(copy.target, work)
    copy.ids.setdefault("recordings", {})[old] = new_key
    copy.done.recordings += created
    for table in _hanging_from("recordings"):
        if table.name not in ("keyframes", *NOT_COPIED):
            _copy_rows(copy, table, _reference(table, "recordings"), old)
    for chunk in _keyframe_chunks(copy.source, old):
        _copy_keyframes(copy, chunk)
        if progress is not None:
            progress(copy.done.keyframes + copy.done.skipped, total)

    def finish(connection: Connection) -> None:
        values = {"state": row["state"], "finished_at": row["finished_at"]}
        connection.execute(tables.recordings.update().where(r.id == new_key).values(values))

    retry.write(copy.target, finish)


def _keyframe_chunks(engine: Engine, recording_id: int) -> Iterator[list[dict[str, Any]]]:
    k, last = tables.keyframes.c, -1
    while True:
        query = select(tables.keyframes).where(k.recording_id == recording_id, k.frame_index > last)
        rows = _rows(engine, query.order_by(k.frame_index).limit(CHUNK))
        if not rows:
            return
        yield rows
        last = int(rows[-1]["frame_index"])


def _copy_keyframes(copy: _Copy, rows: Sequence[dict[str, Any]]) -> None:
    ids = [int(row["id"]) for row in rows]
    children = {
        table: _by_parent(copy.source, table, _reference(table, "keyframes"), ids)
        for table in _hanging_from("keyframes")
        if table.name not in NOT_COPIED
    }
    object_ids = [int(item["id"]) for found in children.get(tables.objects, {}).values() for item in found]
    of_objects = {
        table: _by_parent(copy.source, table, _reference(table, "objects"), object_ids)
        for table in _hanging_from("objects")
        if table.name not in NOT_COPIED
    }
    for row in rows:
        _copy_keyframe(copy, row, children, of_objects)


def _copy_links(copy: _Copy, map_id: int) -> None:
    """Links between keyframes of the map, those that are there already left as they are."""
    k, c = tables.keyframes.c, tables.loop_closures.c
    places = {
        engine: {
            (int(row["recording_id"]), int(row["frame_index"])): int(row["id"])
            for row in _rows(engine, select(k.id, k.recording_id, k.frame_index).join(tables.recordings).where(mine))
        }
        for engine, mine in (
            (copy.source, tables.recordings.c.map_id == map_id),
            (copy.target, tables.recordings.c.map_id == copy.ids["maps"][map_id]),
        )
    }
    recordings, theirs = copy.ids.get("recordings", {}), places[copy.target]
    new = {key: theirs.get((recordings[place[0]], place[1])) for place, key in places[copy.source].items()}
    of_map = select(k.id).join(tables.recordings).where(tables.recordings.c.map_id == map_id)
    rows = _rows(copy.source, select(tables.loop_closures).where(c.keyframe_id.in_(of_map)))

    def work(connection: Connection) -> None:
        for row in rows:
            first, second = (
                new.get(checked.integer(row[name], f"loop_closures.{name}", 1, LARGEST_ID))
                for name in ("keyframe_id", "other_keyframe_id")
            )
            same = [c.keyframe_id == first, c.other_keyframe_id == second, c.kind == row["kind"]]
            if first is None or second is None or connection.execute(select(c.kind).where(*same)).first() is not None:
                continue
            ends = {"keyframe_id": first, "other_keyframe_id": second}
            connection.execute(insert(tables.loop_closures), {**row, **ends})

    retry.write(copy.target, work)


def _by_parent(engine: Engine, table: Table, column: str, ids: Sequence[int]) -> dict[int, list[dict[str, Any]]]:
    found: dict[int, list[dict[str, Any]]] = {}
    for start in range(0, len(ids), 500):
        query = select(table).where(table.c[column].in_(ids[start : start + 500]))
        if "ordinal" in table.c:
            query = query.order_by(table.c.ordinal)
        for row in _rows(engine, query):
            found.setdefault(int(row[column]), []).append(row)
    return found


def _copy_keyframe(
    copy: _Copy,
    row: dict[str, Any],
    children: Mapping[Table, Mapping[int, list[dict[str, Any]]]],
    of_objects: Mapping[Table, Mapping[int, list[dict[str, Any]]]],
) -> None:
    old, k = int(row["id"]), tables.keyframes.c

    def work(connection: Connection) -> bool:
        new = _translate(copy, connection, tables.keyframes, row)
        there = select(k.id).where(k.recording_id == new["recording_id"], k.frame_index == row["frame_index"])
        if connection.execute(there).scalar() is not None:
            return False
        new.pop("id")
        key = new_id(connection, tables.keyframes, new)
        copy.ids["keyframes"] = {old: key}
        copy.ids["objects"] = {}
        for table, found in children.items():
            for item in found.get(old, ()):
                _insert(copy, connection, table, item)
        for table, found in of_objects.items():
            for owner in list(copy.ids["objects"]):
                for item in found.get(owner, ()):
                    _insert(copy, connection, table, item)
        map_id = next(iter(copy.ids["maps"].values()))
        change = {"map_id": map_id, "keyframe_id": key, "kind": ChangeKind.ADDED.value}
        connection.execute(insert(tables.keyframe_changes), change)
        return True

    if retry.write(copy.target, work):
        copy.done.keyframes += 1
    else:
        copy.done.skipped += 1


def _insert(copy: _Copy, connection: Connection, table: Table, row: dict[str, Any]) -> None:
    new = _translate(copy, connection, table, row)
    if "id" in table.c and table.c.id.primary_key:
        old = int(new.pop("id"))
        copy.ids.setdefault(table.name, {})[old] = new_id(connection, table, new)
    else:
        connection.execute(insert(table), new)


def _copy_rows(copy: _Copy, table: Table, column: str, old: int) -> None:
    """Rows of a table that hang from one parent, those of it that are there already left as they are."""
    rows = _rows(copy.source, select(table).where(table.c[column] == old))

    def work(connection: Connection) -> None:
        for row in rows:
            new = _translate(copy, connection, table, row)
            key = [item.name for item in table.primary_key.columns]
            if key == ["id"]:
                new.pop("id")
            else:
                same = [table.c[item] == new[item] for item in key]
                if connection.execute(select(table.c[key[0]]).where(*same)).first() is not None:
                    continue
            connection.execute(insert(table), new)

    retry.write(copy.target, work)
