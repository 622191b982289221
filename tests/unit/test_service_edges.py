"""What malformed or unusual requests meet before any route."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from semdb.service.cameras import Live, Sessions
from semdb.service.middleware import Doorkeeper, close_reason
from semdb.service.problems import Problem
from semdb.service.session_routes import _message
from semdb.service.settings import ServeSettings
from semdb.service.streams import Streams


@pytest.mark.parametrize("origin", [b"http://[", b"http://[::1", b"null", b"http://elsewhere", b"http://127.0.0.1:1"])
def test_an_origin_that_is_none_or_another_one_is_refused(origin: bytes) -> None:
    async def never(*_: Any) -> None:
        raise AssertionError

    scope = {"type": "http", "method": "GET", "headers": [(b"host", b"127.0.0.1:8765"), (b"origin", origin)]}
    with pytest.raises(Problem) as refused:
        asyncio.run(Doorkeeper(never, ServeSettings())(scope, never, never))  # type: ignore[arg-type]
    assert refused.value.status == 403


@pytest.mark.parametrize(("dest", "let_in"), [(b"document", True), (b"iframe", False), (b"object", False)])
def test_a_link_from_elsewhere_is_followed_but_in_no_frame(dest: bytes, let_in: bool) -> None:
    asked: list[str] = []

    async def app(scope: Any, *_: Any) -> None:
        asked.append(scope["type"])

    fetched = [(b"sec-fetch-site", b"cross-site"), (b"sec-fetch-mode", b"navigate"), (b"sec-fetch-dest", dest)]
    scope = {"type": "http", "method": "GET", "headers": [(b"host", b"127.0.0.1:8765"), *fetched]}
    door = Doorkeeper(app, ServeSettings())
    if let_in:
        asyncio.run(door(scope, app, app))  # type: ignore[arg-type]
    else:
        with pytest.raises(Problem):
            asyncio.run(door(scope, app, app))  # type: ignore[arg-type]
    assert asked == (["http"] if let_in else [])


def test_the_reason_of_an_end_fits_whatever_a_map_is_called() -> None:
    reason = close_reason(Problem(403, "this token is not for the map " + "\u0645\u0637\u0628\u062e" * 60 + "\udc80"))
    assert len(reason.encode()) <= 123
    assert reason.startswith("this token is not for the map ")


def test_a_request_that_failed_ends_no_camera_but_its_own() -> None:
    async def both() -> int:
        sessions = Sessions(4, 4, 60.0)
        async with sessions.use("one", "token 1"):
            sessions.end("one")
            sessions._live["one"] = Live()  # another request has begun it anew
        return len(sessions)

    assert asyncio.run(both()) == 1


def test_one_who_follows_much_leaves_places_for_others() -> None:
    streams = Streams(most=3, most_each=2)
    with streams.one("a"), streams.one("a"):
        with pytest.raises(Problem, match="too many follow"):
            streams.check("a")
        streams.check("b")
        with streams.one("b"), pytest.raises(Problem):
            streams.check("c")
    streams.check("a")
    assert len(streams) == 0


def test_the_parts_of_a_frame_are_no_larger_than_a_form() -> None:
    def told(*sizes: int) -> Any:
        messages = iter([{"type": "websocket.receive", "text": '{"parts": ["image", "depth"]}'}])
        files = iter([{"type": "websocket.receive", "bytes": bytes(size)} for size in sizes])

        async def receive() -> Any:
            return next(messages, None) or next(files)

        service = SimpleNamespace(settings=ServeSettings(max_upload_mb=0.5))
        app = SimpleNamespace(state=SimpleNamespace(service=service))
        socket: Any = SimpleNamespace(app=app, receive=receive)
        return asyncio.run(_message(socket))

    assert {part: len(data) for part, data in told(300_000, 200_000)[1].items()} == {"image": 300_000, "depth": 200_000}
    with pytest.raises(Problem, match=r"larger than 0\.5 MiB") as refused:
        told(300_000, 300_000)
    assert refused.value.status == 413
