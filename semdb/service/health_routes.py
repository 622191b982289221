"""Whether the service lives, whether it can answer, and what it did."""

from __future__ import annotations

import logging

from fastapi import Request
from starlette.responses import Response

import semdb
from semdb.api import Database
from semdb.errors import SemdbError
from semdb.events import event
from semdb.service import schemas
from semdb.service.answers import as_json
from semdb.service.problems import problem_of
from semdb.service.roles import PUBLIC, READ
from semdb.service.routing import Table
from semdb.service.state import read, service_of

table = Table("service")


@table.route("GET", "/health", PUBLIC, schemas.Health)
async def health(request: Request) -> Response:
    """The process answers; nothing is looked at."""
    return as_json({"status": "ok", "version": semdb.__version__})


@table.route("GET", "/ready", PUBLIC, schemas.Ready)
async def ready(request: Request) -> Response:
    """Whether the database answers with the right schema, and the models of its maps are there; 503 where not."""
    service = service_of(request)
    if service.stopping:
        return as_json({"ready": False, "checks": {"service": "stopping"}}, 503)

    def look(db: Database) -> tuple[bool, dict[str, str]]:
        try:
            db.access(None)
        except SemdbError as error:
            return False, {"database": problem_of(error).detail}
        good, there = prepare(db)
        return bool(good or not there), {"database": "ok", "maps": f"{good} of {there} can be asked"}

    good, checks = await read(request, look)
    return as_json({"ready": good, "checks": checks}, 200 if good else 503)


def prepare(db: Database) -> tuple[int, int]:
    """Loads what localizing in each map needs, where it is not loaded. Returns how many can be asked, of how many."""
    good, names = 0, [info.name for info in db.maps() if info.keyframes]
    for name in names:
        try:
            db.prepare(name)
            good += 1
        except SemdbError as error:
            event("not_asked", level=logging.WARNING, map=name, error=str(error))
    return good, len(names)


@table.route("GET", "/metrics", READ, only={"text/plain": {"schema": {"type": "string"}}})
async def metrics(request: Request) -> Response:
    """Counters for Prometheus. Only for tokens of all maps."""
    from semdb.service.sql_routes import for_all_maps

    for_all_maps(request)
    return Response(request.app.state.metrics.text(), 200, None, "text/plain; version=0.0.4; charset=utf-8")
