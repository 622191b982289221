"""The application: routes, errors and what all requests pass."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp

import semdb
from semdb.errors import SemdbError
from semdb.events import event
from semdb.service import (
    delete_routes,
    explorer,
    health_routes,
    ingest_routes,
    job_routes,
    keyframe_routes,
    live_routes,
    localize_routes,
    log_routes,
    map_routes,
    scene_routes,
    schemas,
    session_routes,
    sql_routes,
)
from semdb.service.access import GuardedRoute
from semdb.service.middleware import Doorkeeper, Outermost, Patience
from semdb.service.problems import MEDIA_TYPE, Problem, problem_of
from semdb.service.state import Service

TABLES = (
    health_routes.table,
    map_routes.table,
    keyframe_routes.table,
    scene_routes.table,
    localize_routes.table,
    session_routes.table,
    sql_routes.table,
    delete_routes.table,
    ingest_routes.table,
    log_routes.table,
    job_routes.table,
    live_routes.table,
)
ABOUT = """Maps, recordings, keyframes and things of a visual semantic database, and where images were taken.

Lengths are metres, poses `world_from_camera` with camera axes x right, y down, z forward; boxes are pixels. Errors are
problem JSON (RFC 9457). Lists have pages: `next` is the address of the following one."""


def make_app(service: Service) -> ASGIApp:
    """The application for one process."""
    return wrapped(make_api(service), service)


def make_api(service: Service) -> FastAPI:
    """The routes, with errors and OpenAPI, but without what all requests pass."""

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        service.start_jobs()
        _hear_of_the_end(service)
        forgetting = asyncio.create_task(_forget(service))
        yield
        forgetting.cancel()
        service.close()

    app = FastAPI(
        title="semdb",
        version=semdb.__version__,
        description=ABOUT,
        openapi_url="/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=life,
        redirect_slashes=False,
    )
    app.router.route_class = GuardedRoute
    app.state.service = service
    app.state.metrics = service.metrics
    for table in TABLES:
        table.add_to(app)
    session_routes.add_stream(app)
    explorer.add_page(app)
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(SemdbError, _on_error)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_invalid)
    app.add_exception_handler(Exception, _on_anything)
    _document(app)
    return app


async def _forget(service: Service) -> None:
    """Lets cameras go of which nothing comes any more."""
    while True:
        await asyncio.sleep(min(5.0, service.settings.session_idle_s))
        service.sessions.forget()


def _hear_of_the_end(service: Service) -> None:
    """Streams that never end by themselves end when the web server is told to stop, which waits for them."""
    if threading.current_thread() is not threading.main_thread():
        return
    for number in (signal.SIGTERM, signal.SIGINT):
        before = signal.getsignal(number)

        def told(got: int, frame: Any, before: Any = before) -> None:
            service.stopping = True
            if callable(before):
                before(got, frame)

        signal.signal(number, told)


def wrapped(app: FastAPI, service: Service) -> ASGIApp:
    """`app` behind what all requests pass."""
    settings = service.settings
    inner: Any = Doorkeeper(Patience(app, settings), settings)
    return Outermost(inner, service.metrics, tls=settings.tls_certificate is not None)


def _answer(request: Request, problem: Problem) -> Response:
    request_id = str(request.scope.get("state", {}).get("request_id", ""))
    return Response(problem.body(request_id), problem.status, dict(problem.headers), MEDIA_TYPE)


async def _on_problem(request: Request, error: Any) -> Response:
    return _answer(request, error)


async def _on_error(request: Request, error: Any) -> Response:
    problem = problem_of(error)
    if problem.status >= 500:
        event("refused", request_id=request.state.request_id, error=f"{type(error).__name__}: {error}")
    return _answer(request, problem)


async def _on_http(request: Request, error: Any) -> Response:
    if isinstance(error.__cause__, Problem):  # of the body, which came too slowly or is too large
        return _answer(request, error.__cause__)
    if error.status_code == 404 and explorer.is_of_the_page(request):
        return await explorer.get_page(request)
    details = {404: "there is nothing at this address", 405: "this address takes other methods"}
    detail = details.get(error.status_code, str(error.detail))
    return _answer(request, Problem(error.status_code, detail, headers=error.headers or {}))


async def _on_invalid(request: Request, error: Any) -> Response:
    found = [{"where": ".".join(str(part) for part in one["loc"]), "message": one["msg"]} for one in error.errors()]
    detail = "; ".join(f"{one['where']}: {one['message']}" for one in found[:5])
    return _answer(request, Problem(422, detail, kind="parameters", more={"errors": found[:20]}))


async def _on_anything(request: Request, error: Any) -> Response:
    return _answer(request, Problem(500, "an error of the service, noted in its log"))


def _document(app: FastAPI) -> None:
    """Adds to the OpenAPI document what routes do not say."""
    made = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = made()
            parts = document.setdefault("components", {})
            parts["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
            parts.setdefault("schemas", {})["Problem"] = schemas.Problem.model_json_schema()
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
