"""Landmarks of a map into the copy of the map in another database: ids new, all else as it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, Engine, Table, insert, select

from semdb.database import landmark_tables, retry, tables
from semdb.database.ids import new_id

Place = tuple[str, int, int]  # recording, frame, ordinal; -1 for the keyframe itself


def copy_landmarks(
    source: Engine, map_id: int, target: Engine, target_map_id: int, categories: Mapping[int, int]
) -> None:
    """Copies the landmarks of a map whose keyframes are copied; where the copy has landmarks, they stay.

    `categories` gives the ids of classes in the target by those in the source. What turned out to be another landmark
    is not copied: those ids were of the other database.
    """
    m = landmark_tables.landmarks.c
    rows = _rows(source, select(landmark_tables.landmarks).where(m.map_id == map_id).order_by(m.id))
    if not rows or _rows(target, select(m.id).where(m.map_id == target_map_id).limit(1)):
        return
    here, there = _places(source, map_id), _places(target, target_map_id)
    new = {key: there[place] for place, key in here.items() if place in there}
    keyframes = {key[1]: value[1] for key, value in new.items() if key[0] == "keyframe"}
    objects = {key[1]: value[1] for key, value in new.items() if key[0] == "object"}
    mine = select(m.id).where(m.map_id == map_id)
    hanging = {
        table: _rows(source, select(table).where(table.c.landmark_id.in_(mine)))
        for table in (
            landmark_tables.landmark_sightings,
            landmark_tables.landmark_views,
            landmark_tables.landmark_visits,
            landmark_tables.landmark_relations,
            landmark_tables.landmark_categories,
        )
    }
    recordings = _recordings(source, map_id, target, target_map_id)
    completed = _completed(source, map_id, keyframes)
    # here and not below, which may be run again
    for row in hanging[landmark_tables.landmark_relations]:
        row |= {name: categories.get(int(row[name] or 0)) for name in ("category_id", "other_category_id")}
        row["map_id"] = target_map_id
    for row in (*hanging[landmark_tables.landmark_categories], *completed.get(tables.completed_categories, ())):
        row["category_id"] = categories[int(row["category_id"])]
    for row in (row for found in (hanging[landmark_tables.landmark_categories], *completed.values()) for row in found):
        row["map_id"] = target_map_id
        if "keyframe_id" in row:
            row["keyframe_id"] = keyframes[int(row["keyframe_id"])]

    def work(connection: Connection) -> None:
        ids: dict[int, int] = {}
        for row in rows:
            values = {name: value for name, value in row.items() if name != "id"}
            values |= {"map_id": target_map_id, "category_id": categories[int(row["category_id"])]}
            for name in ("first_keyframe_id", "last_keyframe_id"):
                values[name] = None if row[name] is None else keyframes.get(int(row[name]))
            ids[int(row["id"])] = new_id(connection, landmark_tables.landmarks, values)
        for table, found in hanging.items():
            _insert(connection, table, found, ids, objects, recordings)
        for table, found in completed.items():
            for start in range(0, len(found), 500):
                connection.execute(insert(table), found[start : start + 500])

    retry.write(target, work)


def _insert(
    connection: Connection,
    table: Table,
    rows: list[dict[str, Any]],
    ids: Mapping[int, int],
    objects: Mapping[int, int],
    recordings: Mapping[int, int],
) -> None:
    made = []
    for row in rows:
        values = dict(row)
        for name in ("landmark_id", "other_landmark_id"):
            if name in values:
                values[name] = ids[int(values[name])]
        if "object_id" in values:
            if int(values["object_id"]) not in objects:
                continue
            values["object_id"] = objects[int(values["object_id"])]
        if "recording_id" in values:
            if int(values["recording_id"]) not in recordings:
                continue
            values["recording_id"] = recordings[int(values["recording_id"])]
        made.append(values)
    for start in range(0, len(made), 500):
        connection.execute(insert(table), made[start : start + 500])


def _completed(source: Engine, map_id: int, keyframes: Mapping[int, int]) -> dict[Table, list[dict[str, Any]]]:
    """What landmarks complete, of the whole map; nothing where some of its keyframes are not copied."""
    both = (tables.map_completions, tables.completed_categories)
    found = {table: _rows(source, select(table).where(table.c.map_id == map_id)) for table in both}
    if any(int(row["keyframe_id"]) not in keyframes for row in found[tables.completed_categories]):
        return {}
    return found


def _recordings(source: Engine, map_id: int, target: Engine, target_map_id: int) -> dict[int, int]:
    """Ids of recordings in the target by those in the source."""
    r = tables.recordings.c
    there = {
        row["name"]: int(row["id"]) for row in _rows(target, select(r.name, r.id).where(r.map_id == target_map_id))
    }
    here = _rows(source, select(r.name, r.id).where(r.map_id == map_id))
    return {int(row["id"]): there[row["name"]] for row in here if row["name"] in there}


def _places(engine: Engine, map_id: int) -> dict[Place, tuple[str, int]]:
    """The keyframes and objects of a map by what names them in every database."""
    k, r, o = tables.keyframes.c, tables.recordings.c, tables.objects.c
    joined = tables.keyframes.join(tables.recordings)
    of_keyframes = select(r.name, k.frame_index, k.id).select_from(joined).where(r.map_id == map_id)
    of_objects = select(r.name, k.frame_index, o.ordinal, o.id).select_from(joined.join(tables.objects))
    found: dict[Place, tuple[str, int]] = {}
    for row in _rows(engine, of_keyframes):
        found[row["name"], int(row["frame_index"]), -1] = ("keyframe", int(row["id"]))
    for row in _rows(engine, of_objects.where(r.map_id == map_id)):
        found[row["name"], int(row["frame_index"]), int(row["ordinal"])] = ("object", int(row["id"]))
    return found


def _rows(engine: Engine, query: Any) -> list[dict[str, Any]]:
    return retry.read(engine, lambda connection: [dict(row) for row in connection.execute(query).mappings()])
