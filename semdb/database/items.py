"""Who works on which keyframe of a plan: leases by the database's clock, with a fencing token.

An item that is worked on is `running`, with its worker's name and the time until which the worker may keep it. The
worker renews that while it lives; when it has died, anybody may take the item over. Each claim counts `attempts` up,
and the transaction that stores the keyframe, or calls it failed, must name the count of its own claim: a worker that
was thought dead and comes back writes nothing. A `pending` item may have a time too: until then a message that names
it is taken to be on its way.
"""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy import (
    BindParameter,
    ColumnElement,
    Connection,
    Engine,
    Select,
    Update,
    and_,
    bindparam,
    func,
    or_,
    select,
    update,
)

from semdb.database import checked, retry
from semdb.database.clock import now_plus
from semdb.database.records import ItemState, RecordingState
from semdb.database.tables import ingest_items, recordings
from semdb.shown import for_terminal
from semdb.types import FROM_MEMORY

LEASE_S = 60
MOST_ATTEMPTS = 10  # claims without an outcome after which a keyframe is taken to kill its workers
_item = ingest_items.c
_NOT_HELD = {"worker": None, "lease_until": None}
_Number = int | BindParameter[int]


@dataclass(frozen=True, slots=True)
class Claim:
    """The right to work on a keyframe; `token` is the number of this claim of it."""

    frame_index: int
    token: int


@dataclass(frozen=True, slots=True)
class QueuedItems:
    """Keyframes of one recording for which a message is due."""

    recording_id: int
    source: str
    frame_indexes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OpenItem:
    """A keyframe that is planned and not done. `held`: a worker has it whose lease has not run out."""

    frame_index: int
    attempts: int
    held: bool


def worker_name() -> str:
    """A name that no other worker has; it tells the machine and the process: ``HOST!SPACE!PID!START!RANDOM``.

    SPACE is of which start of which kernel, and of which of its tables of processes.
    """
    return "!".join((*_machine(), str(os.getpid()), _started(os.getpid()) or "0", secrets.token_hex(4)))


def worker_is_gone(name: str) -> bool:
    """Whether `name` is a worker of this machine whose process has ended. False where that cannot be known."""
    parts = name.split("!")
    here = _machine()
    if not here[1] or len(parts) != 5 or tuple(parts[:2]) != here or not parts[2].isdigit():
        return False
    return _started(int(parts[2])) != parts[3]


def claim(
    engine: Engine,
    recording_id: int,
    worker: str,
    *,
    limit: int,
    frames: Sequence[int] | None = None,
    lease_s: int = LEASE_S,
) -> list[Claim]:
    """Takes up to `limit` keyframes that nobody works on, of `frames` where given, by ascending index."""
    free, take, mine, worn_out = _claim_statements(lease_s, frames is not None)
    wanted = {"of_recording": recording_id} | ({} if frames is None else {"of_frames": list(frames)})

    def work(connection: Connection) -> list[Claim]:
        indexes = list(connection.execute(free, {**wanted, "most": limit}).scalars())
        if not indexes:
            connection.execute(worn_out, wanted)
            return []
        these = {"of_recording": recording_id, "of_frames": indexes, "of_worker": worker}
        connection.execute(take, these)
        return [_claim(recording_id, row) for row in connection.execute(mine, these)]

    return retry.write(engine, work)


def _claim(recording_id: int, row: Any) -> Claim:
    where = f"of frame {checked.shown(row.frame_index)} of recording {recording_id}"
    return Claim(
        checked.integer(row.frame_index, f"ingest_items.frame_index {where}"),
        checked.integer(row.attempts, f"ingest_items.attempts {where}"),
    )


@lru_cache(maxsize=16)
def _claim_statements(lease_s: int, some: bool) -> tuple[Select[Any], Update, Select[Any], Update]:
    """What finds free keyframes, takes them, reads what was taken, and gives up on the others; of `some` frames or all.

    Built once: a worker claims often, and building them takes longer than running them.
    """
    wanted = _item.recording_id == bindparam("of_recording")
    these = _item.frame_index.in_(bindparam("of_frames", expanding=True))
    expired = and_(_item.state == ItemState.RUNNING.value, _item.lease_until < now_plus())
    free = or_(_item.state == ItemState.PENDING.value, and_(expired, _item.attempts < MOST_ATTEMPTS))
    among = and_(wanted, these) if some else wanted
    taken = {"state": ItemState.RUNNING.value, "worker": bindparam("of_worker"), "lease_until": now_plus(lease_s)}
    held = and_(_item.worker == bindparam("of_worker"), _item.state == ItemState.RUNNING.value)
    return (
        select(_item.frame_index).where(among, free).order_by(_item.frame_index).limit(bindparam("most")),
        update(ingest_items).where(wanted, these, free).values(**taken, attempts=_item.attempts + 1),
        select(_item.frame_index, _item.attempts).where(wanted, these, held).order_by(_item.frame_index),
        _given_up(and_(among, expired, _item.attempts >= MOST_ATTEMPTS)),
    )


def _given_up(which: ColumnElement[bool]) -> Update:
    error = f"its worker died or was lost {MOST_ATTEMPTS} times while it was at this keyframe"
    return update(ingest_items).where(which).values(state=ItemState.FAILED.value, error=error, **_NOT_HELD)


def held_by(recording_id: _Number, frame_index: _Number, token: _Number) -> ColumnElement[bool]:
    """The condition that a claim still holds."""
    return and_(
        _item.recording_id == recording_id,
        _item.frame_index == frame_index,
        _item.state == ItemState.RUNNING.value,
        _item.attempts == token,
    )


def renew(engine: Engine, recording_id: int, worker: str, lease_s: int = LEASE_S) -> int:
    """Prolongs all that `worker` holds of a recording. Returns how many these are."""
    mine = and_(_item.recording_id == recording_id, _item.worker == worker, _item.state == ItemState.RUNNING.value)
    change = update(ingest_items).where(mine).values(lease_until=now_plus(lease_s))
    return retry.write(engine, lambda c: c.execute(change).rowcount)


def release(engine: Engine, recording_id: int, worker: str) -> int:
    """Gives back what `worker` holds and has not finished. Returns how many these were."""
    mine = and_(_item.recording_id == recording_id, _item.worker == worker, _item.state == ItemState.RUNNING.value)
    change = update(ingest_items).where(mine).values(state=ItemState.PENDING.value, **_NOT_HELD)
    return retry.write(engine, lambda c: c.execute(change).rowcount)


def release_dead(engine: Engine, recording_id: int | None = None) -> int:
    """Gives back what workers of this machine hold whose processes have ended, without waiting for their leases."""
    running = _item.state == ItemState.RUNNING.value
    if recording_id is not None:
        running = and_(running, _item.recording_id == recording_id)
    query = select(_item.worker).where(running, _item.worker.is_not(None)).distinct()
    names = retry.read(engine, lambda c: list(c.execute(query).scalars()))
    gone = [name for name in names if isinstance(name, str) and worker_is_gone(name)]
    if not gone:
        return 0

    def work(connection: Connection) -> int:
        theirs = and_(running, _item.worker.in_(gone))
        connection.execute(_given_up(and_(theirs, _item.attempts >= MOST_ATTEMPTS)))
        values = {"state": ItemState.PENDING.value, **_NOT_HELD}
        return connection.execute(update(ingest_items).where(theirs).values(**values)).rowcount

    return retry.write(engine, work)


def fail(engine: Engine, recording_id: int, claimed: Claim, error: str) -> bool:
    """Notes why a claimed keyframe cannot be described. False where the claim holds no longer: then nothing changes."""
    values = {"state": ItemState.FAILED.value, "error": for_terminal(error)[:4000], **_NOT_HELD}
    change = update(ingest_items).where(held_by(recording_id, claimed.frame_index, claimed.token)).values(**values)
    return retry.write(engine, lambda c: c.execute(change).rowcount == 1)


def give_up(engine: Engine, recording_id: int, frame_indexes: Sequence[int], error: str) -> int:
    """Calls those keyframes failed that are planned and that no worker has in hand. Returns how many these are."""
    expired = and_(_item.state == ItemState.RUNNING.value, _item.lease_until < now_plus())
    free = and_(
        _item.recording_id == recording_id,
        _item.frame_index.in_(list(frame_indexes)),
        or_(_item.state == ItemState.PENDING.value, expired),
    )
    values = {"state": ItemState.FAILED.value, "error": for_terminal(error)[:4000], **_NOT_HELD}
    return retry.write(engine, lambda c: c.execute(update(ingest_items).where(free).values(**values)).rowcount)


def left(engine: Engine, recording_id: int) -> tuple[int, int]:
    """How many keyframes of a plan are pending, and how many somebody works on."""
    query = select(_item.state, func.count()).where(_item.recording_id == recording_id).group_by(_item.state)
    counts: dict[str, int] = retry.read(engine, lambda c: {str(state): int(n) for state, n in c.execute(query)})
    return counts.get(ItemState.PENDING.value, 0), counts.get(ItemState.RUNNING.value, 0)


def open_items(engine: Engine, recording_id: int, frames: Sequence[int]) -> list[OpenItem]:
    """Those of `frames` that are neither stored, failed nor deleted, by index. Raises DatabaseError."""
    held = and_(_item.state == ItemState.RUNNING.value, _item.lease_until >= now_plus())
    query = (
        select(_item.frame_index, _item.attempts, held)
        .where(_item.recording_id == recording_id, _item.frame_index.in_(list(frames)))
        .where(_item.state.in_([ItemState.PENDING.value, ItemState.RUNNING.value]))
        .order_by(_item.frame_index)
    )
    rows = retry.read(engine, lambda c: list(c.execute(query)))
    claims = [_claim(recording_id, row) for row in rows]
    return [OpenItem(claim.frame_index, claim.token, bool(row[2])) for claim, row in zip(claims, rows, strict=True)]


def unsent(engine: Engine) -> int:
    """How many keyframes wait for which no message is known to be on its way: never sent, lost, or sent long ago."""
    query = select(func.count()).select_from(ingest_items.join(recordings, recordings.c.id == _item.recording_id))
    query = query.where(_item.state == ItemState.PENDING.value, _not_on_its_way(), _for_workers())
    return int(retry.read(engine, lambda c: c.execute(query).scalar()) or 0)


def _not_on_its_way() -> ColumnElement[bool]:
    """Of a pending item (see `mark_sent`)."""
    return or_(_item.lease_until.is_(None), _item.lease_until < now_plus())


def _for_workers() -> ColumnElement[bool]:
    """Of a recording that is not being deleted, and whose frames others can read."""
    return and_(recordings.c.state != RecordingState.DELETING.value, recordings.c.format != FROM_MEMORY)


def lost(engine: Engine, recording_id: int | None = None, *, all_pending: bool = False) -> list[QueuedItems]:
    """Keyframes that no living worker and no message is known to have, of one recording or of all.

    Running ones whose lease has run out become pending. Of the pending, those count that were never sent or long
    ago (see `mark_sent`), with `all_pending` all of them: for a broker that has lost its messages.
    """
    release_dead(engine, recording_id)
    mine = _item.recording_id == recording_id if recording_id is not None else _item.recording_id.is_not(None)
    expired = and_(mine, _item.state == ItemState.RUNNING.value, _item.lease_until < now_plus())
    due = and_(mine, _item.state == ItemState.PENDING.value)
    if not all_pending:
        due = and_(due, _not_on_its_way())

    def work(connection: Connection) -> list[QueuedItems]:
        connection.execute(_given_up(and_(expired, _item.attempts >= MOST_ATTEMPTS)))
        connection.execute(update(ingest_items).where(expired).values(state=ItemState.PENDING.value, **_NOT_HELD))
        query = select(recordings.c.id, recordings.c.source, _item.frame_index)
        query = query.join(recordings, recordings.c.id == _item.recording_id).where(due, _for_workers())
        found: dict[tuple[int, str], list[int]] = {}
        for row in connection.execute(query.order_by(recordings.c.id, _item.frame_index)):
            where = f"of recording {row.id}"
            source = checked.text(row.source, f"recordings.source {where}", checked.MOST_JSON)
            index = checked.integer(row.frame_index, f"ingest_items.frame_index {where}")
            found.setdefault((row.id, source), []).append(index)
        return [QueuedItems(key, source, tuple(indexes)) for (key, source), indexes in found.items()]

    return retry.write(engine, work)


def mark_sent(engine: Engine, recording_id: int, frame_indexes: Sequence[int], wait_s: int) -> None:
    """Notes that a message with these keyframes is on its way, so that for `wait_s` nobody sends another."""
    these = and_(
        _item.recording_id == recording_id,
        _item.frame_index.in_(list(frame_indexes)),
        _item.state == ItemState.PENDING.value,
    )
    change = update(ingest_items).where(these).values(lease_until=now_plus(wait_s))
    retry.write(engine, lambda c: c.execute(change))


def _machine() -> tuple[str, str]:
    """Name of this machine, and its table of processes ("" where that is not known).

    Containers on one machine have a table each; the first table of every machine has the same number, and machines may
    have the same name, so the random number of the kernel's start belongs to it.
    """
    try:
        space = os.readlink("/proc/self/ns/pid").strip("pid:[]")
        with open("/proc/sys/kernel/random/boot_id") as file:
            start = file.read().strip().replace("-", "")[:12]
    except OSError:
        start = space = ""
    return socket.gethostname().replace("!", "")[:64], f"{start}.{space}" if start and space else ""


def _started(pid: int) -> str | None:
    """When a process began, in the kernel's units; None where there is no such process, or no /proc to ask."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            fields = file.read().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else fields[19]
