"""What every request passes, before anything knows what it asks: identity, errors, headers, origin, size, patience."""

from __future__ import annotations

import asyncio
import logging
import re
import time
import uuid
from collections.abc import Iterable
from urllib.parse import unquote_to_bytes, urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from semdb.events import event
from semdb.service.metrics import Metrics
from semdb.service.problems import MEDIA_TYPE, Problem
from semdb.service.roles import SLASH
from semdb.service.settings import MIB, ServeSettings

JSON_BODY = 64 * 1024
JSON_DEPTH = 32
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_ENCODED_SLASH = re.compile(rb"%2f", re.IGNORECASE)
_SAFE = ("GET", "HEAD")
HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-resource-policy": b"same-origin",
    b"cross-origin-opener-policy": b"same-origin",
    b"permissions-policy": b"camera=(), microphone=(), geolocation=()",
    b"content-security-policy": (
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
        b"font-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
}


class Outermost:
    """Gives each request an id, and tells logs and metrics of it; whatever fails becomes a problem."""

    def __init__(self, app: ASGIApp, metrics: Metrics, *, tls: bool) -> None:
        self._app, self._metrics = app, metrics
        self._headers = HEADERS | ({b"strict-transport-security": b"max-age=31536000"} if tls else {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        given = header(scope, b"x-request-id")
        request_id = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex[:16]
        scope.setdefault("state", {})["request_id"] = request_id
        scope["path"] = _path(scope)
        started, status = time.perf_counter(), 0

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                status = message["status"]
                message["headers"] = self._with(message.get("headers", ()), request_id)
            elif message["type"] == "websocket.accept":
                status = 101
            await send(message)

        failed: BaseException | None = None
        try:
            await self._app(scope, receive, answer)
        except Problem as problem:
            await tell(scope, answer, problem, request_id, begun=bool(status))
            status = status or problem.status
        except Exception as error:
            failed = error
            told = Problem(500, "an error of the service, noted in its log")
            await tell(scope, answer, told, request_id, begun=bool(status))
            status = 500
        finally:
            self._note(scope, request_id, status, time.perf_counter() - started, failed)

    def _note(self, scope: Scope, request_id: str, status: int, seconds: float, failed: BaseException | None) -> None:
        route = getattr(scope.get("route"), "path", "")
        method = scope.get("method", "WEBSOCKET")
        self._metrics.request(method, route, status, seconds)
        access = scope["state"].get("access")
        event(
            "request",
            level=logging.ERROR if failed is not None else logging.INFO,
            exc_info=failed,
            request_id=request_id,
            method=method,
            path=scope["path"].replace(SLASH, "%2F"),
            status=status,
            ms=round(1000 * seconds, 1),
            who=None if access is None else access.who,
        )

    def _with(self, headers: Iterable[tuple[bytes, bytes]], request_id: str) -> list[tuple[bytes, bytes]]:
        found = list(headers)
        there = {name.lower() for name, _ in found}
        found += [(name, value) for name, value in self._headers.items() if name not in there]
        if b"cache-control" not in there:
            found.append((b"cache-control", b"no-store"))
        found.append((b"x-request-id", request_id.encode()))
        return found


def _path(scope: Scope) -> str:
    """The path, in which a slash that belongs to a name is none that divides."""
    raw: bytes = scope.get("raw_path") or b""
    if not _ENCODED_SLASH.search(raw):
        return str(scope["path"])
    return unquote_to_bytes(_ENCODED_SLASH.sub(SLASH.encode(), raw.partition(b"?")[0])).decode("utf-8", "replace")


async def tell(scope: Scope, send: Send, problem: Problem, request_id: str, begun: bool = False) -> None:
    """Sends a problem; where an answer has begun, nothing can be said any more but that it ends here."""
    if begun:
        return
    body, start = problem.body(request_id), "http.response"
    if scope["type"] == "websocket":
        if "websocket.http.response" not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": 1008, "reason": close_reason(problem)})
            return
        start = "websocket.http.response"
    headers = [(b"content-type", MEDIA_TYPE.encode()), (b"content-length", str(len(body)).encode())]
    headers += [(name.lower().encode(), value.encode("latin-1", "replace")) for name, value in problem.headers.items()]
    await send({"type": f"{start}.start", "status": problem.status, "headers": headers})
    await send({"type": f"{start}.body", "body": b"" if scope.get("method") == "HEAD" else body})


def close_reason(problem: Problem) -> str:
    """What of a problem fits into the end of a websocket: 123 bytes."""
    return problem.detail.encode("utf-8", "replace")[:120].decode("utf-8", "ignore")


def header(scope: Scope, name: bytes) -> str:
    """The first header of that name, or nothing."""
    return next((value.decode("latin-1") for key, value in scope["headers"] if key == name), "")


class Doorkeeper:
    """Lets in who calls the service by a name of its own, and no page of anywhere else."""

    def __init__(self, app: ASGIApp, settings: ServeSettings) -> None:
        self._app = app
        self._hosts = settings.allowed_hosts
        self._any_host = not settings.on_loopback and settings.hosts is None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request. Raises Problem 403."""
        if scope["type"] in ("http", "websocket"):
            self._check(scope)
        await self._app(scope, receive, send)

    def _check(self, scope: Scope) -> None:
        host = header(scope, b"host").lower()
        if not self._any_host and _name(host) not in self._hosts:
            raise Problem(403, "the service is not known by the name in the header Host: SEMDB_SERVE_HOSTS names them")
        origin = header(scope, b"origin").lower()
        if origin and _netloc(origin) != host:
            raise Problem(403, "requests from pages of other places are refused", kind="foreign-origin")
        site = header(scope, b"sec-fetch-site").lower()
        followed = header(scope, b"sec-fetch-mode").lower() == "navigate" and scope.get("method") in _SAFE
        # a link is followed by someone who sees it; a frame asks unseen, as often as its page likes
        followed = followed and header(scope, b"sec-fetch-dest").lower() in ("", "document")
        if site in ("cross-site", "same-site") and not followed:
            raise Problem(403, "requests from pages of other places are refused", kind="foreign-origin")


def _netloc(origin: str) -> str | None:
    """Host and port of an origin; None where it is none."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


def _name(host: str) -> str:
    """The name in a header Host, without the port."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


class Patience:
    """Bounds what comes and how slowly, and how slowly it may be taken."""

    def __init__(self, app: ASGIApp, settings: ServeSettings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request. Raises Problem 408, 413, 422."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        settings = self._settings
        most = self._most(scope)
        length = header(scope, b"content-length")
        if length.isdigit() and int(length) > most:
            raise _too_large(most)
        deadline = time.monotonic() + settings.request_timeout_s
        came, over = 0, False

        async def taken() -> Message:
            nonlocal came, over
            if over:  # what comes now is that the client goes away
                return await receive()
            wait = min(settings.body_timeout_s, deadline - time.monotonic())
            try:
                async with asyncio.timeout(max(0.0, wait)):
                    message = await receive()
            except TimeoutError:
                raise Problem(408, "the request came too slowly", headers={"Connection": "close"}) from None
            came += len(message.get("body", b""))
            if came > most:
                raise _too_large(most)
            over = not message.get("more_body", False)
            return message

        async def given(message: Message) -> None:
            try:
                async with asyncio.timeout(settings.body_timeout_s):
                    await send(message)
            except TimeoutError:
                raise Problem(408, "the client takes nothing") from None

        await self._app(scope, taken, given)

    def _most(self, scope: Scope) -> int:
        kind = header(scope, b"content-type").lower()
        if scope["path"] == "/v1/uploads":
            return int(self._settings.max_recording_mb * MIB)
        if kind.startswith("multipart/"):
            return int(self._settings.max_upload_mb * MIB)
        return JSON_BODY


def _too_large(most: int) -> Problem:
    size = f"{most // MIB} MiB" if most >= MIB else f"{most // 1024} KiB"
    return Problem(413, f"the body is larger than {size}", headers={"Connection": "close"})


def check_depth(body: bytes) -> None:
    """Raises Problem 422 for JSON of more levels than anything here has."""
    level, in_text, escaped = 0, False, False
    for byte in body:
        if in_text:
            if escaped:
                escaped = False
            elif byte == 0x5C:
                escaped = True
            elif byte == 0x22:
                in_text = False
        elif byte == 0x22:
            in_text = True
        elif byte in b"[{":
            level += 1
            if level > JSON_DEPTH:
                raise Problem(422, f"the JSON has more than {JSON_DEPTH} levels")
        elif byte in b"]}":
            level -= 1
