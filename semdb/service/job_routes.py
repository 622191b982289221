"""What is being ingested: jobs, what failed of them, and what there is to ingest."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import Query, Request
from starlette.responses import Response

from semdb.api import Database
from semdb.database.jobs import DONE, FAILED, PLANNED, Job
from semdb.database.records import RecordingStatus
from semdb.errors import SemdbError
from semdb.recordings.roots import check_root
from semdb.service import job_schemas, schemas
from semdb.service.answers import as_json, page_of
from semdb.service.ingest_routes import JobId, items_of, job_dict, job_of, new_job
from semdb.service.problems import Problem, scrubbed
from semdb.service.roles import ADMIN, INGEST
from semdb.service.routing import Limit, MapName, Table
from semdb.service.state import access_of, read, service_of

table = Table("jobs")
MOST_ENTRIES = 500
MOST_FAILURES = 1000  # of a page that does not say how many


@table.route("GET", "/v1/jobs", INGEST, schemas.Page[job_schemas.JobModel])
async def list_jobs(
    request: Request,
    map: Annotated[str | None, Query(max_length=255, description="only of this map")] = None,
    before: Annotated[int | None, Query(ge=1, le=2**63 - 1, description="key of an earlier page")] = None,
    limit: Limit = None,
) -> Response:
    """The jobs of whoever asks, of all for role admin, the newest first."""
    service, access = service_of(request), access_of(request)
    most = limit or service.settings.page
    if map is not None and not access.sees(map):
        raise Problem(403, f"this token is not for the map {map!r}")
    who = None if access.has(ADMIN) else access.who

    def look(db: Database) -> list[dict[str, Any]]:
        wanted = map if map is not None else access.map
        found = db.jobs(wanted, who=who, before=before, limit=most + 1)
        known: dict[str, list[RecordingStatus]] = {}
        return [job_dict(job, items_of(db, job, known), service.progress_of(job.id)) for job in found]

    return page_of(request, await read(request, look), most, lambda one: one["job"], lambda one: one, by="before")


@table.route("POST", "/v1/jobs/{job}/retry", INGEST, job_schemas.JobModel, status=202, errors=(409,))
async def retry_job(request: Request, job: JobId) -> Response:
    """Does a job that ended once more, as a new job: keyframes that failed are tried again, none is stored twice."""
    service, access = service_of(request), access_of(request)

    def add(db: Database) -> Job:
        found = job_of(db, job, access)
        if found.state not in (DONE, FAILED, PLANNED):
            raise Problem(409, f"job {job} has not ended: it is {found.state}")
        path = str(found.request.get("path", ""))
        if not FilePath(path).exists():
            raise Problem(409, "what was to be ingested is not there any more: send it again")
        return new_job(db, found.map, access.who, found.request)

    made = await read(request, add)
    service.wake_jobs()
    return as_json(job_dict(made, None, None), 202)


@table.route("GET", "/v1/ingest/sources", INGEST, job_schemas.Sources)
async def list_sources(request: Request) -> Response:
    """What lies directly below the folders of which recordings may be ingested, by name; `path` is for `ingest`."""
    roots = service_of(request).settings.roots
    found = await read(request, lambda _: _entries(roots))
    return as_json({"paths": bool(roots), "entries": found[:MOST_ENTRIES], "truncated": len(found) > MOST_ENTRIES})


def _entries(roots: tuple[str, ...]) -> list[dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for root in roots:
        try:
            entries = sorted(FilePath(root).iterdir())
        except OSError:
            continue
        for entry in entries:
            if len(found) > MOST_ENTRIES:
                break
            if entry.name.startswith(".") or entry.name in found:
                continue
            try:
                check_root(str(entry), roots)
                folder = entry.is_dir()
                size = None if folder else entry.stat().st_size
            except (SemdbError, OSError, ValueError):
                continue
            found[entry.name] = {"path": entry.name, "kind": "folder" if folder else "file", "bytes": size}
    return sorted(found.values(), key=lambda one: one["path"])


@table.route("GET", "/v1/maps/{map}/recordings/{recording}/failures", INGEST, job_schemas.Failures)
async def list_failures(
    request: Request,
    map: MapName,
    recording: str,
    after: Annotated[int, Query(ge=-1, le=2**63 - 1, description="frame index: what comes after it")] = -1,
    limit: Limit = None,
) -> Response:
    """The keyframes of a recording that could not be stored, and why, by frame index."""
    found = await read(request, lambda db: db.failures(recording, map))
    later = [one for one in found if one.frame_index > after]
    most = limit or MOST_FAILURES
    return page_of(
        *(request, later[: most + 1], most),
        lambda one: one.frame_index,
        lambda one: {"frame_index": one.frame_index, "attempts": one.attempts, "error": scrubbed(one.error)},
        under="failures",
        also={"map": map, "recording": recording},
    )
