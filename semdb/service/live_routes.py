"""Cameras that move in a map now, for those who watch."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from typing import Any

from fastapi import Request
from starlette.responses import Response, StreamingResponse

from semdb.errors import SemdbError
from semdb.service import session_schemas
from semdb.service.access import admit
from semdb.service.answers import as_json, encoded
from semdb.service.problems import Problem
from semdb.service.roles import READ
from semdb.service.routing import MapName, Table
from semdb.service.state import Service, access_of, read, service_of
from semdb.service.streams import LONGEST_S

table = Table("live")
EVENT_S = 0.25
STILL_S = 5.0  # without news a line is sent all the same: so long it takes to notice who went away
ADMIT_S = 5.0


@table.route("GET", "/v1/maps/{map}/live", READ, session_schemas.LiveCameras)
async def list_live(request: Request, map: MapName) -> Response:
    """The cameras that sessions of this process track in a map: their last poses, and where they came from."""
    await read(request, lambda db: db.map(map))
    return as_json(_cameras(service_of(request), map))


@table.route("GET", "/v1/maps/{map}/live/events", READ, only={"text/event-stream": {"schema": {"type": "string"}}})
async def follow_live(request: Request, map: MapName) -> Response:
    """The same as server-sent events: `cameras` whenever one of them moved, came or went."""
    service = service_of(request)
    await read(request, lambda db: db.map(map))
    service.streams.check(access_of(request).who)
    return StreamingResponse(_events(request, service, map), 200, {"X-Accel-Buffering": "no"}, "text/event-stream")


async def _events(request: Request, service: Service, map_name: str) -> AsyncIterator[bytes]:
    try:
        with service.streams.one(access_of(request).who):
            ends = time.monotonic() + LONGEST_S
            said: Any = None
            spoke = admitted = time.monotonic()
            while not service.stopping and time.monotonic() < ends:
                found = _cameras(service, map_name)
                news = [(one["camera"], one["frames"]) for one in found["cameras"]]
                now = time.monotonic()
                if news != said:
                    said, spoke = news, now
                    yield b"event: cameras\ndata: " + encoded(found) + b"\n\n"
                elif now - spoke > STILL_S:
                    spoke = now
                    yield b": still\n\n"
                await asyncio.sleep(EVENT_S)
                if now - admitted > ADMIT_S:
                    admitted = now
                    await admit(request, READ)  # a token may have been revoked since
    except (Problem, SemdbError):  # nothing can be said any more: whoever follows comes again, and is told
        return


def _cameras(service: Service, map_name: str) -> dict[str, Any]:
    return {"map": map_name, "cameras": service.sessions.watched(map_name)}
