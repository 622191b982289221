"""Sessions: a camera that asks again and again, by plain HTTP or over one connection.

What a session is stands in its id, signed, so that any process of any service with the same secret answers it. Each
frame is localized by itself: the library has no way yet to be told where the camera was a moment ago.
"""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import asdict, fields
from typing import Annotated, Any

from fastapi import Body, FastAPI, Request, WebSocket
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect

from semdb.errors import SemdbError
from semdb.service import schemas
from semdb.service.access import admit
from semdb.service.answers import as_json, encoded
from semdb.service.localize_routes import Files, FrameIndex, Given, Name, Query, Timestamp, answered, work_of
from semdb.service.middleware import check_depth, tell
from semdb.service.problems import Problem, not_found, problem_of
from semdb.service.roles import LOCALIZE
from semdb.service.routing import MapName, Table
from semdb.service.signing import opened, signed
from semdb.service.state import access_of, service_of

table = Table("sessions")
KIND = "session"
STREAM = "/v1/sessions/{session}/stream"
PARTS = ("image", "depth", "instances")
_OF_A_FRAME = ("frame_index", "timestamp_ns")


class NewSession(BaseModel):
    """What all frames of a session have in common."""

    model_config = ConfigDict(extra="forbid")

    camera: str | None = Field(None, max_length=400, examples=["525,525,319.5,239.5"])
    like: str | None = Field(None, max_length=255)
    depth_scale: float | None = Field(None, allow_inf_nan=False)
    categories: dict[str, str] | None = Field(None, max_length=1000)
    masks: bool = False
    log: bool = True


@table.route("POST", "/v1/maps/{map}/sessions", LOCALIZE, schemas.Session, status=201, errors=(404,))
async def open_session(
    request: Request, map: MapName, body: Annotated[NewSession, Body(default_factory=NewSession)]
) -> Response:
    """Opens a session: what its frames have in common is said once."""
    service = service_of(request)
    await service.reading.run(lambda: service.database.map(map))
    texts = None if body.categories is None else json.dumps(body.categories)
    query = Query(map, body.camera, body.like, body.depth_scale, body.masks, body.log, texts)
    seconds = service.settings.session_hours * 3600
    name = signed(service.secret, KIND, {k: v for k, v in asdict(query).items() if k not in _OF_A_FRAME}, seconds)
    address = f"/v1/sessions/{name}"
    content = {
        "session": name,
        "map": map,
        "seconds": int(seconds),
        "frames": f"{address}/frames",
        "stream": f"{address}/stream",
        "tracking": False,
    }
    return as_json(content, 201)


@table.route("POST", "/v1/sessions/{session}/frames", LOCALIZE, schemas.Answer, errors=(404, 409))
async def localize_frame(
    request: Request,
    session: str,
    given: Files,
    name: Name = None,
    frame_index: FrameIndex = None,
    timestamp_ns: Timestamp = None,
) -> Response:
    """Where a frame of a session was taken."""
    query = _query(request, session, frame_index, timestamp_ns)
    return as_json(await answered(request, query, given, name))


def _query(
    connection: Request | WebSocket, session: str, frame_index: int | None = None, timestamp_ns: int | None = None
) -> Query:
    """What frames of a session ask. Raises Problem 404 for one that is none, 403 for one of a map of others."""
    found = opened(connection.app.state.service.secret, KIND, session)
    if found is None:
        raise not_found("session of that name: it ended, or another service made it (SEMDB_SERVE_SECRET)")
    known = {field.name for field in fields(Query)}
    query = Query(**{k: v for k, v in found.items() if k in known}, frame_index=frame_index, timestamp_ns=timestamp_ns)
    if query.map is not None and not connection.state.access.sees(query.map):
        raise Problem(403, f"this token is not for the map {query.map!r}")
    return query


async def stream(socket: WebSocket) -> None:
    """Frames over one connection: a text with what the next binary messages are, these, and an answer as text.

    A binary message without a text before it is an image. An image that cannot be used is answered with a problem, and
    the next one may come.
    """
    request_id = str(socket.scope["state"]["request_id"])
    service = socket.app.state.service
    try:
        await admit(socket, LOCALIZE)
        _query(socket, socket.path_params["session"])
    except (Problem, SemdbError) as error:
        problem = error if isinstance(error, Problem) else problem_of(error)
        await tell(socket.scope, socket._send, problem, request_id)
        return
    await socket.accept()
    service.sockets.add(socket)
    try:
        await _frames(socket, request_id)
    except (WebSocketDisconnect, asyncio.CancelledError):
        pass
    except TimeoutError:
        await socket.close(1001, "nothing came for too long")
    except Problem as problem:
        await socket.close(1008, problem.detail[:100])
    finally:
        service.sockets.discard(socket)


async def _frames(socket: WebSocket, request_id: str) -> None:
    service = socket.app.state.service
    idle = service.settings.session_idle_s
    sequence = 0
    while not service.stopping:
        said, files = await asyncio.wait_for(_message(socket), idle)
        started = time.perf_counter()
        try:
            await admit(socket, LOCALIZE)  # a token may have been revoked since
            query = _query(socket, socket.path_params["session"], said.get("frame_index"), said.get("timestamp_ns"))
            name = str(said.get("name") or "image")[:255]
            work = work_of(service, access_of(socket), query, Given(**files), name)
            answer: dict[str, Any] = await service.localizing.run(work)
        except (Problem, SemdbError) as error:
            problem = error if isinstance(error, Problem) else problem_of(error)
            if problem.status in (401, 403, 404):
                raise problem from error
            answer = problem.as_dict(request_id)
        sequence += 1
        answer |= {"sequence": sequence, "ms": round(1000 * (time.perf_counter() - started), 3)}
        await asyncio.wait_for(socket.send_text(encoded(answer).decode()), service.settings.body_timeout_s)


async def _message(socket: WebSocket) -> tuple[dict[str, Any], dict[str, bytes]]:
    """What was said of a frame, and its files. Raises Problem 422 for what is none."""
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
    return said, files


def _said(text: str) -> dict[str, Any]:
    if len(text) > 65_536:
        raise Problem(422, "the text is too long")
    check_depth(text.encode())
    try:
        said = json.loads(text)
    except ValueError:
        said = None
    parts = said.get("parts", ["image"]) if isinstance(said, dict) else None
    whole = isinstance(said, dict) and all(
        said.get(key) is None or (isinstance(said[key], int) and abs(said[key]) < 2**63) for key in _OF_A_FRAME
    )
    good = isinstance(parts, list) and "image" in parts and len(set(map(str, parts))) == len(parts)
    if not whole or not good or not set(parts or ()) <= set(PARTS) or not isinstance(said, dict):
        raise Problem(422, 'the text is expected as JSON: {"parts": ["image", "depth"], "timestamp_ns": 1}')
    return said


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
