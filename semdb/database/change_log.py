"""Reading the log of changes: how a mirror of a map learns what changed."""

from __future__ import annotations

from sqlalchemy import Engine, func, select

from semdb.database import checked, retry
from semdb.database.exact_sums import exact_sum, whole
from semdb.database.records import Change, ChangeKind, ChangeMark
from semdb.database.tables import keyframe_changes


def changes_since(engine: Engine, map_id: int, change_id: int) -> list[Change]:
    """Changes of a map with an id above `change_id`, ascending.

    Ids commit out of order: a reader that keeps a mirror asks again from some way back and applies changes twice.
    """
    c = keyframe_changes.c
    query = select(c.id, c.keyframe_id, c.kind).where(c.map_id == map_id, c.id > change_id).order_by(c.id)
    rows = retry.read(engine, lambda connection: list(connection.execute(query)))
    return [
        Change(
            row.id,
            checked.integer(row.keyframe_id, f"keyframe_changes.keyframe_id of change {row.id}", -(2**63), 2**63 - 1),
            checked.choice(row.kind, f"keyframe_changes.kind of change {row.id}", ChangeKind),
        )
        for row in rows
    ]


def change_ids_since(engine: Engine, map_id: int, change_id: int) -> list[int]:
    """Ids of the changes of a map above `change_id`, ascending."""
    c = keyframe_changes.c
    query = select(c.id).where(c.map_id == map_id, c.id > change_id).order_by(c.id)
    return retry.read(engine, lambda connection: list(connection.execute(query).scalars()))


def change_mark(engine: Engine, map_id: int, change_id: int) -> ChangeMark:
    """The changes of a map above `change_id` in three numbers: cheap to ask for, different when there is a new one.

    It reads the index alone, as many entries as there are changes.
    """
    c = keyframe_changes.c
    query = select(func.coalesce(func.max(c.id), 0), func.count(), *exact_sum(engine, c.id))
    query = query.where(c.map_id == map_id, c.id > change_id)
    newest, rows, *total = retry.read(engine, lambda connection: connection.execute(query).one())
    return ChangeMark(int(newest), int(rows), whole(total))


def change_text(engine: Engine, map_id: int, change_id: int) -> str | None:
    """All that the log says in one row, to tell whether it is still the same log; None where there is no such row."""
    c = keyframe_changes.c
    query = select(c.keyframe_id, c.kind, c.changed_at).where(c.map_id == map_id, c.id == change_id)
    row = retry.read(engine, lambda connection: connection.execute(query).one_or_none())
    return None if row is None else f"{row.keyframe_id} {row.kind} {row.changed_at}"
