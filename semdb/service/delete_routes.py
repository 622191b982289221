"""Deleting, in two steps: the first says what would go, the second does it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Query, Request
from starlette.responses import Response

from semdb.api import Database
from semdb.database.records import Deleted
from semdb.service import schemas
from semdb.service.answers import as_json
from semdb.service.keyframe_routes import keyframe_of
from semdb.service.problems import Problem
from semdb.service.roles import ADMIN
from semdb.service.routing import KeyframeId, MapName, Table
from semdb.service.signing import LONGEST, opened, signed
from semdb.service.state import access_of, read, service_of

table = Table("deletion")
VALID_S = 300
KIND = "delete"
Confirm = Annotated[
    str | None, Query(max_length=LONGEST, description="what the same request without it answered: confirmation")
]
_ERRORS = (409, 428)


@table.route("DELETE", "/v1/maps/{map}", ADMIN, schemas.DeletedModel, errors=_ERRORS)
async def delete_map(request: Request, map: MapName, confirm: Confirm = None) -> Response:
    """Deletes a map with all its recordings, its log of queries and its tokens, for good."""
    info = await read(request, lambda db: db.map(map))
    what = {"map": info.id, "recordings": info.recordings, "keyframes": info.keyframes}
    return await _in_two_steps(request, what, confirm, lambda db: db.delete(map=map))


@table.route("DELETE", "/v1/maps/{map}/recordings/{recording}", ADMIN, schemas.DeletedModel, errors=_ERRORS)
async def delete_recording(request: Request, map: MapName, recording: str, confirm: Confirm = None) -> Response:
    """Deletes a recording of a map with its keyframes and its plan, for good."""
    found = await read(request, lambda db: db.recording(recording, map))
    what = {"recording": found.recording_id, "recordings": 1, "keyframes": found.keyframes}
    return await _in_two_steps(request, what, confirm, lambda db: db.delete(recording=recording, map=map))


@table.route("DELETE", "/v1/keyframes/{keyframe}", ADMIN, schemas.DeletedModel, errors=_ERRORS)
async def delete_keyframe(request: Request, keyframe: KeyframeId, confirm: Confirm = None) -> Response:
    """Deletes a keyframe for good; ingesting its recording again does not bring it back."""
    await keyframe_of(request, keyframe)
    what = {"keyframe": keyframe, "recordings": 0, "keyframes": 1}
    return await _in_two_steps(request, what, confirm, lambda db: db.delete(keyframes=[keyframe]))


async def _in_two_steps(
    request: Request, what: dict[str, Any], confirm: str | None, delete: Callable[[Database], Deleted]
) -> Response:
    service = service_of(request)
    what["by"] = access_of(request).who
    if confirm is None:
        numbers = {name: what[name] for name in ("recordings", "keyframes")}
        detail = f"this deletes {what['keyframes']} keyframes for good: send it again with confirm=CONFIRMATION"
        given = signed(service.secret, KIND, what, VALID_S)
        raise Problem(428, detail, more={"deletes": numbers, "confirmation": given, "seconds": VALID_S})
    if opened(service.secret, KIND, confirm) != what:
        raise Problem(
            409, "the confirmation is of something else, or its time is over, or there is more to delete by now"
        )
    done = await service.writing.run(lambda: delete(service.database))
    return as_json({"recordings": done.recordings, "keyframes": done.keyframes})
