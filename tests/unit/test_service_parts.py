"""Parts of the service by themselves: pools, what is signed, what is scrubbed, masks, settings."""

from __future__ import annotations

import asyncio
import threading
import time
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from semdb.door.protocol import CameraTracker
from semdb.errors import DatabaseError, FrameError, ModelError, NotFoundError, UsageError
from semdb.service import schemas
from semdb.service.cameras import Sessions
from semdb.service.middleware import check_depth
from semdb.service.pool import Pool
from semdb.service.problems import Problem, problem_of, scrubbed
from semdb.service.roles import ON_LOOPBACK
from semdb.service.session_routes import check_places
from semdb.service.settings import ServeSettings, is_loopback, serve_settings
from semdb.service.signing import opened, signed
from semdb.service.values import mask_of, run_lengths


def test_a_pool_runs_so_many_and_lets_so_many_wait() -> None:
    pool = Pool("work", threads=1, queue=1)
    go, begun = threading.Event(), []

    def work(name: str) -> str:
        begun.append(name)
        go.wait(10)
        return name

    async def all_of_it() -> None:
        first = asyncio.ensure_future(pool.run(lambda: work("first")))
        second = asyncio.ensure_future(pool.run(lambda: work("second")))
        await asyncio.sleep(0.05)
        with pytest.raises(Problem) as refused:
            await pool.run(lambda: work("third"))
        assert (refused.value.status, refused.value.headers["Retry-After"] >= "1") == (429, True)
        second.cancel()  # a client that goes away leaves the queue
        await asyncio.sleep(0.05)
        assert pool.inside == 1
        left = asyncio.Event()
        third = asyncio.ensure_future(pool.run(lambda: work("third"), left.wait))
        await asyncio.sleep(0.05)
        left.set()
        with pytest.raises(Problem) as gone:
            await third
        assert gone.value.status == 499
        go.set()
        assert await first == "first"
        assert await pool.run(lambda: "fourth", asyncio.Event().wait) == "fourth"

    asyncio.run(all_of_it())
    assert begun == ["first"]
    assert pool.inside == 0
    pool.close()


def test_what_is_signed_is_of_this_service_this_kind_and_in_time() -> None:
    text = signed(b"secret", "session", {"map": "a"}, 60)
    assert opened(b"secret", "session", text) == {"map": "a"}
    assert opened(b"other", "session", text) is None
    assert opened(b"secret", "delete", text) is None
    assert opened(b"secret", "session", signed(b"secret", "session", {}, -1)) is None
    for bad in ("", "é", "A" * 5000, text[:-2], f"x{text}"):
        assert opened(b"secret", "session", bad) is None


@given(st.text(max_size=200))
def test_no_text_is_taken_for_something_signed(text: str) -> None:
    assert opened(b"secret", "session", text) is None


@given(st.data())
def test_masks_are_the_same_after_their_run_lengths(data: st.DataObject) -> None:
    shape = data.draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    mask = data.draw(arrays(np.bool_, shape))
    lengths = run_lengths(mask)
    assert sum(lengths["counts"]) == mask.size
    np.testing.assert_array_equal(mask_of(lengths), mask)


def test_run_lengths_are_cocos() -> None:
    mask = np.array([[1, 0], [1, 1]], np.bool_)
    assert run_lengths(mask) == {"size": [2, 2], "counts": [0, 2, 1, 1]}


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("there is no map 'x' in sqlite:////data/me/a.sqlite3; maps: office, attic", "there is no map 'x'"),
        ("/data/me/a.png: is not an image", "...: is not an image"),
        ("open ~/x/y or ../up/z now", "open ... or ... now"),
        ("mysql+pymysql://me:secret@host:3306/db refused", "... refused"),
        ("1/2 of them, a/b and 3 m/s", "1/2 of them, a/b and 3 m/s"),
    ],
)
def test_messages_lose_paths_and_addresses(said: str, told: str) -> None:
    assert scrubbed(said) == told


def test_errors_of_the_library_as_problems() -> None:
    for error, status in (
        (NotFoundError("x"), 404),
        (UsageError("x"), 422),
        (FrameError("x"), 422),
        (ModelError("/models/x.onnx is not there"), 503),
        (DatabaseError("mysql+pymysql://me@host/db refused 'SELECT'"), 500),
    ):
        problem = problem_of(error)
        assert (problem.status, "/" in problem.detail) == (status, False)


def test_examples_of_the_document_are_valid() -> None:
    for model in (schemas.Answer, schemas.Keyframe):
        [example] = model.model_json_schema()["examples"]
        model.model_validate(example)


def test_json_of_too_many_levels() -> None:
    check_depth(b'{"a": "[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[\\"["}')
    check_depth(b"[1]" * 100)
    with pytest.raises(Problem):
        check_depth(b"[" * 33)


def test_settings_of_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_loopback("127.0.0.1")
    assert is_loopback("::1")
    assert is_loopback("localhost")
    assert not is_loopback("0.0.0.0")
    assert ServeSettings(hosts="robots.example, Other").allowed_hosts >= {"robots.example", "other", "localhost"}
    monkeypatch.setenv("SEMDB_SERVE_PORT", "99999999")
    with pytest.raises(UsageError, match="SEMDB_SERVE_PORT=99999999"):
        serve_settings({})
    for name, value in (("workers", 0), ("ingest_roots", "relative"), ("ingest_roots", "s3://b"), ("secret", "short")):
        with pytest.raises(UsageError, match=f"--{name.replace('_', '-')}") as told:
            serve_settings({"port": 1, name: value})
        assert "short" not in str(told.value)


def test_a_pool_tells_when_to_come_again() -> None:
    pool: Any = Pool("work", threads=1, queue=0)
    asyncio.run(pool.run(lambda: time.sleep(0.01)))
    assert 0.1 < pool._usual_s < 0.3
    pool.close()


def test_one_token_leaves_places_for_others() -> None:
    sessions = Sessions(most=4, most_each=2, idle_s=60)

    async def begin(name: str, who: str) -> None:
        await begin_in(sessions, name, who)

    async def all_of_it() -> None:
        for name in ("a", "b", "a"):  # the third one is there already
            await begin(name, "token 1")
        with pytest.raises(Problem, match="2 cameras of this token") as refused:
            await begin("c", "token 1")
        assert refused.value.status == 429
        await begin("d", "token 2")
        await begin("e", ON_LOOPBACK.who)
        with pytest.raises(Problem, match="4 cameras are tracked"):
            await begin("f", "token 3")
        sessions.end("a")
        await begin("c", "token 1")
        assert (sessions.of("token 1"), len(sessions)) == (2, 4)

    asyncio.run(all_of_it())
    alone = Sessions(most=3, most_each=1, idle_s=60)
    for name in "abc":  # without tokens there is nobody else
        asyncio.run(begin_in(alone, name, ON_LOOPBACK.who))
    assert len(alone) == 3


async def begin_in(sessions: Sessions, name: str, who: str) -> None:
    async with sessions.use(name, who) as live:
        live.tracker = cast(CameraTracker, object())


def test_connections_of_one_token_leave_places_for_others() -> None:
    service: Any = SimpleNamespace(settings=ServeSettings(sessions=3, sessions_per_token=2), sockets={})
    for number in range(2):
        check_places(service, "token 1")
        service.sockets[number] = "token 1"
    with pytest.raises(Problem) as refused:
        check_places(service, "token 1")
    assert refused.value.status == 429
    check_places(service, "token 2")
    service.sockets[2] = "token 2"
    with pytest.raises(Problem):
        check_places(service, ON_LOOPBACK.who)
