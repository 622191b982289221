"""Forms with files that are of a usual size, read in memory and in one go.

The parser of the framework is given a body piece by piece else, and keeps files of over a megabyte on disk, which takes
longer than all else that HTTP costs. What is large is left to that.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterator
from contextlib import contextmanager

from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from semdb.service.settings import MIB

LARGEST = 8 * MIB
MOST_AT_ONCE = 256 * MIB  # of all requests of the process that are in memory so


class Memory:
    """How much of forms may be in memory; used on the loop alone."""

    def __init__(self, most: int = MOST_AT_ONCE, largest: int = LARGEST) -> None:
        self._most, self._largest = most, largest
        self.held = 0  # bytes

    @contextmanager
    def room_for(self, request: Request) -> Iterator[bool]:
        """Whether there is room for the body of a request, which is held meanwhile."""
        told = request.headers.get("content-length", "")
        size = int(told) if told.isdigit() else self._largest + 1
        if size > self._largest or self.held + size > self._most:
            yield False
            return
        self.held += size
        try:
            yield True
        finally:
            self.held -= size


class _InMemory(MultiPartParser):
    spool_max_size = LARGEST + 1  # nothing of it goes to disk


async def read_form(request: Request, body: bytes) -> None:
    """Leaves the form of a body with its request; where it is none, the framework finds that again, and says it."""

    async def whole() -> AsyncGenerator[bytes, None]:
        yield body

    try:
        request._form = await _InMemory(request.headers, whole()).parse()
    except MultiPartException:
        return
