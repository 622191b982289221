"""Deleting: foreign keys cascade, and each keyframe leaves a row in the change log.

Large deletions go in chunks, each one transaction, so that no server has to hold or replicate a huge one, and no
statement takes as long as a server that hangs. A recording is marked first: when the process ends in the middle,
running the same deletion again finishes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from sqlalchemy import Column, Connection, Engine, delete, insert, literal, select, update

from semdb.database import retry
from semdb.database.landmark_parts import forget_parts
from semdb.database.landmark_tables import landmark_merges, landmarks
from semdb.database.records import ChangeKind, Deleted, ItemState, RecordingState
from semdb.database.tables import (
    cameras,
    completed_categories,
    ingest_items,
    keyframe_changes,
    keyframes,
    map_models,
    maps,
    planned_links,
    planned_poses,
    queries,
    recordings,
)
from semdb.errors import NotFoundError

CHUNK = 200  # keyframes
SMALL_CHUNK = 5000  # rows of tables that nothing refers to
Progress = Callable[[int, int], None]


def delete_keyframes(engine: Engine, keyframe_ids: Iterable[int], progress: Progress | None = None) -> int:
    """Delete keyframes with all that belongs to them; ids that do not exist are passed over. Returns how many.

    The plan of their recording remembers them as deleted, so that another ingest does not bring them back.
    """
    wanted = sorted(set(keyframe_ids))
    deleted = 0
    for start in range(0, len(wanted), CHUNK):
        deleted += retry.write(engine, partial(_delete_chunk, keyframe_ids=wanted[start : start + CHUNK]))
        if progress is not None:
            progress(min(start + CHUNK, len(wanted)), len(wanted))
    if deleted:
        _drop_orphans(engine)
    return deleted


def _delete_chunk(connection: Connection, keyframe_ids: Sequence[int]) -> int:
    query = (
        select(recordings.c.map_id, keyframes.c.id, keyframes.c.recording_id, keyframes.c.frame_index)
        .join(recordings, recordings.c.id == keyframes.c.recording_id)
        .where(keyframes.c.id.in_(keyframe_ids))
        .order_by(keyframes.c.id)
    )
    there = list(connection.execute(query))
    if not there:
        return 0
    kind = ChangeKind.DELETED.value
    changes = [{"map_id": row.map_id, "keyframe_id": row.id, "kind": kind} for row in there]
    connection.execute(insert(keyframe_changes), changes)
    for recording_id in sorted({row.recording_id for row in there}):
        indexes = [row.frame_index for row in there if row.recording_id == recording_id]
        item = ingest_items.c
        mark = update(ingest_items).where(item.recording_id == recording_id, item.frame_index.in_(indexes))
        connection.execute(mark.values(state=ItemState.DELETED.value))
    connection.execute(delete(keyframes).where(keyframes.c.id.in_([row.id for row in there])))
    return len(there)


def delete_recording(engine: Engine, recording_id: int, progress: Progress | None = None) -> Deleted:
    """Delete a recording with all that belongs to it, so that nothing is left. Raises NotFoundError.

    When it was the last one of its map, the map may be described by other models from then on.
    """

    def mark(connection: Connection) -> tuple[int, list[int]]:
        change = update(recordings).where(recordings.c.id == recording_id).values(state=RecordingState.DELETING.value)
        if connection.execute(change).rowcount == 0:
            raise NotFoundError(f"there is no recording with the id {recording_id}")
        map_id = connection.execute(select(recordings.c.map_id).where(recordings.c.id == recording_id)).scalar_one()
        query = select(keyframes.c.id).where(keyframes.c.recording_id == recording_id).order_by(keyframes.c.id)
        return int(map_id), list(connection.execute(query).scalars())

    def finish(connection: Connection) -> int:
        # A writer that was under way may have added keyframes after the list was made; by now none can be.
        query = select(keyframes.c.id).where(keyframes.c.recording_id == recording_id)
        late = _delete_chunk(connection, list(connection.execute(query).scalars()))
        connection.execute(delete(recordings).where(recordings.c.id == recording_id))
        others = select(literal(1)).select_from(recordings).where(recordings.c.map_id == map_id).exists()
        connection.execute(delete(map_models).where(map_models.c.map_id == map_id, ~others))
        return late

    map_id, keyframe_ids = retry.write(engine, mark)
    deleted = delete_keyframes(engine, keyframe_ids, progress)
    # Each writer changes its row of the plan first and holds it until it commits: this waits for those that have, and
    # refuses the others. Were it left to the foreign key, keyframes that commit meanwhile would go without a trace.
    for table in (ingest_items, planned_poses, planned_links):
        _delete_rows(engine, table.c.recording_id, recording_id, table.c.frame_index)
    deleted += retry.write(engine, finish)
    _drop_orphans(engine)
    return Deleted(recordings=1, keyframes=deleted)


def delete_map(engine: Engine, map_id: int, progress: Progress | None = None) -> Deleted:
    """Delete a map with its recordings, its log of queries and its change log. Raises NotFoundError."""
    if retry.read(engine, lambda c: c.execute(select(maps.c.id).where(maps.c.id == map_id)).scalar()) is None:
        raise NotFoundError(f"there is no map with the id {map_id}")
    query = select(recordings.c.id).where(recordings.c.map_id == map_id).order_by(recordings.c.id)
    recording_ids = retry.read(engine, lambda c: list(c.execute(query).scalars()))
    deleted = sum(delete_recording(engine, recording_id, progress).keyframes for recording_id in recording_ids)
    _delete_rows(engine, keyframe_changes.c.map_id, map_id, keyframe_changes.c.id)
    for table, rank in ((landmarks, landmarks.c.id), (landmark_merges, landmark_merges.c.landmark_id)):
        _delete_rows(engine, table.c.map_id, map_id, rank)
    forget_parts(engine, map_id)
    _delete_rows(engine, completed_categories.c.map_id, map_id, completed_categories.c.category_id)
    _delete_rows(engine, queries.c.map_id, map_id, queries.c.created_at)
    retry.write(engine, lambda c: c.execute(delete(maps).where(maps.c.id == map_id)))
    return Deleted(recordings=len(recording_ids), keyframes=deleted)


def _delete_rows(engine: Engine, owner: Column[int], owner_id: int, rank: Column[Any]) -> None:
    """All rows of a table where `owner` is `owner_id`, in chunks by `rank`; an index begins with the two."""

    def work(connection: Connection) -> bool:
        query = select(rank).where(owner == owner_id).order_by(rank).limit(SMALL_CHUNK)
        ranks = list(connection.execute(query).scalars())
        if ranks:
            connection.execute(delete(owner.table).where(owner == owner_id, rank <= ranks[-1]))
        return bool(ranks)

    while retry.write(engine, work):
        pass


def _drop_orphans(engine: Engine) -> None:
    """Cameras that no keyframe has any more."""
    used = select(literal(1)).select_from(keyframes).where(keyframes.c.camera_id == cameras.c.id).exists()
    retry.write(engine, lambda c: c.execute(delete(cameras).where(~used)))
