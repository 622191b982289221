"""Images to poses."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, File, Form, Request, UploadFile
from starlette.responses import Response

from semdb.api import Answer, Database
from semdb.errors import FrameError
from semdb.recordings.images import header_of
from semdb.service import schemas
from semdb.service.answers import as_json
from semdb.service.instances import frame_with
from semdb.service.problems import Problem, problem_of, scrubbed
from semdb.service.roles import LOCALIZE, Access
from semdb.service.routing import MapName, Table
from semdb.service.state import Service, access_of, gone, service_of, with_notes
from semdb.service.values import answer_dict, matches_dict

table = Table("localization")
Name = Annotated[str | None, Form(max_length=255, description="what the image is called in answer and log")]
CameraText = Annotated[
    str | None, Form(max_length=400, description="fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]", examples=["525,525,319.5,239.5"])
]
Like = Annotated[str | None, Form(max_length=255, description="a recording whose camera and depth scale it has")]
DepthScale = Annotated[float | None, Form(description="units per metre of the depth image")]
Masks = Annotated[bool, Form(description="with the pixels of each object")]
Matches = Annotated[bool, Form(description="with the pixels that match the best keyframe's")]
AcceptM = Annotated[
    float | None, Form(gt=0, le=1000, description="with accept_deg: poses that differ by no more are one, metres")
]
AcceptDeg = Annotated[float | None, Form(gt=0, le=180, description="with accept_m, degrees")]
Log = Annotated[bool, Form(description="into the log of queries")]
Instances = Annotated[
    UploadFile | None, File(description="a PNG of labels: object masks of the image, for maps of the detector recorded")
]
Categories = Annotated[str | None, Form(max_length=65536, description='a class for each label: {"1": "chair"}')]
FrameIndex = Annotated[int | None, Form(ge=0, le=2**31 - 1, description="comes back in the answer")]
Timestamp = Annotated[int | None, Form(ge=-(2**63), le=2**63 - 1, description="comes back in the answer")]
Image = Annotated[UploadFile, File(description="a PNG or JPEG file")]
Depth = Annotated[UploadFile | None, File(description="a 16-bit PNG of the image's size, registered to it")]
_ERRORS = (404, 409)


@dataclass(frozen=True, slots=True)
class Query:
    """How images are asked."""

    map: str | None
    camera: str | None = None
    like: str | None = None
    depth_scale: float | None = None
    masks: bool = False
    log: bool = True
    categories: str | None = None
    frame_index: int | None = None
    timestamp_ns: int | None = None
    accept: tuple[float, float] | None = None
    matches: bool = False


@dataclass(frozen=True, slots=True)
class Given:
    """Files of one image."""

    image: bytes
    depth: bytes | None = None
    instances: bytes | None = None


async def query_of(
    request: Request,
    camera: CameraText = None,
    like: Like = None,
    depth_scale: DepthScale = None,
    masks: Masks = False,
    log: Log = True,
    categories: Categories = None,
    frame_index: FrameIndex = None,
    timestamp_ns: Timestamp = None,
    accept_m: AcceptM = None,
    accept_deg: AcceptDeg = None,
    matches: Matches = False,
) -> Query:
    """What the fields of a form ask for, in the map of the address, or those that the token is for."""
    asked = request.path_params.get("map", access_of(request).map)
    more = (categories or None, frame_index, timestamp_ns, _accept(accept_m, accept_deg), matches)
    return Query(asked, camera or None, like or None, depth_scale, masks, log, *more)


def _accept(metres: float | None, degrees: float | None) -> tuple[float, float] | None:
    if metres is None and degrees is None:
        return None
    if metres is None or degrees is None:
        raise Problem(422, "accept_m and accept_deg go together")
    return metres, degrees


async def files_of(image: Image, depth: Depth = None, instances: Instances = None) -> Given:
    """The files of a form."""
    return Given(await image.read(), await _bytes(depth), await _bytes(instances))


Asked = Annotated[Query, Depends(query_of)]
Files = Annotated[Given, Depends(files_of)]


@table.route("POST", "/v1/maps/{map}/localize", LOCALIZE, schemas.Answer, errors=_ERRORS)
async def localize_in_map(request: Request, map: MapName, query: Asked, given: Files, name: Name = None) -> Response:
    """Where an image was taken, in one map. Every verdict is an answer: `failed` is 200, too."""
    return timed(*await answered(request, query, given, name))


@table.route("POST", "/v1/localize", LOCALIZE, schemas.Answer, errors=_ERRORS)
async def localize(request: Request, query: Asked, given: Files, name: Name = None) -> Response:
    """Where an image was taken, in any map that the token is for."""
    return timed(*await answered(request, query, given, name))


@table.route("POST", "/v1/maps/{map}/localize/batch", LOCALIZE, schemas.Batch, errors=_ERRORS)
async def localize_batch(
    request: Request,
    map: MapName,
    image: Annotated[list[UploadFile], File(description="PNG or JPEG files")],
    depth: Annotated[list[UploadFile] | None, File(description="one for each image, or none at all")] = None,
    camera: CameraText = None,
    like: Like = None,
    depth_scale: DepthScale = None,
    name: Annotated[list[str] | None, Form(description="one for each image, or none at all")] = None,
    masks: Masks = False,
    log: Log = True,
) -> Response:
    """Where several images of one camera were taken. One that cannot be read has a problem, and the others go on."""
    most = service_of(request).settings.max_batch
    if len(image) > most:
        raise Problem(413, f"{len(image)} images are more than {most} of one request")
    for what, given in (("depth images", depth), ("names", name)):
        if given and len(given) != len(image):
            raise Problem(422, f"{len(given)} {what} for {len(image)} images: give one each, or none")
    query = Query(map, camera or None, like or None, depth_scale, masks, log)
    items: list[dict[str, Any]] = []
    for number, file in enumerate(image):
        called = name[number] if name else f"image {number}"
        try:
            own = await _bytes(depth[number]) if depth else None
            answer, _ = await answered(request, query, Given(await file.read(), own), called, watch=False)
            items.append({"answer": answer, "problem": None})
        except FrameError as error:
            told = problem_of(error).as_dict(request.state.request_id)
            items.append({"answer": None, "problem": told})
    return as_json({"items": items})


async def _bytes(file: UploadFile | None) -> bytes | None:
    return None if file is None else await file.read() or None


def timed(content: dict[str, Any], library_ms: float) -> Response:
    """An answer that says what of its time is the library's: all else is HTTP, and waiting for a turn."""
    return as_json(content, headers={"Server-Timing": f"library;dur={library_ms:.3f}"})


async def answered(
    request: Request, query: Query, given: Given, name: str | None, *, watch: bool = True
) -> tuple[dict[str, Any], float]:
    """The answer for one image, and the milliseconds that the library took. Raises Problem, SemdbError."""
    service, access = service_of(request), access_of(request)
    watching = (lambda: gone(request)) if watch else None
    return await service.localizing.run(work_of(service, access, query, given, name or "image"), watching)


def work_of(
    service: Service, access: Access, query: Query, given: Given, name: str
) -> Callable[[], tuple[dict[str, Any], float]]:
    """What a thread of the pool does for one image."""
    for what, data in (("image", given.image), ("depth image", given.depth), ("image of instances", given.instances)):
        if data is not None:
            check_pixels(data, f"the {what}", service.settings.max_pixels)
    if (given.instances is None) != (query.categories is None):
        raise Problem(422, "instances and categories go together")

    def ask() -> Answer:
        database = service.database
        if query.like is not None:
            check_like(database, access, query.map, query.like)
        if given.instances is not None and query.categories is not None:
            frame = frame_with(
                *(given.image, given.depth, given.instances, query.categories),
                camera=query.camera,
                depth_scale=query.depth_scale,
                name=name,
            )
            return database.localize(frame, map=query.map, name=name, accept=query.accept, log=query.log)
        return database.localize(
            given.image,
            map=query.map,
            depth=given.depth,
            camera=query.camera,
            depth_scale=query.depth_scale,
            like=query.like,
            name=name,
            accept=query.accept,
            log=query.log,
        )

    def work() -> tuple[dict[str, Any], float]:
        started = time.perf_counter()
        answer, notes = with_notes(ask)
        taken_ms = 1000 * (time.perf_counter() - started)
        service.answered(str(answer.verdict))
        own = {"frame_index": query.frame_index, "timestamp_ns": query.timestamp_ns}
        told = answer_dict(answer, masks=query.masks, notes=[scrubbed(line) for line in notes])
        return told | own | ({"matches": matches_dict(answer)} if query.matches else {}), taken_ms

    return work


def check_pixels(data: bytes, what: str, most: int) -> None:
    """Raises Problem 413 for an image that would be too large once it is decoded, FrameError for what is none."""
    header = header_of(data, what)
    if header.width * header.height > most:
        raise Problem(413, f"{what} has {header.width}x{header.height} pixels, more than {most}")


def check_like(database: Database, access: Access, map: str | None, like: str) -> None:
    """Raises Problem 422 unless `like` is a recording of the database: the library takes folders too."""
    if not database.has_recording(like, map if map is not None else access.map):
        raise Problem(422, f"like: there is no recording {like!r} in the map")
