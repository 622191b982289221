"""Taking back what moved keyframes: the poses, the map and the name that were before, in one transaction."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import Connection, Engine, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from semdb.database import checked, retry
from semdb.database.columns import POSE_COLUMNS
from semdb.database.ids import new_id
from semdb.database.keyframe_rows import pose_of
from semdb.database.links import matrix_blob, matrix_of
from semdb.database.moving import SAME, chunks, hold, put_poses, put_source, say_moved
from semdb.database.pose_records import (
    LinkKind,
    MovedRecording,
    OperationKind,
    PoseOperation,
    PoseSource,
    RecordingPoses,
    World,
)
from semdb.database.pose_sources import poses_of, turned
from semdb.database.tables import (
    keyframes,
    loop_closures,
    map_models,
    maps,
    planned_poses,
    pose_covariances,
    pose_operations,
    pose_revisions,
    pose_sources,
    recordings,
)
from semdb.errors import DatabaseError, UsageError
from semdb.geometry import invert_pose
from semdb.shown import for_shell
from semdb.types import FloatArray


def list_operations(engine: Engine, map_id: int | None = None, recording_id: int | None = None) -> list[PoseOperation]:
    """What moved keyframes, newest first: of a map, of a recording, or all. Raises CodecError."""
    c = pose_operations.c
    columns = [checked.up_to(column, checked.MOST_JSON) if column.name == "parameters" else column for column in c]
    query = select(*columns).order_by(c.id.desc())
    if map_id is not None:
        query = query.where(c.map_id == map_id)
    if recording_id is not None:
        query = query.where(c.recording_id == recording_id)
    return [_operation(row) for row in retry.read(engine, lambda connection: list(connection.execute(query)))]


def _operation(row: Any) -> PoseOperation:
    where = f"of operation {row.id}"
    undone = row.undone_at
    return PoseOperation(
        id=int(row.id),
        kind=checked.choice(row.kind, f"pose_operations.kind {where}", OperationKind),
        map_id=checked.integer(row.map_id, f"pose_operations.map_id {where}"),
        recording_id=_id(row.recording_id, f"pose_operations.recording_id {where}"),
        from_map_id=_id(row.from_map_id, f"pose_operations.from_map_id {where}"),
        from_map=_name(row.from_map, f"pose_operations.from_map {where}"),
        from_name=_name(row.from_name, f"pose_operations.from_name {where}"),
        parameters=checked.mapping(row.parameters, f"pose_operations.parameters {where}"),
        created_at=checked.moment(row.created_at, f"pose_operations.created_at {where}"),
        undone_at=None if undone is None else checked.moment(undone, f"pose_operations.undone_at {where}"),
    )


def _id(value: object, where: str) -> int | None:
    return None if value is None else checked.integer(value, where)


def _name(value: object, where: str) -> str | None:
    return None if value is None else checked.text(value, where)


def undo(engine: Engine, operation: PoseOperation) -> int:
    """Takes an operation back, all or nothing; returns how many keyframes are where they were.

    Raises UsageError where it was taken back already, or its keyframes were moved since, or the name is taken by now,
    or the map that it came from has another frame by now.
    """
    mine: list[bool] = []
    try:
        return retry.write(engine, partial(_undo, operation=operation, mine=mine))
    except IntegrityError as error:
        raise UsageError(
            f"the map {operation.from_map!r} has another recording {operation.from_name!r} by now: delete that first"
        ) from error


def _undo(connection: Connection, operation: PoseOperation, mine: list[bool]) -> int:
    c, r = pose_operations.c, pose_revisions.c
    count = select(func.count()).where(r.operation_id == operation.id)
    state = connection.execute(select(c.undone_at).where(c.id == operation.id)).one_or_none()
    if state is None:
        raise UsageError(f"operation {operation.id} is not there any more")
    if state.undone_at is not None:
        if mine:  # a commit whose answer was lost is run again
            return int(connection.execute(count).scalar() or 0)
        raise UsageError(f"operation {operation.id} was taken back already")
    mine.append(True)
    if operation.recording_id is not None:
        hold(connection, MovedRecording(operation.recording_id, operation.map_id, "", np.eye(4)))
    poses = _before(connection, operation)
    _say_moved(connection, poses)
    if operation.recording_id is None:
        _refuse_before_later(connection, operation)
    map_id = operation.map_id
    if operation.recording_id is not None and operation.from_map_id != operation.map_id:
        map_id = _map_before(connection, operation)
    source = None
    if operation.recording_id is not None:
        source = _source_before(operation)
        if map_id != operation.map_id:
            _refuse_another_frame(connection, operation, map_id, source)
        poses |= _late(connection, operation, source, poses)
    mine_only = _of_recording(connection, operation, poses)
    if operation.recording_id is not None and len(mine_only) < len(poses):
        _refuse_the_map_before_others(connection, operation)
    put_poses(connection, mine_only, dict.fromkeys(mine_only, operation.map_id), map_id)
    others = {key: pose for key, pose in poses.items() if key not in mine_only}
    put_poses(connection, others, dict.fromkeys(others, operation.map_id), operation.map_id)
    if operation.recording_id is not None and source is not None:
        _recording_back(connection, operation, map_id, source)
    _covariances_back(connection, poses)
    connection.execute(update(pose_operations).where(c.id == operation.id).values(undone_at=func.current_timestamp()))
    return len(poses)


def _before(connection: Connection, operation: PoseOperation) -> dict[int, FloatArray]:
    """Poses before, of keyframes that are where the operation put them. Raises UsageError for one that is elsewhere."""
    k, v = keyframes.c, pose_revisions.c
    now = [k[name].label(f"now_{name}") for name in POSE_COLUMNS]
    query = select(pose_revisions, *now).join(keyframes, k.id == v.keyframe_id)
    found = {}
    for row in connection.execute(query.where(v.operation_id == operation.id)):
        where = f"keyframe {row.keyframe_id}"
        before, after, present = (
            pose_of([getattr(row, prefix + name) for name in POSE_COLUMNS], where)
            for prefix in ("before_", "after_", "now_")
        )
        if np.abs(after - present).max() > SAME:
            name = connection.execute(select(maps.c.name).where(maps.c.id == operation.map_id)).scalar()
            how = "" if name is None else f": {for_shell(['semdb', 'align', '--undo', '--map', str(name)])}"
            raise UsageError(
                f"{where} was moved again after operation {operation.id} ({operation.kind} of "
                f"{operation.created_at:%Y-%m-%d %H:%M}): take the later one back first{how}"
            )
        found[int(row.keyframe_id)] = before
    return found


def _refuse_before_later(connection: Connection, operation: PoseOperation) -> None:
    """Raises UsageError where a recording came into the map after its keyframes had moved: it lies as they lie now."""
    c, r = pose_operations.c, recordings.c
    there = c.recording_id.in_(select(r.id).where(r.map_id == operation.map_id))
    later = [c.map_id == operation.map_id, c.id > operation.id, c.undone_at.is_(None), there]
    # an update sees what others have committed since this transaction began to read
    if connection.execute(update(pose_operations).where(*later).values(undone_at=None)).rowcount == 0:
        return
    names = select(r.name, c.id).join(recordings, r.id == c.recording_id).where(*later).order_by(c.id.desc())
    row = connection.execute(names).first()
    which = "a recording" if row is None else f"the recording {row.name!r} (operation {row.id})"
    raise UsageError(f"{which} was laid on the keyframes of operation {operation.id} since: take that back first")


def _say_moved(connection: Connection, moved: Iterable[int]) -> None:
    k, keys = keyframes.c, set[int]()
    for some in chunks(sorted(moved)):
        keys |= set(connection.execute(select(k.recording_id).where(k.id.in_(some)).distinct()).scalars())
    say_moved(connection, keys)


def _late(
    connection: Connection, operation: PoseOperation, source: RecordingPoses, known: Mapping[int, FloatArray]
) -> dict[int, FloatArray]:
    """Poses before of keyframes of the recording that were stored after it had moved."""
    k = keyframes.c
    there = poses_of(connection, operation.recording_id or 0)
    back = source.map_from_recording @ invert_pose(there.map_from_recording)
    query = select(k.id, *(k[name] for name in POSE_COLUMNS)).where(k.recording_id == operation.recording_id)
    return {
        int(key): back @ pose_of(numbers, f"keyframe {key}")
        for key, *numbers in connection.execute(query)
        if key not in known
    }


def _of_recording(
    connection: Connection, operation: PoseOperation, poses: Mapping[int, FloatArray]
) -> dict[int, FloatArray]:
    k = keyframes.c
    if operation.recording_id is None:
        return {}
    own = set(connection.execute(select(k.id).where(k.recording_id == operation.recording_id)).scalars())
    return {key: pose for key, pose in poses.items() if key in own}


def _source_before(operation: PoseOperation) -> RecordingPoses:
    said = operation.parameters.get("before")
    where = f"pose_operations.parameters of operation {operation.id}"
    if not isinstance(said, dict):
        raise DatabaseError(f"{where}: does not say where the recording was before")
    upright = said.get("upright")
    return RecordingPoses(
        checked.choice(said.get("pose_source"), where, PoseSource),
        checked.choice(said.get("world"), where, World),
        None if upright is None else bool(upright),
        pose_of([said.get(name) for name in POSE_COLUMNS], where),
    )


def _map_before(connection: Connection, operation: PoseOperation) -> int:
    """The map that the recording came from; made again where it was deleted meanwhile, as it was empty."""
    m = maps.c
    if connection.execute(select(m.id).where(m.id == operation.from_map_id)).scalar() is None:
        if connection.execute(select(m.id).where(m.name == operation.from_map)).scalar() is not None:
            raise UsageError(
                f"the map {operation.from_map!r} that the recording came from was deleted, and there is another one of "
                "that name: delete that, or leave the recording where it is"
            )
        key = new_id(connection, maps, {"name": operation.from_map})
    else:
        key = int(operation.from_map_id or 0)
    c = map_models.c
    if connection.execute(select(c.role).where(c.map_id == key)).first() is None:
        rows = connection.execute(select(c.role, c.model_id).where(c.map_id == operation.map_id))
        made_by = [{"map_id": key, "role": row.role, "model_id": row.model_id} for row in rows]
        connection.execute(insert(map_models), made_by)
    return key


def _refuse_another_frame(
    connection: Connection, operation: PoseOperation, map_id: int, source: RecordingPoses
) -> None:
    """Raises UsageError where a recording came into the map meanwhile that has a frame of its own."""
    r, s = recordings.c, pose_sources.c
    query = select(r.name, s.world).join(pose_sources, s.recording_id == r.id, isouter=True).where(r.map_id == map_id)
    for other in connection.execute(query.order_by(r.id)):
        worlds = {source.world.value, other.world or World.RECORDING.value}
        if World.FIRST_KEYFRAME.value in worlds and World.ALIGNED.value not in worlds:
            raise UsageError(
                f"the map {operation.from_map!r} that the recording came from holds {other.name!r} by now, which has "
                "another frame: delete that, or leave the recording where it is"
            )


def _refuse_the_map_before_others(connection: Connection, operation: PoseOperation) -> None:
    """Raises UsageError where the map's own keyframes moved with this one, and recordings that moved with both stay.

    These lie where the map is now; without them it would go from under them.
    """
    c, r = pose_operations.c, recordings.c
    token = operation.parameters.get("token")
    query = select(r.name, c.parameters).join(recordings, r.id == c.recording_id)
    there = query.where(c.map_id == operation.map_id, c.id != operation.id, c.undone_at.is_(None), r.map_id == c.map_id)
    moved = connection.execute(there.order_by(c.id.desc()))
    names = [name for name, text in moved if token and str(token) in str(text)]
    if names:
        raise UsageError(
            f"the map's own keyframes moved in the same step (--joint) as {', '.join(map(repr, names))}: take that "
            "back first, this one last"
        )


def _recording_back(connection: Connection, operation: PoseOperation, map_id: int, source: RecordingPoses) -> None:
    r, c = recordings.c, loop_closures.c
    key = operation.recording_id or 0
    connection.execute(update(recordings).where(r.id == key).values(map_id=map_id, name=operation.from_name))
    put_source(connection, key, source)
    if map_id == operation.map_id:
        return
    own = select(keyframes.c.id).where(keyframes.c.recording_id == key)
    stay = select(keyframes.c.id).join(recordings).where(r.map_id == operation.map_id)
    for one, other in ((c.keyframe_id, c.other_keyframe_id), (c.other_keyframe_id, c.keyframe_id)):
        there = [c.kind == LinkKind.SESSION.value, one.in_(own), other.in_(stay)]
        connection.execute(delete(loop_closures).where(*there))


def _covariances_back(connection: Connection, poses: Mapping[int, FloatArray]) -> None:
    """Covariances of keyframes that are again where their plan put them."""
    k, p = keyframes.c, planned_poses.c
    query = select(k.id, k.recording_id, p.covariance, *(p[name] for name in POSE_COLUMNS)).join(
        planned_poses, (p.recording_id == k.recording_id) & (p.frame_index == k.frame_index)
    )
    sources: dict[int, RecordingPoses] = {}
    for some in chunks(sorted(poses)):
        for row in list(connection.execute(query.where(k.id.in_(some), p.covariance.is_not(None)))):
            if row.recording_id not in sources:
                sources[row.recording_id] = poses_of(connection, row.recording_id)
            motion = sources[row.recording_id].map_from_recording
            planned = motion @ pose_of([getattr(row, name) for name in POSE_COLUMNS], f"keyframe {row.id}")
            if np.abs(planned - poses[int(row.id)]).max() <= SAME:
                found = matrix_of(row.covariance, f"planned_poses.covariance of keyframe {row.id}")
                data = matrix_blob(turned(found, motion), f"the covariance of keyframe {row.id}")
                connection.execute(insert(pose_covariances), {"keyframe_id": row.id, "data": data})
