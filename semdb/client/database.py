"""A database that a service has, asked as if it were here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

from semdb.client.reading import Say
from semdb.client.transport import Transport, address_of, load_httpx, token_of
from semdb.client.writing import Writing

if TYPE_CHECKING:
    from semdb.client.aio import AsyncDatabase
    from semdb.door.protocol import SemanticDatabase


class RemoteDatabase(Writing):
    """A semantic database behind a service. Made by `semdb.connect`; close it, or use it in a ``with``.

    Any number of threads may ask it at the same time. What it answers with are the values of `semdb.open`.
    """

    @property
    def aio(self) -> AsyncDatabase:
        """The same for asyncio."""
        from semdb.client.aio import AsyncDatabase

        return AsyncDatabase(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<semdb service {self.url}>"


def connect(
    url: str,
    *,
    token: str | None = None,
    timeout_s: float = 60.0,
    retries: int = 5,
    patience_s: float = 60.0,
    say: Say | None = None,
    handler: Any = None,
) -> RemoteDatabase:
    """See `semdb.connect`. `handler` is a transport of httpx instead of the network, for tests."""
    load_httpx()
    transport = Transport(address_of(url), token_of(token), timeout_s, retries, patience_s, handler)
    database = RemoteDatabase(transport, say=say)
    if transport.in_the_open:
        database._say(f"{transport.url}: the token is sent unencrypted; https:// keeps it from who is on the way")
    return database


def connect_async(url: str, **options: Any) -> AsyncDatabase:
    """See `semdb.connect_async`."""
    return connect(url, **options).aio


if TYPE_CHECKING:
    _: SemanticDatabase = RemoteDatabase(Transport("", None))
