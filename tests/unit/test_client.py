"""The client of a service against a transport that fails as networks and services do."""

from __future__ import annotations

import builtins
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import semdb
from semdb import errors
from semdb.client import RemoteDatabase, connect
from semdb.client.images import ImageReader, in_units
from semdb.client.transport import address_of, segment, token_of
from semdb.client.values import packed_mask
from semdb.localization.on_disk import RecordingsOnDisk
from semdb.recordings.images import decode_16bit, scaled_depth
from semdb.service.problems import Problem, problem_of
from semdb.service.values import run_lengths

Step = httpx.Response | Exception


class Flaky:
    """Answers by a list; the last of it again and again. `asked` has what was asked."""

    def __init__(self, *steps: Step) -> None:
        self.steps, self.asked = list(steps), list[httpx.Request]()

    def __call__(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.asked.append(request)
        step = self.steps.pop(0) if len(self.steps) > 1 else self.steps[0]
        if isinstance(step, Exception):
            raise step
        return httpx.Response(step.status_code, headers=step.headers, content=step.content)


def told(problem: Problem) -> httpx.Response:
    headers = {"Content-Type": "application/problem+json", **problem.headers}
    return httpx.Response(problem.status, headers=headers, content=problem.body("1"))


MAPS = httpx.Response(200, json={"items": [{"name": "a", "id": 1, "keyframes": 2, "recordings": 1}], "key": None})
BUSY = told(Problem(429, "busy", headers={"Retry-After": "1"}))
DOWN = told(Problem(503, "the database does not answer now", kind="database"))


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """How long was waited, without waiting."""
    found: list[float] = []
    monkeypatch.setattr(time, "sleep", found.append)
    return found


def asking(flaky: Callable[[httpx.Request], httpx.Response], **options: Any) -> RemoteDatabase:
    return connect("http://localhost:1", handler=httpx.MockTransport(flaky), **options)


def test_what_can_be_asked_twice_is_asked_again(waits: list[float]) -> None:
    request = httpx.Request("GET", "http://localhost:1")
    flaky = Flaky(httpx.ConnectError("refused"), httpx.ReadError("reset", request=request), BUSY, DOWN, MAPS)
    assert [info.name for info in asking(flaky).maps()] == ["a"]
    assert len(flaky.asked) == 5
    assert 0.1 <= waits[0] <= 0.2
    assert 0.2 <= waits[1] <= 0.4
    assert 1.0 <= waits[2] <= 1.2  # Retry-After
    assert 0.8 <= waits[3] <= 1.6


def test_a_retry_after_that_is_a_date_or_too_long(waits: list[float]) -> None:
    late = httpx.Response(503, headers={"Retry-After": "Wed, 21 Oct 2015 07:28:00 GMT"})
    assert asking(Flaky(late, MAPS)).maps()
    assert waits[0] < 0.1
    flaky = Flaky(told(Problem(429, "busy", headers={"Retry-After": "120"})))
    with pytest.raises(errors.DatabaseUnavailableError, match="busy"):
        asking(flaky).maps()
    assert len(flaky.asked) == 1


def test_images_are_sent_again_whole(waits: list[float]) -> None:
    flaky = Flaky(httpx.ReadTimeout("slow"), DOWN, told(Problem(422, "no", kind="frame")))
    with pytest.raises(errors.FrameError, match="no"):
        asking(flaky).localize(np.zeros((20, 20, 3), np.uint8), camera=(1, 1, 1, 1), map="a/b", name="x")
    bodies = {request.content.split(b"\r\n", 1)[1].rsplit(b"--", 2)[0].count(b"\x89PNG") for request in flaky.asked}
    assert (len(flaky.asked), bodies) == (3, {1})
    assert flaky.asked[0].url.raw_path == b"/v1/maps/a%2Fb/localize"


def test_what_may_have_been_done_is_not_done_twice(waits: list[float]) -> None:
    flaky = Flaky(httpx.ReadError("reset"))
    with pytest.raises(errors.DatabaseUnavailableError, match="whether it was done is not known"):
        asking(flaky)._transport.json("POST", "/v1/maps/a/ingest", json={})
    assert len(flaky.asked) == 1
    flaky = Flaky(BUSY, httpx.ConnectError("refused"), DOWN)
    with pytest.raises(errors.DatabaseUnavailableError, match="does not answer now"):
        asking(flaky)._transport.json("POST", "/v1/maps/a/ingest", json={})
    assert len(flaky.asked) == 3


def test_deleting_asks_first() -> None:
    first = told(Problem(428, "sure?", more={"deletes": {"recordings": 1, "keyframes": 5}, "confirmation": "yes"}))
    done = httpx.Response(200, json={"recordings": 1, "keyframes": 5})
    flaky = Flaky(first, done)
    assert asking(flaky).delete(map="a").keyframes == 5
    assert [request.url.query for request in flaky.asked] == [b"", b"confirm=yes"]
    refused = Flaky(first)
    assert asking(refused).delete(map="a", confirm=lambda would: would.keyframes < 5).keyframes == 0
    assert len(refused.asked) == 1


@pytest.mark.parametrize(
    "error",
    [
        errors.NotFoundError,
        errors.FrameError,
        errors.UsageError,
        errors.RecordingError,
        errors.ProvenanceError,
        errors.ModelError,
        errors.SchemaError,
        errors.DatabaseUnavailableError,
        errors.DatabaseError,
    ],
)
def test_errors_are_those_of_the_library(error: type[errors.SemdbError], waits: list[float]) -> None:
    flaky = Flaky(told(problem_of(error("what is wrong"))))
    with pytest.raises(errors.SemdbError) as caught:
        asking(flaky, retries=1).maps()
    assert type(caught.value) is error
    assert str(caught.value).startswith("http://localhost:1: ")
    assert len(flaky.asked) == (2 if error is errors.DatabaseUnavailableError else 1)


def test_answers_that_are_none_of_a_service(waits: list[float]) -> None:
    page = httpx.Response(502, content=b"<html>Bad Gateway</html>")
    with pytest.raises(errors.DatabaseUnavailableError, match="answered 502"):
        asking(Flaky(page), retries=1).maps()
    with pytest.raises(errors.DatabaseUnavailableError, match="no service of semdb"):
        asking(Flaky(httpx.Response(200, content=b"<html>"))).maps()
    with pytest.raises(errors.DatabaseError, match="SEMDB_TOKEN"):
        asking(Flaky(told(Problem(401, "a token is needed")))).maps()
    with pytest.raises(errors.DatabaseError, match="answered 302"):
        asking(Flaky(httpx.Response(302, headers={"Location": "http://elsewhere"}))).maps()


def test_rows_that_are_left_out_are_said() -> None:
    found = {"columns": ["a"], "rows": [[1], [2]], "truncated": True}
    rows = iter(asking(Flaky(httpx.Response(200, json=found))).sql("SELECT 1"))
    assert [next(rows), next(rows)] == [(1,), (2,)]
    with pytest.raises(errors.DatabaseError, match="no more than these 2 rows"):
        next(rows)


def test_where_tokens_come_from(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("SEMDB_TOKEN", "SEMDB_TOKEN_FILE"):
        monkeypatch.delenv(name, raising=False)
    assert token_of(None) is None
    file = tmp_path / "token"
    file.write_text("of-the-file\n")
    monkeypatch.setenv("SEMDB_TOKEN_FILE", str(file))
    assert token_of(None) == "of-the-file"
    monkeypatch.setenv("SEMDB_TOKEN", "of-the-environment")
    assert token_of(None) == "of-the-environment"
    flaky = Flaky(MAPS)
    asking(flaky, token="given").maps()
    assert flaky.asked[0].headers["authorization"] == "Bearer given"
    for wrong in ("", "two words", "über"):
        with pytest.raises(errors.UsageError, match="no token"):
            token_of(wrong)
    monkeypatch.delenv("SEMDB_TOKEN")
    monkeypatch.setenv("SEMDB_TOKEN_FILE", str(tmp_path / "none"))
    with pytest.raises(errors.UsageError, match="cannot be read"):
        token_of(None)


def test_a_token_in_the_open_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    connect("http://robots.example:8765", token="secret", say=said.append)
    connect("https://robots.example", token="secret", say=said.append)
    connect("http://127.0.0.1:8765", token="secret", say=said.append)
    assert len(said) == 1
    assert "unencrypted" in said[0]
    assert "secret" not in said[0] + repr(connect("https://robots.example", token="secret"))


def test_addresses() -> None:
    assert address_of("https://robots.example/semdb/v1/") == "https://robots.example/semdb"
    for wrong in ("robots.example", "ftp://a", "http://", "http://a?b", "http://a:x", "http://[::1"):
        with pytest.raises(errors.UsageError, match="the address of a service is like"):
            address_of(wrong)
    with pytest.raises(errors.UsageError, match="a token is no part of it"):
        address_of("http://user:token@a")
    assert segment("a/b c") == "a%2Fb%20c"
    assert segment("..") == "%2E%2E"


def test_what_a_service_does_not_offer() -> None:
    database = asking(Flaky(MAPS))
    for ask in (lambda: database.refine("a"), lambda: database.trajectory("a")):
        with pytest.raises(errors.UsageError, match=r"is for semdb\.open only"):
            ask()
    database.close()
    with pytest.raises(errors.UsageError, match="is closed"):
        database.maps()


def test_without_httpx_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *arguments: Any, **options: Any) -> Any:
        if name == "httpx":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(errors.UsageError, match=r"pip install 'semdb\[client\]'"):
        semdb.connect("http://localhost:8765")


def test_masks_come_back_bit_for_bit() -> None:
    for seed, shape in enumerate([(7, 5), (16, 16), (1, 9), (480, 640)]):
        mask = np.random.default_rng(seed).random(shape) > 0.4
        sent = json.loads(json.dumps(run_lengths(mask)))
        assert packed_mask(sent["counts"], *sent["size"]) == np.packbits(mask).tobytes()


def test_depth_is_sent_exactly_where_16_bits_hold_it() -> None:
    said: list[str] = []
    reader = ImageReader(said.append, RecordingsOnDisk())
    image = np.zeros((20, 30, 3), np.uint8)
    raw = np.random.default_rng(0).integers(0, 65535, (20, 30)).astype(np.uint16)
    for scale in (5000.0, 1000.0):
        metres = scaled_depth(raw, scale)
        sent = reader.read(image, metres)
        assert sent.depth is not None
        assert sent.depth_scale is not None
        back = scaled_depth(decode_16bit(sent.depth, "depth", (30, 20)), sent.depth_scale)
        assert np.array_equal(back, metres, equal_nan=True)
    assert said == []
    sent = reader.read(image, np.full((20, 30), 1.23456789, np.float32))
    assert sent.depth_scale == 5000
    assert said == ["depth is sent in steps of 0.2 mm up to 13.1 m (first that of image)"]
    assert in_units(np.full((1, 1), 14.0, np.float32), 5000) is None
