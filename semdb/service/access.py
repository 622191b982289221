"""Who asks, and whether they may."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import Response

from semdb.door.access import AccessToken
from semdb.service.forms import read_form
from semdb.service.middleware import check_depth
from semdb.service.problems import Problem
from semdb.service.roles import ADMIN, ON_LOOPBACK, PUBLIC, SLASH, Access
from semdb.service.state import Service

FORWARDED = ("forwarded", "x-forwarded-for", "x-real-ip", "via")


def bearer(connection: HTTPConnection) -> str | None:
    """The token of a request. Raises Problem 401 for another kind of authorization."""
    given = connection.headers.get("authorization")
    if given is None:
        return None
    kind, _, token = given.partition(" ")
    if kind.lower() != "bearer" or not token.strip():
        raise refused("the header Authorization is not of the kind Bearer")
    return token.strip()


def refused(detail: str) -> Problem:
    """No token, or none that is valid."""
    return Problem(401, detail, headers={"WWW-Authenticate": 'Bearer realm="semdb"'})


async def admit(connection: HTTPConnection, role: str) -> Access:
    """Who asks, if they may. Raises Problem 401, 403, 429, 503."""
    service: Service = connection.app.state.service
    token = bearer(connection)
    found, any_there = await service.reading.run(lambda: service.database.access(token))
    access = _access(service, connection, token, found, any_there)
    connection.state.access = access
    service.rates.take(access.who)
    if not access.has(role):
        raise Problem(403, f"this needs a token of role {role}, and this one is of role {access.role}")
    asked = connection.path_params.get("map")
    if asked is not None and not access.sees(asked):
        raise Problem(403, f"this token is not for the map {asked!r}")
    return access


def _access(
    service: Service, connection: HTTPConnection, token: str | None, found: AccessToken | None, any_there: bool
) -> Access:
    if found is not None:
        return Access(found.role, found.map, f"token {found.id}")
    if token is not None:
        raise refused("the token is not known, has expired or was revoked")
    if any_there:
        raise refused("a token is needed: Authorization: Bearer TOKEN")
    if not service.settings.on_loopback:
        raise refused("without a token only programs of the same machine are served: semdb token create")
    if any(name in connection.headers for name in FORWARDED):
        raise refused("a proxy passes requests on, so a token is needed: semdb token create")
    return ON_LOOPBACK


class GuardedRoute(APIRoute):
    """A route whose role is looked at before anything of the body is read."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler behind the guard."""
        handler = super().get_route_handler()
        role = getattr(self.endpoint, "role", ADMIN)  # what says nothing is for the highest

        async def guarded(request: Request) -> Response:
            names = request.scope["path_params"]  # in which a slash was none that divides
            names.update({key: value.replace(SLASH, "/") for key, value in names.items()})
            if role != PUBLIC:
                await admit(request, role)
            if self.body_field is None:  # it takes none, or takes it piece by piece: nothing of it is read here
                return await handler(request)
            kind = request.headers.get("content-type", "").lower()
            if kind.startswith("application/json"):
                check_depth(await _body(request))
            if not kind.startswith("multipart/form-data"):
                return await handler(request)
            service: Service = request.app.state.service
            with service.forms.room_for(request) as there_is_room:
                if there_is_room:
                    await read_form(request, await _body(request))
                return await handler(request)

        return guarded


async def _body(request: Request) -> bytes:
    try:
        return await request.body()
    except ClientDisconnect:
        raise Problem(499, "the client went away") from None
