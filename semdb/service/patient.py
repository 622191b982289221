"""How HTTP is read from a connection: a client that does not say what it wants is let go."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol


class PatientProtocol(HttpToolsProtocol):
    """uvicorn's, which bounds how long a connection is idle between requests, but not how slowly headers may come.

    `head_s` is the longest that they may take, from the connection, or from the first byte of a later request.
    """

    head_s = 30.0
    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Waits for a first request."""
        super().connection_made(transport)
        self._wait()

    def on_message_begin(self) -> None:
        """A request begins."""
        super().on_message_begin()
        if self._late is None:  # the first one waits since the connection
            self._wait()

    def on_headers_complete(self) -> None:
        """It is known what is wanted: the body has limits of its own."""
        self._stop_waiting()
        super().on_headers_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """The client went away."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _wait(self) -> None:
        self._late = self.loop.call_later(self.head_s, self._let_go)

    def _stop_waiting(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None

    def _let_go(self) -> None:
        self._late = None
        if self.transport is not None and not self.transport.is_closing():
            self.transport.close()


def patient(head_s: float) -> type[PatientProtocol]:
    """The protocol with that limit."""
    return type("PatientProtocol", (PatientProtocol,), {"head_s": head_s})
