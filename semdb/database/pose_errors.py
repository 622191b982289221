"""How far the poses of recordings are off their images: rows of `pose_errors`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from weakref import WeakKeyDictionary

from sqlalchemy import BigInteger, Connection, Engine, Select, cast, delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from semdb.database import checked, retry
from semdb.database.exact_sums import exact_sum
from semdb.database.reading import Bad
from semdb.database.refinements import MICRO, within
from semdb.database.tables import keyframes, pose_errors, recordings
from semdb.errors import CodecError
from semdb.types import PoseErrors

POSE_ERRORS = "errors"  # the step of `semdb refine`
NUMBERS = ("position_m", "position_freedom", "rotation_rad", "rotation_freedom")
NANO = 1_000_000_000
_measured: WeakKeyDictionary[Engine, Select[Any]] = WeakKeyDictionary()  # every query asks: making it takes longer


def replace_pose_errors(connection: Connection, map_id: int, found: Mapping[int, PoseErrors]) -> int:
    """Replaces the rows of a map's recordings; by recording. Returns how many there are now."""
    own = select(recordings.c.id).where(recordings.c.map_id == map_id)
    connection.execute(delete(pose_errors).where(pose_errors.c.recording_id.in_(own)))
    for recording_id, errors in sorted(found.items()):
        connection.execute(insert(pose_errors).values(recording_id=recording_id, **_values(errors)))
    return len(found)


def write_pose_errors(engine: Engine, recording_id: int, errors: PoseErrors) -> None:
    """Replaces the row of a recording, unless that was deleted meanwhile; of two at once the last one wins."""

    def work(connection: Connection) -> None:
        own = pose_errors.c.recording_id == recording_id
        if connection.execute(select(recordings.c.id).where(recordings.c.id == recording_id)).scalar() is None:
            return
        there = connection.execute(select(pose_errors.c.recording_id).where(own).with_for_update()).scalar()
        if there is not None:
            connection.execute(update(pose_errors).where(own).values(**_values(errors)))
        else:
            connection.execute(insert(pose_errors).values(recording_id=recording_id, **_values(errors)))

    try:
        retry.write(engine, work)
    except IntegrityError:
        retry.write(engine, work)  # another one made the row between the two statements


def _values(errors: PoseErrors) -> dict[str, Any]:
    numbers = {name: getattr(errors, name) for name in NUMBERS}
    return {**numbers, "keyframes": errors.keyframes, "measured_at": func.current_timestamp()}


def load_pose_errors(engine: Engine, map_id: int, bad: Bad | None = None) -> dict[int, PoseErrors]:
    """By recording, those of a map that were measured. Damaged rows are told to `bad`, or raise CodecError."""

    def work(connection: Connection) -> list[Any]:
        query = select(pose_errors).join(recordings).where(recordings.c.map_id == map_id)
        return list(connection.execute(query.order_by(pose_errors.c.recording_id)))

    found = {}
    for row in retry.read(engine, work):
        try:
            found[row.recording_id] = _errors_of(row)
        except CodecError as error:
            if bad is None:
                raise
            bad(row.recording_id, error)
    return found


def measured_states(connection: Connection) -> dict[int, str]:
    """What is measured of each map's recordings, in a line: equal lines, the same numbers of as many recordings.

    Maps of which nothing is measured are left out.
    """
    query = _measured.get(connection.engine)
    if query is None:
        query = _measured[connection.engine] = _measured_query(connection.engine)
    return {map_id: " ".join(map(str, line)) for map_id, *line in connection.execute(query)}


def _measured_query(engine: Engine) -> Select[Any]:
    e = pose_errors.c
    mixed = within(e.position_m) + 3 * within(e.rotation_rad)  # a thousandth of a micrometre shows
    sums = exact_sum(engine, cast(func.round(mixed * NANO), BigInteger))
    numbers = exact_sum(engine, cast(func.round(within(e.position_freedom) * MICRO), BigInteger))
    query = select(recordings.c.map_id, func.count(), *sums, *numbers)
    return query.select_from(pose_errors.join(recordings)).group_by(recordings.c.map_id)


def map_of(engine: Engine, recording_id: int) -> int | None:
    """The map of a recording; None where that is gone."""
    query = select(recordings.c.map_id).where(recordings.c.id == recording_id)
    return retry.read(engine, lambda connection: connection.execute(query).scalar())


def is_measured(engine: Engine, recording_id: int) -> bool:
    """Whether a recording has a row."""
    query = select(pose_errors.c.recording_id).where(pose_errors.c.recording_id == recording_id)
    return retry.read(engine, lambda connection: connection.execute(query).scalar() is not None)


def keyframes_of(engine: Engine, map_id: int, recording_id: int | None = None) -> dict[int, list[int]]:
    """The keyframes of each recording of a map, or of one, by recording's id, in the order of their frames."""

    def work(connection: Connection) -> dict[int, list[int]]:
        c = keyframes.c
        query = select(c.recording_id, c.id).join(recordings).where(recordings.c.map_id == map_id)
        if recording_id is not None:
            query = query.where(c.recording_id == recording_id)
        found: dict[int, list[int]] = {}
        for recording, keyframe_id in connection.execute(query.order_by(c.recording_id, c.frame_index)):
            found.setdefault(int(recording), []).append(int(keyframe_id))
        return found

    return retry.read(engine, work)


def _errors_of(row: Any) -> PoseErrors:
    where = f"of recording {row.recording_id}"
    numbers = {name: checked.real(getattr(row, name), f"pose_errors.{name} {where}", 0.0, 1e6) for name in NUMBERS}
    count = checked.integer(row.keyframes, f"pose_errors.keyframes {where}", 0, 2**31)
    return PoseErrors(**numbers, keyframes=count)
