"""Forms that are read in memory, against the parser of the framework."""

from __future__ import annotations

import asyncio
from typing import Any

import httpx
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from starlette.requests import Request

from semdb.service.forms import MOST_PARTS, Memory, form_of, read_form

NAMES = st.text(st.characters(codec="utf-8", exclude_characters='\r\n"\\'), min_size=1, max_size=12)


def request_of(body: bytes, content_type: str) -> Request:
    sent = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive() -> dict[str, Any]:
        return sent.pop()

    headers = [(b"content-type", content_type.encode()), (b"content-length", str(len(body)).encode())]
    return Request({"type": "http", "method": "POST", "headers": headers}, receive)


async def told(request: Request) -> list[Any]:
    """All that a form holds."""
    found = []
    for name, value in (await request.form()).multi_items():
        if isinstance(value, str):
            found.append((name, value))
        else:
            found.append((name, value.filename, value.size, value.content_type, await value.read()))
    return found


def both(body: bytes, content_type: str) -> tuple[bool, list[Any], list[Any]]:
    """Whether it was read in memory, and what both parsers find."""

    async def ask() -> tuple[bool, list[Any], list[Any]]:
        quick = request_of(body, content_type)
        read_form(quick, await quick.body())
        return quick._form is not None, await told(quick), await told(request_of(body, content_type))

    return asyncio.run(ask())


TEXTS = st.one_of(st.text(max_size=30), st.lists(st.text(max_size=5), max_size=3))


@given(
    fields=st.dictionaries(NAMES, TEXTS, max_size=4),
    files=st.lists(st.tuples(NAMES, NAMES, st.binary(max_size=300)), min_size=1, max_size=4),
)
@example(fields={}, files=[("image", "a.png", b"\r\n--\r\n\r\n--")])
def test_what_clients_send_is_read_as_the_framework_reads_it(fields: dict[str, Any], files: list[Any]) -> None:
    sent = [(name, (called, content)) for name, called, content in files]
    made = httpx.Request("POST", "http://x/", data=fields, files=sent)
    quick, found, wanted = both(made.read(), made.headers["content-type"])
    assert found == wanted
    assert len(found) == len(files) + sum(len(value) if isinstance(value, list) else 1 for value in fields.values())
    assert quick or "%" in str(files) + str(fields)  # httpx writes such names otherwise


HEAD = b'Content-Disposition: form-data; name="a"'


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"--x",
        b"--x--\r\n",
        b"--x\r\n" + HEAD + b"\r\n\r\nno end",
        b"--x\r\n" + HEAD + b"\r\n\r\n1\r\n--x--\r\nafter the end",
        b"before\r\n--x\r\n" + HEAD + b"\r\n\r\n1\r\n--x--\r\n",
        b"--x\n" + HEAD + b"\n\n1\n--x--\n",
        b"--x\r\n" + HEAD + b"\r\n\r\n1\r\n--xy\r\n--x--\r\n",
        b"--x\r\n" + HEAD + b"\r\nX-Other: 1\r\n\r\n1\r\n--x--\r\n",
        b"--x\r\n" + HEAD + b"\r\n" + HEAD + b"\r\n\r\n1\r\n--x--\r\n",
        b"--x\r\nContent-Type: text/plain\r\n\r\n1\r\n--x--\r\n",
        b"--x\r\n" + HEAD + b"\r\n\r\n\xff\r\n--x--\r\n",
        b"--x\r\n" + HEAD.replace(b"a", b"\xff") + b"\r\n\r\n1\r\n--x--\r\n",
        b"--x\r\n" + HEAD + b"\r\n\r\n" + b"1" * (2**20 + 1) + b"\r\n--x--\r\n",
        b"".join(b"--x\r\n" + HEAD + b"\r\n\r\n1\r\n" for _ in range(MOST_PARTS + 1)) + b"--x--\r\n",
    ],
)
def test_what_is_unusual_is_left_to_the_framework(body: bytes) -> None:
    assert form_of(body, b"x") is None


@pytest.mark.parametrize("kind", ["multipart/form-data", "multipart/form-data; boundary=x; charset=utf-16", "a/b"])
def test_other_kinds_are_left_to_the_framework(kind: str) -> None:
    body = b"--x\r\n" + HEAD + b"\r\n\r\n1\r\n--x--\r\n"
    request = request_of(body, kind)
    read_form(request, body)
    assert request._form is None


def test_only_so_much_is_in_memory() -> None:
    memory = Memory(most=100, largest=60)
    with memory.room_for(request_of(b"1" * 60, "")) as first, memory.room_for(request_of(b"1" * 50, "")) as second:
        assert (first, second) == (True, False)
        with memory.room_for(request_of(b"1" * 40, "")) as third:
            assert third
    with memory.room_for(request_of(b"1" * 61, "")) as large, memory.room_for(request_of(b"1" * 60, "")) as small:
        assert (large, small) == (False, True)
    chunked = Request({"type": "http", "headers": [(b"transfer-encoding", b"chunked")]})
    with memory.room_for(chunked) as unknown:
        assert not unknown
