"""Forms that are read in memory, against the parser of the framework."""

from __future__ import annotations

import asyncio
from typing import Any

import httpx
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException
from starlette.requests import Request

from semdb.service.forms import Memory, read_form

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
        await read_form(quick, await quick.body())
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
    assert quick


HEAD = b'Content-Disposition: form-data; name="a"'


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        (b"", "multipart/form-data; boundary=x"),
        (b"rubbish", "multipart/form-data; boundary=x"),
        (b"--x\r\n" + HEAD + b"\r\n\r\n1\r\n--x--\r\n", "multipart/form-data"),
        (b"--x\r\nContent-Type: text/plain\r\n\r\n1\r\n--x--\r\n", "multipart/form-data; boundary=x"),
        (b"--x\r\n" + HEAD + b"\r\n\r\n" + b"1" * (2**20 + 1) + b"\r\n--x--\r\n", "multipart/form-data; boundary=x"),
    ],
)
def test_what_is_no_form_is_none_of_the_framework_either(body: bytes, kind: str) -> None:
    async def ask(quick: bool) -> list[Any] | str:
        request = request_of(body, kind)
        if quick:
            await read_form(request, await request.body())
        try:
            return await told(request)
        except MultiPartException as error:
            return error.message

    assert asyncio.run(ask(True)) == asyncio.run(ask(False))


def test_nothing_of_it_is_on_disk() -> None:
    content = b"1" * (3 * 2**20)
    made = httpx.Request("POST", "http://x/", files={"image": ("a.png", content)})

    async def ask() -> UploadFile:
        request = request_of(made.read(), made.headers["content-type"])
        await read_form(request, await request.body())
        found = (await request.form())["image"]
        assert isinstance(found, UploadFile)
        return found

    found = asyncio.run(ask())
    assert found._in_memory
    assert (found.size, found.file.read()) == (len(content), content)


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
