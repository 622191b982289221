"""Forms with files that are of a usual size, read in memory and in one go.

The parser of the framework takes a body piece by piece and keeps files on disk, which takes longer than all else that
HTTP costs. What is large, or is written in any unusual way, is left to it.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager

from python_multipart.multipart import parse_options_header
from starlette.datastructures import FormData, Headers, UploadFile
from starlette.requests import Request

from semdb.service.settings import MIB

LARGEST = 8 * MIB
MOST_AT_ONCE = 256 * MIB  # of all requests of the process that are in memory so
MOST_PARTS = 500
LONGEST_FIELD = MIB
LONGEST_HEAD = 2048
_BOUNDARY = re.compile(rb"[0-9A-Za-z'()+_,./:=?-]{1,70}")
_KNOWN = (b"content-disposition", b"content-type", b"content-length")


class Memory:
    """How much of forms may be in memory; used on the loop alone."""

    def __init__(self, most: int = MOST_AT_ONCE, largest: int = LARGEST) -> None:
        self._left, self._largest = most, largest

    @contextmanager
    def room_for(self, request: Request) -> Iterator[bool]:
        """Whether there is room for the body of a request, which is held meanwhile."""
        told = request.headers.get("content-length", "")
        size = int(told) if told.isdigit() else self._largest + 1
        if size > self._largest or size > self._left:
            yield False
            return
        self._left -= size
        try:
            yield True
        finally:
            self._left += size


class _InMemory(io.BytesIO):
    _rolled = False  # what tells an upload that reading it needs no thread


def read_form(request: Request, body: bytes) -> None:
    """Leaves the form of a body with its request where it is a usual one."""
    kind, options = parse_options_header(request.headers.get("content-type"))
    if kind != b"multipart/form-data" or set(options) != {b"boundary"}:
        return
    if _BOUNDARY.fullmatch(options[b"boundary"]):
        request._form = form_of(body, options[b"boundary"])


def form_of(body: bytes, boundary: bytes) -> FormData | None:
    """The fields and files of a body; None for one that is not a usual one, whether it is wrong or not."""
    line, ends = b"--" + boundary, b"\r\n--" + boundary
    if not body.startswith(line + b"\r\n"):
        return None
    items: list[tuple[str, UploadFile | str]] = []
    start = len(line)
    while body[start : start + 2] == b"\r\n":
        head_end = body.find(b"\r\n\r\n", start, start + LONGEST_HEAD)
        end = body.find(ends, head_end + 4)
        if head_end < 0 or end < 0 or len(items) == MOST_PARTS:
            return None
        item = _item(body[start + 2 : head_end], body[head_end + 4 : end])
        if item is None:
            return None
        items.append(item)
        start = end + len(ends)
    return FormData(items) if items and body[start:] in (b"--", b"--\r\n") else None


def _item(head: bytes, content: bytes) -> tuple[str, UploadFile | str] | None:
    """A part of a form; None where its head is not a usual one."""
    headers = []
    for line in head.split(b"\r\n"):
        name, colon, value = line.partition(b": ")
        if not colon or name.lower() not in _KNOWN:
            return None
        headers.append((name.lower(), value))
    found = dict(headers)
    kind, options = parse_options_header(found.get(b"content-disposition"))
    if len(found) != len(headers) or kind != b"form-data" or not {b"name"} <= set(options) <= {b"name", b"filename"}:
        return None
    try:
        called = options[b"name"].decode()
        if b"filename" not in options:
            return None if len(content) > LONGEST_FIELD else (called, content.decode())
        filename = options[b"filename"].decode()
    except UnicodeDecodeError:
        return None
    return called, UploadFile(_InMemory(content), size=len(content), filename=filename, headers=Headers(raw=headers))
