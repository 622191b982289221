"""Recordings that become part of a map: by path, or sent."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Mapping
from typing import Annotated, Any

from fastapi import Body, Form, Path, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response, StreamingResponse

from semdb.api import Database
from semdb.database.jobs import DONE, FAILED, PLANNED, Job
from semdb.database.records import RecordingStatus
from semdb.errors import NotFoundError, SemdbError, UsageError
from semdb.recordings.arrays import as_camera
from semdb.recordings.images import header_of
from semdb.service import job_schemas
from semdb.service.access import admit
from semdb.service.answers import as_json, encoded
from semdb.service.ingesting import path_below
from semdb.service.localize_routes import Depth, Image, check_pixels
from semdb.service.problems import Problem, busy, not_found
from semdb.service.roles import ADMIN, INGEST, Access
from semdb.service.routing import MapName, Table
from semdb.service.state import access_of, read, service_of
from semdb.service.streams import LONGEST_S
from semdb.service.uploads import live_frame, packed_of
from semdb.service.values import camera_dict
from semdb.storable_names import name_problem

table = Table("ingest")
MOST_JOBS = 1000
EVENT_S = 1.0
JobId = Annotated[int, Path(ge=1, le=2**63 - 1)]
UploadId = Annotated[str, Path(max_length=64)]


class NewIngest(BaseModel):
    """What to ingest, a `path` below the folders that are set or an `upload`, and how."""

    model_config = ConfigDict(extra="forbid")

    path: str | None = Field(None, max_length=4000, examples=["rgbd_dataset_freiburg1_desk"])
    upload: str | None = Field(None, max_length=64)
    name: str | None = Field(None, max_length=255)
    keyframes: int | None = Field(None, ge=1, le=1_000_000)
    stride: int | None = Field(None, ge=1, le=1_000_000)
    camera: str | None = Field(None, max_length=400)
    depth_scale: float | None = Field(None, gt=0, allow_inf_nan=False)
    poses: str | None = Field(None, pattern="^(auto|recorded|estimated)$")
    check: bool = True


@table.route("POST", "/v1/maps/{map}/ingest", INGEST, job_schemas.JobModel, status=202, errors=(404, 501))
async def ingest(request: Request, map: MapName, body: Annotated[NewIngest, Body()]) -> Response:
    """Plans a recording and leaves it to the workers, or ingests it here where the database is a file: a job.

    A map that is not there is made.
    """
    service, access = service_of(request), access_of(request)
    if (body.path is None) == (body.upload is None):
        raise Problem(422, "what is to be ingested is a path or an upload: give one of them")
    for what, name in (("map", map), ("recording", body.name)):
        if name is not None and (problem := name_problem(name)) is not None:
            raise Problem(422, f"the name of the {what} {problem}")
    if body.camera is not None:
        as_camera(body.camera)
    asked = body.model_dump(exclude={"path", "upload"}, exclude_none=True)
    if body.upload is not None:
        upload = service.uploads.find(body.upload, access.who, any_ones=access.has(ADMIN))
        asked["path"] = str(upload.path)
    else:
        asked["path"] = await service.reading.run(lambda: path_below(str(body.path), service.settings.roots))

    job = await read(request, lambda db: new_job(db, map, access.who, asked))
    service.wake_jobs()
    return as_json(job_dict(job, None, None), 202)


def new_job(db: Database, map: str, who: str, asked: Mapping[str, Any]) -> Job:
    """A new job. Raises Problem 429 where too many wait."""
    if db.open_jobs() >= MOST_JOBS:
        raise busy(f"{MOST_JOBS} jobs wait", 60)
    return db.job(db.add_job(map, who, asked))


@table.route("GET", "/v1/jobs/{job}", INGEST, job_schemas.JobModel)
async def get_job(request: Request, job: JobId) -> Response:
    """What became of a job, and how far it is."""
    return as_json(await _look(request, job))


@table.route("GET", "/v1/jobs/{job}/events", INGEST, only={"text/event-stream": {"schema": {"type": "string"}}})
async def follow_job(request: Request, job: JobId) -> Response:
    """A job as server-sent events: `progress` when something changed, `end` when it is done or failed."""
    service = service_of(request)
    first = await _look(request, job)
    who = access_of(request).who
    service.streams.check(who)

    async def events() -> AsyncIterator[bytes]:
        shown, ends = first, time.monotonic() + LONGEST_S
        said = b""
        try:
            with service.streams.one(who):
                while True:
                    over = shown["state"] in (DONE, FAILED)
                    text = encoded(shown)
                    if text != said or over:
                        said = text
                        yield b"event: " + (b"end" if over else b"progress") + b"\ndata: " + text + b"\n\n"
                    else:
                        yield b": still\n\n"
                    if over or service.stopping or time.monotonic() > ends:
                        return
                    await asyncio.sleep(EVENT_S)
                    await admit(request, INGEST)
                    shown = await _look(request, job)
        except (Problem, SemdbError):  # nothing can be said any more: whoever follows comes again, and is told
            return

    return StreamingResponse(events(), 200, {"X-Accel-Buffering": "no"}, "text/event-stream")


async def _look(request: Request, job_id: int) -> dict[str, Any]:
    service, access = service_of(request), access_of(request)

    def look(db: Database) -> dict[str, Any]:
        job = job_of(db, job_id, access)
        return job_dict(job, items_of(db, job), service.progress_of(job.id))

    return await read(request, look)


def job_of(db: Database, job_id: int, access: Access) -> Job:
    """A job that whoever asks may see. Raises Problem 404."""
    job = db.job(job_id)
    if not access.sees(job.map) or not (access.has(ADMIN) or job.who == access.who):
        raise not_found(f"job {job_id}")
    return job


def items_of(db: Database, job: Job, known: dict[str, list[RecordingStatus]] | None = None) -> dict[str, int] | None:
    """Keyframes of a job's recordings by their state. `known`: recordings of maps that need not be asked for again."""
    names = {str(one["recording"]) for one in job.result}
    if not names:
        return None
    counts: dict[str, int] = {}
    known = {} if known is None else known
    if job.map not in known:
        try:
            known[job.map] = db.recordings(job.map)
        except NotFoundError:
            known[job.map] = []
    found = [one for one in known[job.map] if one.name in names]
    for one in found:
        for state, count in one.items.items():
            counts[str(state)] = counts.get(str(state), 0) + count
    return counts


def job_dict(job: Job, items: dict[str, int] | None, now: tuple[str, int, int] | None) -> dict[str, Any]:
    """A job as it is answered with; where its recording lies is not told but by its own name."""
    state = job.state
    if state == PLANNED:
        left = sum((items or {}).get(one, 0) for one in ("pending", "running"))
        state = "working" if left else DONE
    return {
        "job": job.id,
        "address": f"/v1/jobs/{job.id}",
        "map": job.map,
        "name": str(job.request.get("name") or str(job.request.get("path", "")).rpartition("/")[2]),
        "state": state,
        "recordings": list(job.result),
        "items": items,
        "progress": None if now is None else dict(zip(("what", "done", "total"), now, strict=True)),
        "error": job.error,
        "attempts": job.attempts,
        "created_at": f"{job.created_at.isoformat()}Z",
        "finished_at": None if job.finished_at is None else f"{job.finished_at.isoformat()}Z",
    }


@table.route(
    "POST",
    "/v1/uploads",
    INGEST,
    job_schemas.UploadModel,
    status=201,
    errors=(507,),
    extra={
        "requestBody": {
            "required": True,
            "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def upload(
    request: Request,
    name: Annotated[str, Query(max_length=100, description="of the file, as room.bag", examples=["room.zip"])],
) -> Response:
    """Takes a recording: a bag or another file, or a zip of a folder. Its id is for `ingest`."""
    service, access = service_of(request), access_of(request)
    made = await service.reading.run(lambda: service.uploads.new(access.who, name))
    packed = packed_of(made)
    try:
        with packed.open("xb") as file:
            async for piece in request.stream():
                await asyncio.to_thread(file.write, piece)
        size = await service.writing.run(lambda: service.uploads.finish(made, packed))
    except BaseException as error:  # nothing is left of what did not come whole
        service.uploads.drop(made)
        if isinstance(error, OSError) and error.errno in (28, 122):
            raise Problem(507, "there is no room for it") from error
        raise
    return as_json({"upload": made.id, "name": name, "bytes": size}, 201)


@table.route("POST", "/v1/uploads/live", INGEST, job_schemas.UploadModel, status=201, errors=(507,))
async def live(request: Request, name: Annotated[str, Query(max_length=100, examples=["kitchen-3"])]) -> Response:
    """Opens an upload that takes frame by frame; `ingest` takes it when all are there."""
    service, access = service_of(request), access_of(request)
    made = await service.reading.run(lambda: service.uploads.new(access.who, name))
    return as_json({"upload": made.id, "name": name, "bytes": 0}, 201)


@table.route("POST", "/v1/uploads/{upload_id}/frames", INGEST, job_schemas.UploadModel, status=201, errors=(409, 507))
async def add_frame(
    request: Request,
    upload_id: UploadId,
    image: Image,
    timestamp_ns: Annotated[int, Form(ge=0, le=2**63 - 1)],
    camera: Annotated[str, Form(max_length=400, description="fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]")],
    depth_scale: Annotated[float, Form(gt=0, allow_inf_nan=False)],
    depth: Depth = None,
    pose: Annotated[
        str | None, Form(max_length=400, description="x,y,z,qw,qx,qy,qz of world_from_camera; without: estimated")
    ] = None,
) -> Response:
    """Adds a frame of a live session: colour, depth registered to it, and the pose where it is known."""
    service, access = service_of(request), access_of(request)
    found = service.uploads.find(upload_id, access.who, any_ones=access.has(ADMIN))
    service.uploads.check_room()
    files = {"rgb": await image.read()}
    if depth is not None:
        files["depth"] = await depth.read()
    for what, data in files.items():
        check_pixels(data, what, service.settings.max_pixels)
    header = header_of(files["rgb"], "image")
    if header.kind not in ("png", "jpeg"):
        raise Problem(422, "the image is expected as PNG or JPEG")
    taken = as_camera(camera, header.size)
    said = {
        "timestamp_ns": timestamp_ns,
        "ending": {"png": "png", "jpeg": "jpg"}[header.kind],
        "camera": camera_dict(taken) | {"depth_scale": depth_scale},
        "pose": None if pose is None else _pose(pose),
    }
    try:
        await service.writing.run(lambda: live_frame(found, files, said))
    except FileExistsError:
        raise Problem(409, f"there is a frame of the time {timestamp_ns} already") from None
    return as_json({"upload": found.id, "name": found.name, "bytes": sum(map(len, files.values()))}, 201)


def _pose(text: str) -> list[float]:
    """X y z qx qy qz qw, as TUM's files have it, of x,y,z,qw,qx,qy,qz. Raises UsageError."""
    try:
        x, y, z, qw, qx, qy, qz = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError("pose: seven numbers are needed, x,y,z,qw,qx,qy,qz") from None
    numbers = [x, y, z, qx, qy, qz, qw]
    if not all(map(math.isfinite, numbers)) or abs(math.hypot(qw, qx, qy, qz) - 1) > 1e-3:
        raise UsageError("pose: seven numbers are needed, x,y,z,qw,qx,qy,qz, and the quaternion is of length 1")
    return numbers
