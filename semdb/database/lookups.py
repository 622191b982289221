"""Small reads that ingest and localization begin with: what is planned, which cameras a map has, class counts."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from sqlalchemy import Connection, Engine, Select, exists, func, select
from sqlalchemy.sql.elements import ColumnElement

from semdb.database import checked, retry
from semdb.database.planning import ROLES, model_of
from semdb.database.pose_errors import measured_states
from semdb.database.reading import depth_scale_of
from semdb.database.records import MapHead, UsedCamera
from semdb.database.tables import (
    cameras,
    categories,
    ingest_items,
    keyframe_categories,
    keyframe_images,
    keyframes,
    keypoints,
    map_models,
    maps,
    models,
    recordings,
    refinements,
)
from semdb.errors import CodecError, NotFoundError
from semdb.types import Camera, ModelInfo


def map_heads(engine: Engine) -> list[MapHead]:
    """All maps by id, with what a query must be made with: four small queries, whatever the maps hold.

    A map whose rows are damaged says so itself, since the others can be used.
    """
    heads, made_by, steps = _head_queries()

    def work(connection: Connection) -> list[MapHead]:
        infos: dict[int, list[ModelInfo]] = {}
        damage: dict[int, str] = {}
        for row in connection.execute(made_by):
            try:
                infos.setdefault(row.map_id, []).append(model_of(row))
            except CodecError as error:
                damage.setdefault(row.map_id, str(error))
        refined: dict[int, list[str]] = {}
        for map_id, *step in connection.execute(steps):
            refined.setdefault(map_id, []).append(" ".join(map(str, step)))
        measured = measured_states(connection)
        found = []
        for key, name, there in connection.execute(heads):
            made = tuple(infos.get(key, ()))
            missing = [role for role in ROLES if there and all(info.role != role for info in made)]
            lacks = f"map_models of map {key} name no {' and no '.join(missing)}" if missing else ""
            known = checked.text(name, f"maps.name of map {key}")
            steps_of, wrong = tuple(refined.get(key, ())), damage.get(key, lacks)
            found.append(MapHead(key, known, made, steps_of, bool(there), wrong, measured.get(key, "")))
        return found

    return retry.read(engine, work)


@cache
def _head_queries() -> tuple[Select[Any], Select[Any], Select[Any]]:
    """Maps, their models, and what refine made of them: made once, since every image asks."""
    holds = exists().where(keyframes.c.recording_id == recordings.c.id, recordings.c.map_id == maps.c.id)
    heads = select(maps.c.id, maps.c.name, holds).order_by(maps.c.id)
    m, r = models.c, refinements.c
    made_by = select(map_models.c.map_id, m.id, m.role, m.name, m.sha256, checked.up_to(m.config, checked.MOST_JSON))
    made_by = made_by.join(models, m.id == map_models.c.model_id).order_by(map_models.c.map_id, m.role)
    parameters = checked.up_to(r.parameters, checked.MOST_JSON)
    steps = select(r.map_id, r.kind, r.map_state, parameters, r.computed_at, r.row_count).order_by(r.map_id, r.kind)
    return heads, made_by, steps


def map_id_of(engine: Engine, name: str) -> int | None:
    """The id of the map of a name as it is stored; None where there is none."""
    query = select(maps.c.id).where(maps.c.name == name)
    found = retry.read(engine, lambda connection: connection.execute(query).scalar())
    return None if found is None else int(found)


def mean_keypoints(engine: Engine) -> dict[int, float]:
    """How many keypoints a keyframe has in the mean, by map; of maps with keyframes."""
    mean = func.avg(keypoints.c["count"])
    query = select(recordings.c.map_id, mean).select_from(keypoints.join(keyframes).join(recordings))
    grouped = query.group_by(recordings.c.map_id)
    rows = retry.read(engine, lambda connection: list(connection.execute(grouped)))
    return {int(map_id): float(found) for map_id, found in rows if found is not None}


def planned_frames(engine: Engine, map_name: str, recording: str) -> tuple[int, ...]:
    """Frame indexes of the stored plan of a recording, ascending; empty where there is none."""
    query = (
        select(ingest_items.c.frame_index)
        .join(recordings, recordings.c.id == ingest_items.c.recording_id)
        .join(maps, maps.c.id == recordings.c.map_id)
        .where(maps.c.name == map_name, recordings.c.name == recording)
        .order_by(ingest_items.c.frame_index)
    )
    rows = retry.read(engine, lambda c: list(c.execute(query).scalars()))
    return tuple(checked.integer(index, f"ingest_items.frame_index of the recording {recording!r}") for index in rows)


def map_cameras(engine: Engine, map_id: int, say: Callable[[str], None] | None = None) -> list[Camera]:
    """The different cameras of a map's keyframes, in the order of their ids.

    One that is none is left out and told to `say`, or raises CodecError.
    """
    used = (
        select(keyframes.c.camera_id)
        .join(recordings, recordings.c.id == keyframes.c.recording_id)
        .where(recordings.c.map_id == map_id)
    )
    query = select(*_camera_columns()).where(cameras.c.id.in_(used)).order_by(cameras.c.id)
    found = []
    for row in retry.read(engine, lambda c: list(c.execute(query))):
        try:
            found.append(checked.camera(row, f"camera {row.id}"))
        except CodecError as error:
            if say is None:
                raise
            say(f"a camera is left out: {error}")
    return found


def used_cameras(engine: Engine, map_id: int) -> list[UsedCamera]:
    """The cameras of a map's recordings, each with every recording that it took. One that is none is left out."""
    used = (
        select(keyframes.c.recording_id, keyframes.c.camera_id)
        .join(recordings, recordings.c.id == keyframes.c.recording_id)
        .where(recordings.c.map_id == map_id)
        .distinct()
        .subquery()
    )
    query = (
        select(maps.c.name.label("map_name"), recordings.c.name.label("recording_name"), *_camera_columns())
        .join(recordings, recordings.c.map_id == maps.c.id)
        .join(used, used.c.recording_id == recordings.c.id)
        .join(cameras, cameras.c.id == used.c.camera_id)
        .where(maps.c.id == map_id)
        .order_by(recordings.c.id, cameras.c.id)
    )
    found = []
    for row in retry.read(engine, lambda c: list(c.execute(query))):
        try:
            found.append(UsedCamera(row.map_name, row.recording_name, checked.camera(row, f"camera {row.id}")))
        except CodecError:
            continue
    return found


def _camera_columns() -> list[ColumnElement[Any]]:
    distortion = checked.up_to(cameras.c.distortion, checked.MOST_DISTORTION)
    return [distortion if column.name == "distortion" else column for column in cameras.c]


def recording_camera(engine: Engine, recording_id: int) -> tuple[Camera, float | None]:
    """Camera and depth scale (units per metre, None without depth) of a recording's first keyframe.

    Raises NotFoundError for a recording without keyframes.
    """

    def work(connection: Connection) -> tuple[Camera, float | None]:
        query = (
            select(*_camera_columns(), keyframe_images.c.depth_scale, keyframe_images.c.keyframe_id)
            .join(keyframes, keyframes.c.camera_id == cameras.c.id)
            .join(keyframe_images, keyframe_images.c.keyframe_id == keyframes.c.id)
            .where(keyframes.c.recording_id == recording_id)
            .order_by(keyframes.c.frame_index)
            .limit(1)
        )
        row = connection.execute(query).first()
        if row is None:
            raise NotFoundError(f"recording {recording_id} has no keyframe, so its camera is not known")
        return checked.camera(row, f"camera {row.id}"), depth_scale_of(row.depth_scale, row.keyframe_id)

    return retry.read(engine, work)


def category_counts(engine: Engine, map_id: int) -> list[tuple[int, str, int]]:
    """Keyframe id, class and number of objects, of every keyframe of a map that shows any."""
    table = keyframe_categories.c
    query = (
        select(table.keyframe_id, categories.c.name, table.count)
        .join(categories, categories.c.id == table.category_id)
        .where(table.map_id == map_id, table.count > 0)
    )
    rows = retry.read(engine, lambda c: list(c.execute(query)))
    where = "keyframe_categories.count of keyframe"
    return [(int(key), str(name), checked.integer(count, f"{where} {key}")) for key, name, count in rows]


def title_keyframe(engine: Engine, map_id: int) -> int | None:
    """The keyframe that shows most classes, then most objects, of a map; any where there are none; None without."""
    c, k, r = keyframe_categories.c, keyframes.c, recordings.c
    richest = (
        select(c.keyframe_id)
        .where(c.map_id == map_id, c.count > 0)
        .group_by(c.keyframe_id)
        .order_by(func.count().desc(), func.sum(c.count).desc(), c.keyframe_id)
        .limit(1)
    )
    first = (
        select(func.min(k.id)).select_from(keyframes.join(recordings, r.id == k.recording_id)).where(r.map_id == map_id)
    )
    found = retry.read(engine, lambda connection: connection.execute(richest).scalar())
    if found is None:
        found = retry.read(engine, lambda connection: connection.execute(first).scalar())
    return None if found is None else int(found)
