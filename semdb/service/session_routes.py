"""Sessions: a camera that is tracked frame after frame, by plain HTTP or over one connection.

What the frames have in common stands in the id of the session, signed, so that any process of any service with the same
secret can go on with it. Where the camera was a moment ago only the process knows that had the frames before; one that
has not looks for the camera in the whole map, and says so.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import Body, FastAPI, Form, Request, WebSocket
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect

from semdb.errors import SemdbError
from semdb.service import session_schemas
from semdb.service.access import admit
from semdb.service.answers import as_json, encoded
from semdb.service.localize_routes import (
    CameraText,
    Categories,
    DepthScale,
    Files,
    FrameIndex,
    Name,
    Timestamp,
    check_pixels,
)
from semdb.service.middleware import check_depth, close_reason, tell
from semdb.service.problems import Problem, busy, not_found, problem_of
from semdb.service.roles import LOCALIZE, ON_LOOPBACK
from semdb.service.routing import MapName, Table
from semdb.service.settings import MIB
from semdb.service.signing import LONGEST, opened, signed
from semdb.service.state import Service, access_of, gone, service_of
from semdb.service.tracked import Common, FrameGiven, numbers_of, open_tracker, pose_of, track

table = Table("sessions")
KIND = "session"
STREAM = "/v1/sessions/{session}/stream"
PARTS = ("image", "depth", "instances")
LATEST_S = 1e12
_WHOLE = ("frame_index", "timestamp_ns")
_REAL = ("time_s", "depth_scale")
TimeS = Annotated[
    float | None,
    Form(ge=-LATEST_S, le=LATEST_S, allow_inf_nan=False, description="seconds of a clock that only goes forwards"),
]
Odometry = Annotated[
    str | None,
    Form(max_length=1000, description="odom_from_camera: x,y,z,qw,qx,qy,qz, or a matrix of 16 numbers row by row"),
]


class NewSession(BaseModel):
    """What all frames of a session have in common."""

    model_config = ConfigDict(extra="forbid")

    camera: str | None = Field(None, max_length=400, examples=["525,525,319.5,239.5"])
    like: str | None = Field(None, max_length=255)
    depth_scale: float | None = Field(None, allow_inf_nan=False)
    categories: dict[str, str] | None = Field(None, max_length=1000)


@table.route("POST", "/v1/maps/{map}/sessions", LOCALIZE, session_schemas.Session, status=201, errors=(404, 409))
async def open_session(
    request: Request, map: MapName, body: Annotated[NewSession, Body(default_factory=NewSession)]
) -> Response:
    """Begins to track a camera in a map: what its frames have in common is said once."""
    service = service_of(request)
    texts = None if body.categories is None else json.dumps(body.categories)
    who = access_of(request).who
    common = Common(secrets.token_hex(8), who, map, body.camera, body.like, body.depth_scale, texts)
    seconds = service.settings.session_hours * 3600
    name = signed(service.secret, KIND, asdict(common), seconds)
    if len(name) > LONGEST:
        raise Problem(422, "what the frames have in common is too long for an address: give categories with each frame")
    async with service.sessions.use(common.id, common.who) as live:
        await service.localizing.run(lambda: open_tracker(service.database, live, common), lambda: gone(request))
        live.opened = True
    address = f"/v1/sessions/{name}"
    content = {
        "session": name,
        "map": map,
        "seconds": int(seconds),
        "idle_seconds": service.settings.session_idle_s,
        "frames": f"{address}/frames",
        "stream": f"{address}/stream",
        "tracking": True,
    }
    return as_json(content, 201)


@table.route("POST", "/v1/sessions/{session}/frames", LOCALIZE, session_schemas.Tracked, errors=(404, 409))
async def track_frame(
    request: Request,
    session: str,
    given: Files,
    name: Name = None,
    time_s: TimeS = None,
    frame_index: FrameIndex = None,
    timestamp_ns: Timestamp = None,
    camera: CameraText = None,
    depth_scale: DepthScale = None,
    categories: Categories = None,
    odometry: Odometry = None,
) -> Response:
    """Where the camera of a session is now. A frame that is sent once more gets its answer once more."""
    common = _common(request, session)
    frame = FrameGiven(
        image=given.image,
        depth=given.depth,
        instances=given.instances,
        categories=categories or None,
        camera=camera or None,
        depth_scale=depth_scale,
        name=name,
        time_s=time_s,
        frame_index=frame_index,
        timestamp_ns=timestamp_ns,
        odometry=None if not odometry else pose_of(numbers_of(odometry)),
    )
    service = service_of(request)
    _check(service, frame)
    async with service.sessions.use(common.id, common.who) as live:
        answer = await service.localizing.run(
            lambda: track(service.database, live, common, frame), lambda: gone(request)
        )
    service.metrics.tracked(answer["state"])
    return as_json(answer)


@table.route("DELETE", "/v1/sessions/{session}", LOCALIZE, session_schemas.Ended)
async def end_session(request: Request, session: str) -> Response:
    """Lets a camera go, so that there is a place for another one; one that sends nothing is let go by itself."""
    service_of(request).sessions.end(_common(request, session).id)
    return as_json({"ended": True})


def _common(connection: Request | WebSocket, session: str) -> Common:
    """What frames of a session have in common. Raises Problem 404 for one that is none or of somebody else, 403."""
    found = opened(connection.app.state.service.secret, KIND, session)
    access = connection.state.access
    if found is None or found["who"] != access.who:
        raise not_found("session of that name: it ended, or another service made it (SEMDB_SERVE_SECRET)")
    common = Common(**found)
    if not access.sees(common.map):
        raise Problem(403, f"this token is not for the map {common.map!r}")
    return common


def _check(service: Service, frame: FrameGiven) -> None:
    """Raises Problem 413 for an image that would be too large once it is decoded, FrameError for what is none."""
    parts = (("image", frame.image), ("depth image", frame.depth), ("image of instances", frame.instances))
    for what, data in parts:
        if data is not None:
            check_pixels(data, f"the {what}", service.settings.max_pixels)


async def stream(socket: WebSocket) -> None:
    """Frames over one connection: a text with what the next binary messages are, these, and an answer as text.

    A binary message without a text before it is an image. An image that cannot be used is answered with a problem, and
    the next one may come.
    """
    request_id = str(socket.scope["state"]["request_id"])
    service: Service = socket.app.state.service
    try:
        access = await admit(socket, LOCALIZE)
        _common(socket, socket.path_params["session"])
        check_places(service, access.who)
    except (Problem, SemdbError) as error:
        problem = error if isinstance(error, Problem) else problem_of(error)
        await tell(socket.scope, socket._send, problem, request_id)
        return
    service.sockets[socket] = access.who
    try:
        await socket.accept()
        await _frames(socket, request_id)
    except (WebSocketDisconnect, asyncio.CancelledError):
        pass
    except TimeoutError:
        await socket.close(1001, "nothing came for too long")
    except Problem as problem:
        await socket.close(1008, close_reason(problem))
    finally:
        del service.sockets[socket]


def check_places(service: Service, who: str) -> None:
    """Raises Problem 429 where there is no place for one more connection, or for one more of this token."""
    settings = service.settings
    of_token = sum(one == who for one in service.sockets.values())
    each = settings.sessions if who == ON_LOOPBACK.who else settings.sessions_per_token
    if len(service.sockets) >= settings.sessions or of_token >= each:
        raise busy("all places for connections are taken", settings.session_idle_s / 4)


async def _frames(socket: WebSocket, request_id: str) -> None:
    service: Service = socket.app.state.service
    idle = service.settings.session_idle_s
    sequence = 0
    while not service.stopping:
        said, files = await asyncio.wait_for(_message(socket), idle)
        started = time.perf_counter()
        try:
            await admit(socket, LOCALIZE)  # a token may have been revoked since
            answer = await _answered(service, _common(socket, socket.path_params["session"]), said, files)
        except (Problem, SemdbError) as error:
            problem = error if isinstance(error, Problem) else problem_of(error)
            if problem.status in (401, 403, 404):
                raise problem from error
            answer = problem.as_dict(request_id)
        sequence += 1
        answer |= {"sequence": sequence, "ms": round(1000 * (time.perf_counter() - started), 3)}
        await asyncio.wait_for(socket.send_text(encoded(answer).decode()), service.settings.body_timeout_s)


async def _answered(service: Service, common: Common, said: dict[str, Any], files: dict[str, bytes]) -> dict[str, Any]:
    odometry = said.get("odometry")
    categories = said.get("categories")
    frame = FrameGiven(
        image=files["image"],
        depth=files.get("depth"),
        instances=files.get("instances"),
        categories=None if categories is None else json.dumps(categories),
        camera=said.get("camera"),
        depth_scale=said.get("depth_scale"),
        name=None if said.get("name") is None else str(said["name"])[:255],
        time_s=said.get("time_s"),
        frame_index=said.get("frame_index"),
        timestamp_ns=said.get("timestamp_ns"),
        odometry=None if odometry is None else pose_of([float(number) for number in odometry]),
    )
    _check(service, frame)
    async with service.sessions.use(common.id, common.who) as live:
        answer = await service.localizing.run(lambda: track(service.database, live, common, frame))
    service.metrics.tracked(answer["state"])
    return dict(answer)


async def _message(socket: WebSocket) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What was said of a frame, and its files. Raises Problem 422 for what is none, 413 for what is too large."""
    service: Service = socket.app.state.service
    most = int(service.settings.max_upload_mb * MIB)
    said: dict[str, Any] = {}
    parts: list[str] = ["image"]
    message = await _received(socket)
    if isinstance(message, str):
        said = _said(message)
        parts = said.get("parts", parts)
        message = await _received(socket)
    files: dict[str, bytes] = {}
    for number, part in enumerate(parts):
        data = message if number == 0 else await _received(socket)
        if isinstance(data, str):
            raise Problem(422, f"the {part} is expected as a binary message")
        files[part] = data
        if sum(map(len, files.values())) > most:
            raise Problem(413, f"the files of a frame are larger than {service.settings.max_upload_mb:g} MiB")
    return said, files


def _said(text: str) -> dict[str, Any]:
    if len(text) > 65_536:
        raise Problem(422, "the text is too long")
    check_depth(text.encode())
    try:
        said = json.loads(text)
    except ValueError:
        said = None
    if not isinstance(said, dict) or not _good(said):
        raise Problem(422, 'the text is expected as JSON: {"parts": ["image", "depth"], "timestamp_ns": 1}')
    return said


def _good(said: dict[str, Any]) -> bool:
    """Whether all that is said of a frame is of its kind."""

    def number(value: object, whole: bool = False) -> bool:
        kinds = int if whole else int | float
        return isinstance(value, kinds) and not isinstance(value, bool) and abs(value) < (2**63 if whole else LATEST_S)

    parts = said.get("parts", ["image"])
    texts = said.get("categories")
    odometry = said.get("odometry")
    return (
        isinstance(parts, list)
        and "image" in parts
        and all(isinstance(part, str) and part in PARTS for part in parts)
        and len(set(parts)) == len(parts)
        and all(said.get(name) is None or number(said[name], whole=True) for name in _WHOLE)
        and all(said.get(name) is None or number(said[name]) for name in _REAL)
        and (said.get("camera") is None or (isinstance(said["camera"], str) and len(said["camera"]) <= 400))
        and (texts is None or (isinstance(texts, dict) and all(isinstance(text, str) for text in texts.values())))
        and (odometry is None or (isinstance(odometry, list) and all(map(number, odometry))))
    )


async def _received(socket: WebSocket) -> str | bytes:
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))
    data = message.get("bytes")
    return data if data is not None else str(message.get("text") or "")


def add_stream(app: FastAPI) -> None:
    """Adds the route of the connection."""
    stream.role = LOCALIZE  # type: ignore[attr-defined]
    app.router.add_websocket_route(STREAM, stream)
