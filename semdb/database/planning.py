"""Maps, their models, and the plan of a recording: which keyframes are to be stored, and which are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, Row, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from semdb.database import checked, retry
from semdb.database.ids import SharedIds, check_name, new_id
from semdb.database.links import write_planned_links
from semdb.database.pose_records import PoseSource
from semdb.database.pose_sources import insert_links, insert_poses, poses_of
from semdb.database.records import (
    FailedItem,
    ItemState,
    MapInfo,
    PlannedRecording,
    RecordingPlan,
    RecordingState,
)
from semdb.database.tables import ingest_items, keyframes, map_models, maps, models, recordings
from semdb.errors import CodecError, DatabaseError, NotFoundError, ProvenanceError, UsageError
from semdb.shown import for_terminal
from semdb.types import ModelInfo

ROLES = ("detector", "encoder", "features")


def ensure_map(engine: Engine, name: str) -> int:
    """The id of the map `name`, made when it is not there."""
    check_name("map", name)
    for _ in range(10):
        found = retry.read(engine, lambda c: c.execute(select(maps.c.id).where(maps.c.name == name)).scalar())
        if found is not None:
            return int(found)
        try:
            retry.write(engine, lambda c: c.execute(insert(maps), {"name": name}))
        except IntegrityError:  # another process made it between the two statements
            continue
    raise DatabaseError(f"the map {name!r} could not be made; try again")


def list_maps(engine: Engine) -> list[MapInfo]:
    """All maps by id."""
    count_recordings = (
        select(func.count()).select_from(recordings).where(recordings.c.map_id == maps.c.id).scalar_subquery()
    )
    count_keyframes = (
        select(func.count())
        .select_from(keyframes.join(recordings))
        .where(recordings.c.map_id == maps.c.id)
        .scalar_subquery()
    )
    query = select(maps.c.id, maps.c.name, count_keyframes, count_recordings).order_by(maps.c.id)
    rows = retry.read(engine, lambda c: list(c.execute(query)))
    return [MapInfo(row.id, checked.text(row.name, f"maps.name of map {row.id}"), row[2], row[3]) for row in rows]


def map_model_ids(connection: Connection, map_id: int) -> dict[ModelInfo, int]:
    """The models that describe a map, by role, with their ids. Raises CodecError for what is no model."""
    config = checked.up_to(models.c.config, checked.MOST_JSON)
    query = (
        select(models.c.role, models.c.name, models.c.sha256, config, models.c.id)
        .join(map_models, map_models.c.model_id == models.c.id)
        .where(map_models.c.map_id == map_id)
        .order_by(models.c.role)
    )
    found = {model_of(row): row.id for row in connection.execute(query)}
    missing = [role for role in ROLES if all(info.role != role for info in found)]
    if found and missing:
        raise CodecError(
            f"map_models of map {map_id} name no {' and no '.join(missing)}: the map cannot be compared with"
        )
    return found


def model_of(row: Any) -> ModelInfo:
    """The model of a row that has the columns of `models`. Raises CodecError."""

    def where(column: str) -> str:
        return f"models.{column} of model {row.id}"

    if row.role not in ROLES:
        raise CodecError(f"{where('role')} is {checked.shown(row.role)}, not one of {', '.join(ROLES)}")
    checked.mapping(row.config, where("config"))
    sha256 = checked.text(row.sha256, where("sha256"), 64)
    return ModelInfo(row.role, checked.text(row.name, where("name")), sha256, row.config)


def check_models(stored: Iterable[ModelInfo], given: Iterable[ModelInfo], what: str) -> None:
    """Raises ProvenanceError, naming both, unless every role of `stored` is the same model in `given`."""
    by_role = {model.role: model for model in given}
    for model in stored:
        other = by_role.get(model.role)
        if other != model:
            raise ProvenanceError(
                f"{what} is described by the {model.role} {_describe(model)}, not by "
                f"{_describe(other) if other else 'none'}: use the same models, or another map (--map)"
            )


def _describe(model: ModelInfo) -> str:
    details = [f"sha256 {model.sha256[:12]}"] if model.sha256 else []
    if model.config not in ("", "{}"):
        details.append(model.config)
    return f"{model.name} ({', '.join(details)})" if details else model.name


def plan_recording(
    engine: Engine, ids: SharedIds, map_id: int, plan: RecordingPlan, infos: Sequence[ModelInfo]
) -> PlannedRecording:
    """Record the plan, or find it: the same plan again returns what is left.

    Raises UsageError when a recording of that name has another plan, ProvenanceError when the map is described by
    other models, NotFoundError without such a map.
    """
    _check_plan(plan, infos)
    model_ids = ids.models(infos)

    def work(connection: Connection) -> PlannedRecording:
        map_name = connection.execute(select(maps.c.name).where(maps.c.id == map_id)).scalar()
        if map_name is None:
            raise NotFoundError(f"there is no map with the id {map_id}")
        claimed = map_model_ids(connection, map_id)
        check_models(claimed, infos, f"the map {map_name!r}")
        query = select(recordings).where(recordings.c.map_id == map_id, recordings.c.name == plan.name)
        row = connection.execute(query).one_or_none()
        if row is not None:
            return _resume(connection, row, plan, map_name)
        if not claimed:
            rows = [{"map_id": map_id, "role": info.role, "model_id": model_ids[info]} for info in infos]
            connection.execute(insert(map_models), rows)
        return _insert_plan(connection, map_id, plan)

    for _ in range(10):  # another process may plan the same recording, or claim the map, at the same time
        try:
            return retry.write(engine, work)
        except IntegrityError:
            continue
    raise DatabaseError(f"the recording {plan.name!r} could not be planned; try again")


@dataclass(frozen=True, slots=True)
class StoredPlan:
    """The plan of a recording as it is in the database."""

    recording_id: int
    map_id: int
    source: str
    format: str
    frame_count: int
    fingerprint: str
    frame_indexes: tuple[int, ...]  # ascending, those of deleted keyframes too


def stored_plan(engine: Engine, recording_id: int) -> StoredPlan:
    """The plan of a recording. Raises NotFoundError for one that is not there, or is being deleted."""

    def work(connection: Connection) -> StoredPlan:
        row = connection.execute(select(recordings).where(recordings.c.id == recording_id)).one_or_none()
        if row is None or row.state == RecordingState.DELETING:
            raise NotFoundError(f"there is no recording with the id {recording_id}")
        query = select(ingest_items.c.frame_index).where(ingest_items.c.recording_id == recording_id)
        indexes = connection.execute(query.order_by(ingest_items.c.frame_index)).scalars()
        where = f"of recording {row.id}"
        return StoredPlan(
            row.id,
            row.map_id,
            checked.text(row.source, f"recordings.source {where}", checked.MOST_JSON),
            checked.text(row.format, f"recordings.format {where}"),
            checked.integer(row.frame_count, f"recordings.frame_count {where}"),
            checked.text(row.fingerprint, f"recordings.fingerprint {where}", 64),
            tuple(checked.integer(index, f"ingest_items.frame_index {where}") for index in indexes),
        )

    return retry.read(engine, work)


def find_plan(engine: Engine, map_name: str, recording: str) -> StoredPlan | None:
    """The plan of a recording of a map by their names; None where there is none, or it is being deleted."""
    query = select(recordings.c.id).join(maps, maps.c.id == recordings.c.map_id)
    query = query.where(maps.c.name == map_name, recordings.c.name == recording)
    key = retry.read(engine, lambda c: c.execute(query).scalar())
    if key is None:
        return None
    try:
        return stored_plan(engine, key)
    except NotFoundError:
        return None


def _check_plan(plan: RecordingPlan, infos: Sequence[ModelInfo]) -> None:
    check_name("recording", plan.name)
    if not plan.fingerprint or len(plan.fingerprint) > 64:
        raise UsageError("the fingerprint of a recording has 1 to 64 characters")
    if len(set(plan.frame_indexes)) != len(plan.frame_indexes):
        raise UsageError(f"the plan of the recording {plan.name!r} names a frame twice")
    missing = [] if plan.poses is None else sorted(set(plan.frame_indexes) - set(plan.poses.poses))
    if missing:
        raise UsageError(f"the plan of the recording {plan.name!r} has no pose of frame {missing[0]}")
    if tuple(sorted(info.role for info in infos)) != ROLES:
        raise UsageError(f"a recording is described by one model of each role {ROLES}")


def _insert_plan(connection: Connection, map_id: int, plan: RecordingPlan) -> PlannedRecording:
    values = {
        "map_id": map_id,
        "name": plan.name,
        "format": plan.format,
        "source": plan.source,
        "fingerprint": plan.fingerprint,
        "frame_count": plan.frame_count,
        "state": RecordingState.PLANNED.value,
    }
    recording_id = new_id(connection, recordings, values)
    indexes = tuple(sorted(plan.frame_indexes))
    if indexes:
        item = {"recording_id": recording_id, "state": ItemState.PENDING.value, "attempts": 0}
        connection.execute(insert(ingest_items), [{**item, "frame_index": index} for index in indexes])
    insert_poses(connection, recording_id, map_id, plan.poses)
    return PlannedRecording(recording_id, map_id, indexes, (), ())


def _resume(connection: Connection, row: Row[Any], plan: RecordingPlan, map_name: str) -> PlannedRecording:
    advice = "run `semdb delete` for it first, or give the new one another name (--name)"
    name = f"the recording {plan.name!r} of the map {map_name!r}"
    if row.state == RecordingState.DELETING:
        raise UsageError(f"{name} is being deleted: let `semdb delete` finish")
    known = poses_of(connection, row.id).source
    if (known is PoseSource.ESTIMATED) != (plan.poses is not None):
        raise UsageError(f"{name} is stored already with {known} poses: ask for these (--poses {known}), or {advice}")
    # It may have grown: the same keyframes are still those that were planned.
    for what, old, new, same in (
        ("format", row.format, plan.format, row.format == plan.format),
        ("number of frames", row.frame_count, plan.frame_count, row.frame_count <= plan.frame_count),
    ):
        if not same:
            raise UsageError(f"{name} is stored already and is another one: its {what} is {old}, not {new}; {advice}")
    where = f"of recording {row.id}"
    query = select(ingest_items.c.frame_index, ingest_items.c.state).where(ingest_items.c.recording_id == row.id)
    if plan.extends and row.fingerprint == plan.extends:
        _extend(connection, row.id, plan, set(connection.execute(query).scalars()))
    elif row.fingerprint != plan.fingerprint:
        raise UsageError(
            f"{name} is stored already and is another one: which keyframes it has, its camera, or their times or poses "
            f"are others; {advice}"
        )
    states = {
        checked.integer(index, f"ingest_items.frame_index {where}"): state
        for index, state in connection.execute(query.order_by(ingest_items.c.frame_index))
    }
    if set(states) != set(plan.frame_indexes):
        only_old, only_new = (
            sorted(set(states) - set(plan.frame_indexes)),
            sorted(set(plan.frame_indexes) - set(states)),
        )
        raise UsageError(
            f"{name} is stored already with other keyframes: {len(states)} planned then, {len(plan.frame_indexes)} now "
            f"(only then: {_few(only_old)}; only now: {_few(only_new)}); {advice}"
        )
    return PlannedRecording(
        row.id,
        row.map_id,
        tuple(index for index, state in states.items() if state not in (ItemState.DONE, ItemState.DELETED)),
        tuple(index for index, state in states.items() if state == ItemState.DONE),
        tuple(index for index, state in states.items() if state == ItemState.FAILED),
    )


def _extend(connection: Connection, recording_id: int, plan: RecordingPlan, there: set[int]) -> None:
    """More keyframes for a plan that is as `plan` takes it to be; nothing where another process was faster."""
    values = {
        "fingerprint": plan.fingerprint,
        "frame_count": plan.frame_count,
        "state": RecordingState.INGESTING.value,
        "finished_at": None,
    }
    as_it_was = (recordings.c.id == recording_id, recordings.c.fingerprint == plan.extends)
    if connection.execute(update(recordings).where(*as_it_was).values(values)).rowcount != 1:
        return
    item = {"recording_id": recording_id, "state": ItemState.PENDING.value, "attempts": 0}
    added = sorted(set(plan.frame_indexes) - there)
    connection.execute(insert(ingest_items), [{**item, "frame_index": index} for index in added])
    if plan.poses is not None:
        new = set(added)
        insert_links(connection, recording_id, [one for one in plan.poses.links if {one.first, one.second} & new])


def _few(indexes: Sequence[int]) -> str:
    shown = ", ".join(str(index) for index in indexes[:5])
    return (shown + (", ..." if len(indexes) > 5 else "")) or "none"


def fail_item(engine: Engine, recording_id: int, frame_index: int, error: str) -> None:
    """Note that a keyframe could not be described or stored. A keyframe that is stored stays so."""
    statement = (
        update(ingest_items)
        .where(
            ingest_items.c.recording_id == recording_id,
            ingest_items.c.frame_index == frame_index,
            ingest_items.c.state.not_in([ItemState.DONE.value, ItemState.DELETED.value]),
        )
        .values(
            state=ItemState.FAILED.value,
            attempts=ingest_items.c.attempts + 1,
            error=for_terminal(error)[:4000],
            worker=None,
            lease_until=None,
        )
    )
    retry.write(engine, lambda c: c.execute(statement))


def failed_items(engine: Engine, recording_id: int | None = None) -> list[FailedItem]:
    """The keyframes that failed, of one recording or of all."""
    item = ingest_items.c
    query = select(item.recording_id, item.frame_index, item.attempts, item.error)
    query = query.where(item.state == ItemState.FAILED.value).order_by(item.recording_id, item.frame_index)
    if recording_id is not None:
        query = query.where(item.recording_id == recording_id)
    return [_failed(row) for row in retry.read(engine, lambda c: list(c.execute(query)))]


def _failed(row: Any) -> FailedItem:
    where = f"of frame {checked.shown(row.frame_index)} of recording {row.recording_id}"
    return FailedItem(
        row.recording_id,
        checked.integer(row.frame_index, f"ingest_items.frame_index {where}"),
        checked.integer(row.attempts, f"ingest_items.attempts {where}"),
        checked.text(row.error or "", f"ingest_items.error {where}", 65_535),
    )


def finish_recording(engine: Engine, recording_id: int) -> RecordingState:
    """Mark a recording complete when no keyframe of its plan is left to try. Returns its state.

    Keyframes that failed do not hinder: they are counted in the status. Raises NotFoundError.
    """

    def work(connection: Connection) -> RecordingState:
        state = connection.execute(select(recordings.c.state).where(recordings.c.id == recording_id)).scalar()
        if state is None:
            raise NotFoundError(f"there is no recording with the id {recording_id}")
        left = select(func.count()).where(
            ingest_items.c.recording_id == recording_id,
            ingest_items.c.state.in_([ItemState.PENDING.value, ItemState.RUNNING.value]),
        )
        open_ones = connection.execute(left).scalar()
        if not open_ones and state != RecordingState.DELETING:
            write_planned_links(connection, recording_id)
        if open_ones or state in (RecordingState.COMPLETE, RecordingState.DELETING):
            return checked.choice(state, f"recordings.state of recording {recording_id}", RecordingState)
        values = {"state": RecordingState.COMPLETE.value, "finished_at": func.current_timestamp()}
        connection.execute(update(recordings).where(recordings.c.id == recording_id).values(values))
        return RecordingState.COMPLETE

    return retry.write(engine, work)
