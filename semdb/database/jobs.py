"""What services were asked to ingest: kept until it is done, by one process at a time, with a lease.

A process that dies leaves its job to the next one whose turn it is: planning and ingesting again adds nothing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Engine, and_, delete, func, insert, or_, select, update

from semdb.database import checked, retry
from semdb.database.clock import now_plus
from semdb.database.tables import service_jobs
from semdb.errors import CodecError, LeaseLostError, NotFoundError

WAITING, RUNNING, PLANNED, DONE, FAILED = "waiting", "running", "planned", "done", "failed"
LEASE_S = 60
MOST_ATTEMPTS = 5
_j = service_jobs.c


@dataclass(frozen=True, slots=True)
class Job:
    """What was asked, and what became of it. Times are UTC; `attempts` is also the number of its claim."""

    id: int
    map: str
    who: str
    state: str
    request: Mapping[str, Any]
    result: tuple[Mapping[str, Any], ...]
    error: str | None
    attempts: int
    created_at: datetime
    finished_at: datetime | None


def add_job(engine: Engine, map_name: str, who: str, request: Mapping[str, Any]) -> int:
    """The id of a new job."""
    values = {
        "map": map_name,
        "who": who,
        "state": WAITING,
        "request": json.dumps(request),
        "result": "[]",
        "attempts": 0,
        "created_at": now_plus(0),
    }
    adding = insert(service_jobs).values(values)  # the database's clock is no parameter
    key: Any = retry.write(engine, lambda connection: connection.execute(adding).inserted_primary_key)
    return int(key[0])


def find_job(engine: Engine, job_id: int) -> Job:
    """Raises NotFoundError, CodecError for a damaged row."""
    query = select(service_jobs).where(_j.id == int(job_id))
    row = retry.read(engine, lambda connection: connection.execute(query).one_or_none())
    if row is None:
        raise NotFoundError(f"there is no job {job_id}")
    return _job(row)


def list_jobs(
    engine: Engine, map_name: str | None = None, *, who: str | None = None, before: int | None = None, limit: int = 100
) -> list[Job]:
    """The newest jobs, of a map, of whoever asked for them. Raises CodecError for a damaged row."""
    query = select(service_jobs).order_by(_j.id.desc()).limit(int(limit))
    if map_name is not None:
        query = query.where(_j.map == map_name)
    if who is not None:
        query = query.where(_j.who == who)
    if before is not None:
        query = query.where(_j.id < int(before))
    return [_job(row) for row in retry.read(engine, lambda connection: list(connection.execute(query)))]


def claim_job(engine: Engine) -> Job | None:
    """The oldest job that nobody works on, for `LEASE_S`; None where there is none."""
    free = or_(_j.state == WAITING, and_(_j.state == RUNNING, _j.lease_until < now_plus(0)))
    oldest = select(_j.id, _j.attempts).where(free).order_by(_j.id).limit(1)

    def work(connection: Any) -> int | None:
        row = connection.execute(oldest).one_or_none()
        if row is None:
            return None
        mine = update(service_jobs).where(_j.id == row.id, _j.attempts == row.attempts, free)
        given = mine.values(state=RUNNING, attempts=row.attempts + 1, lease_until=now_plus(LEASE_S))
        return int(row.id) if connection.execute(given).rowcount == 1 else None

    found = retry.write(engine, work)
    return None if found is None else find_job(engine, found)


def keep_job(engine: Engine, job: Job) -> None:
    """Renews the lease. Raises LeaseLostError where another process has the job by now."""
    statement = _held(job).values(lease_until=now_plus(LEASE_S))
    if retry.write(engine, lambda connection: connection.execute(statement).rowcount) != 1:
        found = find_job(engine, job.id)  # MySQL counts rows that changed, and the time may be the same
        if found.state != RUNNING or found.attempts != job.attempts:
            raise LeaseLostError(f"another process has the job {job.id}")


def end_job(
    engine: Engine, job: Job, state: str, result: list[dict[str, Any]] | None = None, error: str | None = None
) -> None:
    """Says what became of a job, where it is still held: `WAITING` gives it back."""
    ended = None if state == WAITING else now_plus(0)
    values = {"state": state, "error": error, "finished_at": ended, "lease_until": None}
    statement = _held(job).values(**values, result=json.dumps(result or []))
    retry.write(engine, lambda connection: connection.execute(statement))


def forget_jobs(engine: Engine, older_than_s: int) -> int:
    """Deletes jobs that ended longer ago. Returns how many."""
    old = delete(service_jobs).where(_j.finished_at < now_plus(-int(older_than_s)))
    return int(retry.write(engine, lambda connection: connection.execute(old).rowcount))


def open_jobs(engine: Engine) -> int:
    """How many wait or run."""
    query = select(func.count()).select_from(service_jobs).where(_j.state.in_([WAITING, RUNNING]))
    return int(retry.read(engine, lambda connection: connection.execute(query).scalar_one()))


def _held(job: Job) -> Any:
    return update(service_jobs).where(_j.id == job.id, _j.state == RUNNING, _j.attempts == job.attempts)


def _job(row: Any) -> Job:
    where = f"of job {row.id}"
    try:
        request, result = dict(json.loads(row.request)), tuple(dict(one) for one in json.loads(row.result))
    except (TypeError, ValueError):
        raise CodecError(f"service_jobs.request or result {where} are not the JSON that was written") from None
    return Job(
        id=int(row.id),
        map=checked.text(row.map, f"service_jobs.map {where}"),
        who=checked.text(row.who, f"service_jobs.who {where}"),
        state=checked.text(row.state, f"service_jobs.state {where}"),
        request=request,
        result=result,
        error=row.error,
        attempts=checked.integer(row.attempts, f"service_jobs.attempts {where}"),
        created_at=row.created_at,
        finished_at=row.finished_at,
    )
