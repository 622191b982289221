"""Small reads that ingest and localization begin with: what is planned, which cameras a map has, class counts."""

from __future__ import annotations

from sqlalchemy import Connection, Engine, exists, select

from semdb.database import retry
from semdb.database.reading import camera_from_row
from semdb.database.records import MapHead
from semdb.database.tables import (
    cameras,
    categories,
    ingest_items,
    keyframe_categories,
    keyframe_images,
    keyframes,
    map_models,
    maps,
    models,
    recordings,
    refinements,
)
from semdb.errors import NotFoundError
from semdb.types import Camera, ModelInfo


def map_heads(engine: Engine) -> list[MapHead]:
    """All maps by id, with what a query must be made with: three small queries, whatever the maps hold."""
    holds = exists().where(keyframes.c.recording_id == recordings.c.id, recordings.c.map_id == maps.c.id)
    heads = select(maps.c.id, maps.c.name, holds).order_by(maps.c.id)
    m, r = models.c, refinements.c
    made_by = select(map_models.c.map_id, m.role, m.name, m.sha256, m.config)
    made_by = made_by.join(models, m.id == map_models.c.model_id).order_by(map_models.c.map_id, m.role)
    steps = select(r.map_id, r.kind, r.map_state, r.parameters, r.computed_at, r.row_count).order_by(r.map_id, r.kind)

    def work(connection: Connection) -> list[MapHead]:
        infos: dict[int, list[ModelInfo]] = {}
        for map_id, *info in connection.execute(made_by):
            infos.setdefault(map_id, []).append(ModelInfo(*info))
        refined: dict[int, list[str]] = {}
        for map_id, *step in connection.execute(steps):
            refined.setdefault(map_id, []).append(" ".join(map(str, step)))
        return [
            MapHead(int(key), name, tuple(infos.get(key, ())), tuple(refined.get(key, ())), bool(there))
            for key, name, there in connection.execute(heads)
        ]

    return retry.read(engine, work)


def planned_frames(engine: Engine, map_name: str, recording: str) -> tuple[int, ...]:
    """Frame indexes of the stored plan of a recording, ascending; empty where there is none."""
    query = (
        select(ingest_items.c.frame_index)
        .join(recordings, recordings.c.id == ingest_items.c.recording_id)
        .join(maps, maps.c.id == recordings.c.map_id)
        .where(maps.c.name == map_name, recordings.c.name == recording)
        .order_by(ingest_items.c.frame_index)
    )
    return retry.read(engine, lambda c: tuple(int(index) for index in c.execute(query).scalars()))


def map_cameras(engine: Engine, map_id: int) -> list[Camera]:
    """The different cameras of a map's keyframes, in the order of their ids."""
    used = (
        select(keyframes.c.camera_id)
        .join(recordings, recordings.c.id == keyframes.c.recording_id)
        .where(recordings.c.map_id == map_id)
    )
    query = select(cameras).where(cameras.c.id.in_(used)).order_by(cameras.c.id)
    return retry.read(engine, lambda c: [camera_from_row(row) for row in c.execute(query)])


def recording_camera(engine: Engine, recording_id: int) -> tuple[Camera, float | None]:
    """Camera and depth scale (units per metre, None without depth) of a recording's first keyframe.

    Raises NotFoundError for a recording without keyframes.
    """

    def work(connection: Connection) -> tuple[Camera, float | None]:
        query = (
            select(cameras, keyframe_images.c.depth_scale)
            .join(keyframes, keyframes.c.camera_id == cameras.c.id)
            .join(keyframe_images, keyframe_images.c.keyframe_id == keyframes.c.id)
            .where(keyframes.c.recording_id == recording_id)
            .order_by(keyframes.c.frame_index)
            .limit(1)
        )
        row = connection.execute(query).first()
        if row is None:
            raise NotFoundError(f"recording {recording_id} has no keyframe, so its camera is not known")
        return camera_from_row(row), row.depth_scale

    return retry.read(engine, work)


def category_counts(engine: Engine, map_id: int) -> list[tuple[int, str, int]]:
    """Keyframe id, class and number of objects, of every keyframe of a map that shows any."""
    table = keyframe_categories.c
    query = (
        select(table.keyframe_id, categories.c.name, table.count)
        .join(categories, categories.c.id == table.category_id)
        .where(table.map_id == map_id, table.count > 0)
    )
    return retry.read(engine, lambda c: [(int(key), str(name), int(count)) for key, name, count in c.execute(query)])
