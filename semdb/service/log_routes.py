"""The log of what was localized."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from fastapi import Path, Query, Request
from starlette.responses import Response

from semdb.database.query_log import QueryFilter
from semdb.service import schemas, values
from semdb.service.answers import as_json, page_of
from semdb.service.problems import not_found
from semdb.service.roles import ADMIN, READ
from semdb.service.routing import Limit, MapName, Table
from semdb.service.state import access_of, read, service_of
from semdb.types import Verdict

table = Table("queries")
Moment = Annotated[datetime | None, Query(description="a time, UTC where it does not say: 2026-05-01T12:00:00Z")]


@table.route("GET", "/v1/maps/{map}/queries", READ, schemas.Page[schemas.Query])
async def list_queries(
    request: Request,
    map: MapName,
    before: Annotated[int | None, Query(ge=1, le=2**63 - 1, description="key of an earlier page")] = None,
    verdict: Annotated[Verdict | None, Query(description="only of this verdict")] = None,
    text: Annotated[str | None, Query(max_length=255, description="part of the image's name, or of the reason")] = None,
    since: Moment = None,
    until: Moment = None,
    keyframe: Annotated[int | None, Query(ge=1, le=2**63 - 1, description="only what looked at this keyframe")] = None,
    limit: Limit = None,
) -> Response:
    """What was localized in a map, the newest first."""
    most, with_path = limit or service_of(request).settings.page, access_of(request).has(ADMIN)
    chosen = None if verdict is None else str(verdict)
    wanted = QueryFilter(chosen, text or None, _utc(since), _utc(until), keyframe, by_path=with_path)
    found = await read(request, lambda db: db.queries(map, before=before, limit=most + 1, wanted=wanted))
    shown = [(one.id, values.query_dict(one, with_path=with_path)) for one in found]
    return page_of(request, shown, most, lambda one: one[0], lambda one: one[1], by="before")


def _utc(moment: datetime | None) -> datetime | None:
    """As the database has times: UTC, and they do not say so."""
    if moment is None or moment.tzinfo is None:
        return moment
    try:
        return moment.astimezone(UTC).replace(tzinfo=None)
    except OverflowError:
        return moment.replace(tzinfo=None)


@table.route("GET", "/v1/queries/{query}", READ, schemas.Query)
async def get_query(request: Request, query: Annotated[int, Path(ge=1, le=2**63 - 1)]) -> Response:
    """One localization of the log, with its map. The image itself is not kept."""
    name, found = await read(request, lambda db: db.query(query))
    if not access_of(request).sees(name):
        raise not_found(f"query {query}")
    return as_json({"map": name} | values.query_dict(found, with_path=access_of(request).has(ADMIN)))
