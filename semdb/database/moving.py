"""Moving keyframes: poses, the map of their recording, the log of changes and what was before, in one transaction.

Points of keyframes are in their cameras' frames, so a move is an UPDATE of poses. Whoever reads the map sees all of it
or nothing. A keyframe that is being stored meanwhile waits: a move changes the plan of its recording first, as writers
do, and takes along in `pose_sources` what will be stored later.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import ColumnElement, Connection, Engine, bindparam, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from semdb.database import retry
from semdb.database.columns import POSE_COLUMNS
from semdb.database.ids import check_name, new_id
from semdb.database.keyframe_rows import pose_columns, pose_of
from semdb.database.links import write_covariances, write_links
from semdb.database.planning import check_models, map_model_ids
from semdb.database.pose_records import (
    Move,
    MovedRecording,
    RecordingPoses,
    World,
)
from semdb.database.pose_sources import poses_of, source_row
from semdb.database.records import ChangeKind, ItemState, RecordingState
from semdb.database.tables import (
    ingest_items,
    keyframe_categories,
    keyframe_changes,
    keyframes,
    maps,
    pose_covariances,
    pose_operations,
    pose_revisions,
    pose_sources,
    recordings,
)
from semdb.errors import DatabaseError, NotFoundError, UsageError
from semdb.types import FloatArray

T = TypeVar("T")
CHUNK = 500
SAME = 1e-9  # by which numbers of a pose may differ from those that were read
_SET_POSE = update(keyframes).where(keyframes.c.id == bindparam("of_keyframe"))


def move(engine: Engine, wanted: Move) -> int:
    """Does it, all or nothing; returns the id of the operation, which `undo` takes back.

    Raises UsageError where the map has a recording of the name or one is being ingested, ProvenanceError where other
    models made the map, NotFoundError for a recording or map that is gone, DatabaseError where keyframes changed since
    they were read.
    """
    _check(wanted)
    token = secrets.token_hex(8)
    try:
        return retry.write(engine, lambda connection: move_within(connection, wanted, token))
    except IntegrityError as error:
        names = ", ".join(repr(one.name) for one in wanted.recordings)
        raise UsageError(f"the map has a recording of the name {names} by now: give another one with --name") from error


def move_within(connection: Connection, wanted: Move, token: str) -> int:
    """As `move`, within a transaction of the caller's; done already where an operation has its `token`."""
    there = _map_of(connection, wanted.map_id)
    done = _done_before(connection, wanted.map_id, token)
    if done is not None:
        return done  # a commit whose answer was lost is run again
    for one in wanted.recordings:
        hold(connection, one)
    rows = _present(connection, {**wanted.relied_on, **wanted.before})
    _hold_poses(connection, rows)
    say_moved(connection, [*(row.recording_id for row in rows.values()), *(r.recording_id for r in wanted.recordings)])
    there_now = keyframes.c.recording_id.in_(select(recordings.c.id).where(recordings.c.map_id == wanted.map_id))
    if wanted.counted is not None and _now(connection, there_now) != wanted.counted:
        raise DatabaseError(
            f"keyframes came into the map {there!r}, or left it, meanwhile, nothing is changed: run it again"
        )
    for one in wanted.recordings:
        _check_recording(connection, one, wanted, rows)
        if one.map_id != wanted.map_id:
            models = map_model_ids(connection, wanted.map_id)
            check_models(models, map_model_ids(connection, one.map_id), f"the map {there!r}")
    _check_links(connection, wanted)
    operation = _note(connection, wanted, token)
    for one in wanted.recordings:
        _move_recording(connection, one, wanted.map_id)
    _write_poses(connection, operation, wanted, rows)
    write_links(connection, wanted.links)
    return operation


def _check(wanted: Move) -> None:
    if wanted.before.keys() != wanted.after.keys():
        raise UsageError("a move names a pose before and one after for each keyframe")
    for one in wanted.recordings:
        check_name("recording", one.name)


def _map_of(connection: Connection, map_id: int) -> str:
    name = connection.execute(select(maps.c.name).where(maps.c.id == map_id)).scalar()
    if name is None:
        raise NotFoundError(f"there is no map with the id {map_id}: it was deleted meanwhile")
    return str(name)


def hold(connection: Connection, one: MovedRecording) -> None:
    """Waits for those who store keyframes of a recording, and makes others wait.

    The same rows that a writer changes first are changed here, to what they are. Raises UsageError, NotFoundError, and
    DatabaseError where keyframes were stored or deleted after this transaction had begun to read: it would miss them.
    """
    item = ingest_items.c
    held = update(ingest_items).where(item.recording_id == one.recording_id)
    connection.execute(held.values(attempts=item.attempts))
    row = connection.execute(select(recordings).where(recordings.c.id == one.recording_id)).one_or_none()
    if row is None or row.state == RecordingState.DELETING:
        raise NotFoundError(f"the recording {one.recording_id} was deleted meanwhile")
    if row.map_id != one.map_id:
        raise DatabaseError(f"the recording {row.name!r} was moved into another map meanwhile: look, and run it again")
    running = select(func.count()).where(item.recording_id == one.recording_id, item.state == ItemState.RUNNING.value)
    if connection.execute(running).scalar():
        raise UsageError(f"the recording {row.name!r} is being ingested: run it again when that is done")
    say_held(connection, one.recording_id)
    own = keyframes.c.recording_id == one.recording_id
    if _now(connection, own) != connection.execute(select(func.count()).where(own)).scalar():
        raise DatabaseError(_stored_meanwhile(row.name))


def say_held(connection: Connection, recording_id: int) -> None:
    """Writes the rows anew, as they are, of what a recording has still to store.

    For the same reason as `say_moved`: whoever stores one of them on another node of a cluster, and this, have to write
    one row. (That a keyframe names its recording, and this changes that, are not at odds for a cluster.)
    """
    item = ingest_items.c
    open_ones = [item.recording_id == recording_id, item.state.not_in((ItemState.DONE.value, ItemState.DELETED.value))]
    found = select(ingest_items).where(*open_ones).with_for_update()
    rows = [dict(row) for row in connection.execute(found).mappings()]
    if rows:
        connection.execute(delete(ingest_items).where(*open_ones))
    for some in chunks(rows):
        connection.execute(insert(ingest_items), some)


def _now(connection: Connection, which: ColumnElement[bool]) -> int:
    """How many keyframes there are, with those that others have committed since this transaction began to read."""
    return int(connection.execute(update(keyframes).where(which).values(frame_index=keyframes.c.frame_index)).rowcount)


def _stored_meanwhile(name: str) -> str:
    return f"keyframes of {name!r} were stored or deleted meanwhile, nothing is changed: run it again"


def _present(connection: Connection, before: Mapping[int, FloatArray]) -> dict[int, Any]:
    """Rows of keyframes as they are now. Raises DatabaseError where one is gone or its pose is another."""
    k, keys = keyframes.c, sorted(before)
    columns = (k.id, k.recording_id, recordings.c.map_id, *(k[name] for name in POSE_COLUMNS))
    found: dict[int, Any] = {}
    for start in range(0, len(keys), CHUNK):
        query = select(*columns).join(recordings, recordings.c.id == k.recording_id)
        for row in connection.execute(query.where(k.id.in_(keys[start : start + CHUNK]))):
            found[int(row.id)] = row
    for key in keys:
        now = found.get(key)
        pose = None if now is None else pose_of([getattr(now, name) for name in POSE_COLUMNS], f"keyframe {key}")
        if pose is None or np.abs(pose - before[key]).max() > SAME:
            raise DatabaseError(f"keyframe {key} was deleted or moved meanwhile, nothing is changed: run it again")
    return found


def _hold_poses(connection: Connection, rows: Mapping[int, Any]) -> None:
    """Keeps others from moving keyframes, read as `rows`, until this is done. Raises DatabaseError where one did since.

    What a transaction reads may be older than what others have committed meanwhile; what it updates is not. So each is
    updated to what it is, if it is where it was.
    """
    k = keyframes.c
    near = [k[name].between(bindparam(f"low_{name}"), bindparam(f"high_{name}")) for name in POSE_COLUMNS]
    held = update(keyframes).where(k.id == bindparam("of_keyframe"), *near).values(frame_index=k.frame_index)
    for key in sorted(rows):
        numbers = {name: float(getattr(rows[key], name)) for name in POSE_COLUMNS}
        low = {f"low_{name}": value - SAME for name, value in numbers.items()}
        high = {f"high_{name}": value + SAME for name, value in numbers.items()}
        if connection.execute(held, {"of_keyframe": key, **low, **high}).rowcount != 1:
            raise DatabaseError(f"keyframe {key} was deleted or moved meanwhile, nothing is changed: run it again")


def say_moved(connection: Connection, recording_ids: Iterable[int]) -> None:
    """Writes the rows of `pose_sources` anew, as they are: of the recordings that a move moves or relies on.

    Nodes of a cluster do not wait for each other's rows, and what is updated to what it is, is no change that they tell
    each other of. So two moves that must not both happen have to write one row: the second to commit is run again then.
    """
    for key in sorted(set(recording_ids)):
        there = select(pose_sources).where(pose_sources.c.recording_id == key)
        row = connection.execute(there).mappings().one_or_none()
        connection.execute(delete(pose_sources).where(pose_sources.c.recording_id == key))
        said = source_row(RecordingPoses()) if row is None else dict(row)
        connection.execute(insert(pose_sources), {**said, "recording_id": key})


def _check_recording(connection: Connection, one: MovedRecording, wanted: Move, rows: Mapping[int, Any]) -> None:
    r, k = recordings.c, keyframes.c
    clash = select(r.id).where(r.map_id == wanted.map_id, r.name == one.name, r.id != one.recording_id)
    if connection.execute(clash).scalar() is not None:
        raise UsageError(
            f"the map {_map_of(connection, wanted.map_id)!r} has a recording {one.name!r} already: give this one "
            "another name with --name"
        )
    stored = set(connection.execute(select(k.id).where(k.recording_id == one.recording_id)).scalars())
    if stored != {key for key, row in rows.items() if row.recording_id == one.recording_id}:
        raise DatabaseError(_stored_meanwhile(one.name))


def _check_links(connection: Connection, wanted: Move) -> None:
    """Raises DatabaseError where a keyframe that a link names is gone."""
    ends = sorted({key for link in wanted.links for key in (link.first, link.second)})
    for some in chunks(ends):
        there = set(connection.execute(select(keyframes.c.id).where(keyframes.c.id.in_(some))).scalars())
        for key in some:
            if key not in there:
                raise DatabaseError(f"keyframe {key} was deleted meanwhile, nothing is changed: run it again")


def _done_before(connection: Connection, map_id: int, token: str) -> int | None:
    c = pose_operations.c
    newest = select(c.id, c.parameters).where(c.map_id == map_id).order_by(c.id.desc()).limit(100)
    done = [int(key) for key, text in connection.execute(newest) if token in str(text)]
    return min(done, default=None)


def _note(connection: Connection, wanted: Move, token: str) -> int:
    """The row of the operation; where several recordings move, each has one, and the first is returned."""
    first = 0
    for one in wanted.recordings or (None,):
        parameters = {**wanted.parameters, "token": token}
        row: dict[str, Any] = {"kind": wanted.kind.value, "map_id": wanted.map_id}
        if one is not None:
            parameters["before"] = source_row(poses_of(connection, one.recording_id))
            query = select(maps.c.name, recordings.c.name).join(recordings, recordings.c.map_id == maps.c.id)
            from_map, from_name = connection.execute(query.where(recordings.c.id == one.recording_id)).one()
            row |= {
                "recording_id": one.recording_id,
                "from_map_id": one.map_id,
                "from_map": from_map,
                "from_name": from_name,
            }
        key = new_id(connection, pose_operations, {**row, "parameters": json.dumps(parameters, sort_keys=True)})
        first = first or key
    return first


def _operations_of(connection: Connection, wanted: Move, first: int) -> dict[int, int]:
    """The operation of each recording that moves: those that were just noted."""
    c = pose_operations.c
    ids = [one.recording_id for one in wanted.recordings]
    query = select(c.recording_id, c.id).where(c.id >= first, c.recording_id.in_(ids), c.map_id == wanted.map_id)
    return {int(recording): int(key) for recording, key in connection.execute(query.order_by(c.id))}


def _move_recording(connection: Connection, one: MovedRecording, map_id: int) -> None:
    r, known = recordings.c, poses_of(connection, one.recording_id)
    connection.execute(update(recordings).where(r.id == one.recording_id).values(map_id=map_id, name=one.name))
    world = World.ALIGNED if one.map_id != map_id else known.world
    upright = None if one.map_id != map_id else known.upright
    motion = one.target_from_map @ known.map_from_recording
    put_source(connection, one.recording_id, RecordingPoses(known.source, world, upright, motion))


def put_source(connection: Connection, recording_id: int, found: RecordingPoses) -> None:
    """Writes where the poses of a recording come from, in place of what was said."""
    connection.execute(delete(pose_sources).where(pose_sources.c.recording_id == recording_id))
    connection.execute(insert(pose_sources), {"recording_id": recording_id, **source_row(found)})


def _write_poses(connection: Connection, first: int, wanted: Move, rows: Mapping[int, Any]) -> None:
    keys = sorted(wanted.after)
    operations = _operations_of(connection, wanted, first)
    revisions = []
    for key in keys:
        after, row = pose_columns(wanted.after[key]), rows[key]
        revisions.append(
            {
                "keyframe_id": key,
                "operation_id": operations.get(row.recording_id, first),
                **{f"before_{name}": getattr(row, name) for name in POSE_COLUMNS},
                **{f"after_{name}": value for name, value in after.items()},
            }
        )
    put_poses(connection, wanted.after, {key: rows[key].map_id for key in keys}, wanted.map_id)
    write_covariances(connection, wanted.covariances)
    for some in chunks(revisions):
        connection.execute(insert(pose_revisions), some)


def put_poses(connection: Connection, poses: Mapping[int, FloatArray], before: Mapping[int, int], map_id: int) -> None:
    """Puts keyframes to `poses` ``[4, 4]`` in the map `map_id`, from the maps `before`; the logs of both say so.

    Their covariances go.
    """
    keys = sorted(poses)
    moved = ChangeKind.MOVED.value
    changes = [
        {"map_id": log, "keyframe_id": key, "kind": moved} for key in keys for log in sorted({before[key], map_id})
    ]
    change_map = update(keyframe_categories).values(map_id=map_id)
    for some in chunks(keys):
        connection.execute(_SET_POSE, [{"of_keyframe": key, **pose_columns(poses[key])} for key in some])
        connection.execute(change_map.where(keyframe_categories.c.keyframe_id.in_(some)))
        connection.execute(delete(pose_covariances).where(pose_covariances.c.keyframe_id.in_(some)))
    for entries in chunks(changes):
        connection.execute(insert(keyframe_changes), entries)


def chunks(items: Sequence[T]) -> Iterator[Sequence[T]]:
    """`items` in parts that one statement takes."""
    for start in range(0, len(items), CHUNK):
        yield items[start : start + CHUNK]
