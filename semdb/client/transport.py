"""Requests to a service: with a token, within a time, and again where asking again can do no harm."""

from __future__ import annotations

import contextlib
import email.utils
import math
import os
import random
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlsplit

from semdb.client.problems import error_of, kind_of
from semdb.errors import DatabaseUnavailableError, UsageError
from semdb.names import storable
from semdb.shown import for_terminal

if TYPE_CHECKING:
    import httpx

TOKEN, TOKEN_FILE = "SEMDB_TOKEN", "SEMDB_TOKEN_FILE"
CONNECT_S = 10.0
FIRST_WAIT_S, LONGEST_WAIT_S = 0.2, 5.0
AGAIN = frozenset([408, 429, 502, 503, 504])
NOT_DONE = frozenset([429])  # whatever was asked, nothing of it was done
FOR_GOOD = frozenset(["model", "schema"])  # of 503: waiting mends nothing
MOST_CONNECTIONS = 64
_LOOPBACK = ("localhost", "127.", "::1")


def load_httpx() -> Any:
    """The module. Raises UsageError where it is not installed."""
    try:
        import httpx
    except ImportError:
        raise UsageError("semdb.connect needs httpx: pip install 'semdb[client]'") from None
    return httpx


def token_of(given: str | None) -> str | None:
    """The token that is given, else that of SEMDB_TOKEN, else the one in the file of SEMDB_TOKEN_FILE. UsageError."""
    where = "token="
    token = given
    if token is None:
        where, token = TOKEN, os.environ.get(TOKEN) or None
    if token is None and (name := os.environ.get(TOKEN_FILE)):
        where = f"{TOKEN_FILE}={name}"
        try:
            token = Path(name).expanduser().read_text("utf-8")
        except (OSError, ValueError) as error:
            raise UsageError(f"{for_terminal(where)}: the token cannot be read: {error}") from None
    if token is None:
        return None
    token = token.strip()
    if not token or not all("!" <= letter <= "~" for letter in token):
        raise UsageError(f"{for_terminal(where)}: this is no token, as `semdb token create` prints one")
    return token


def address_of(url: str) -> str:
    """The address of a service, without a slash at the end. Raises UsageError."""
    usage = "the address of a service is like http://robots.example:8765"
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError:
        raise UsageError(f"{for_terminal(url)!r}: {usage}") from None
    if parts.username is not None or parts.password is not None:
        raise UsageError(f"{usage}; a token is no part of it: token=, {TOKEN} or {TOKEN_FILE}")
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
        raise UsageError(f"{for_terminal(url)!r}: {usage}")
    return url.rstrip("/").removesuffix("/v1")


def segment(name: object) -> str:
    """A name as part of an address, its slashes too."""
    text = quote(storable(str(name)), safe="")
    return text.replace(".", "%2E") if text in (".", "..") else text


@dataclass
class Transport:
    """Asks the service at `url`. Any number of threads may; a process that is forked off has connections of its own.

    Without an answer for `timeout_s` a request is given up. One that changes nothing is made again, up to `retries`
    times and as long as `patience_s` are not over, after a wait that doubles, or what ``Retry-After`` says.
    """

    url: str
    token: str | None = field(repr=False)
    timeout_s: float = 60.0
    retries: int = 5
    patience_s: float = 60.0
    handler: Any = None  # an httpx transport, for tests
    _clients: dict[int, httpx.Client] = field(default_factory=dict, repr=False)
    _turn: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _closed: bool = False

    def __post_init__(self) -> None:
        if not (self.timeout_s > 0 and math.isfinite(self.timeout_s)):
            raise UsageError(f"timeout_s={self.timeout_s}: a positive number of seconds is needed")
        if self.retries < 0:
            raise UsageError(f"retries={self.retries}: how many times again? From 0 on")

    @property
    def in_the_open(self) -> bool:
        """Whether a token goes to another machine where everybody on the way can read it."""
        parts = urlsplit(self.url)
        return bool(self.token) and parts.scheme == "http" and not str(parts.hostname).startswith(_LOOPBACK)

    def json(self, method: str, path: str, *, again: bool | None = None, **request: Any) -> Any:
        """The JSON of an answer. Raises SemdbError."""
        response = self.ask(method, path, again=again, **request)
        try:
            return response.json()
        except ValueError:
            raise DatabaseUnavailableError(f"{self.url}: what answers there is no service of semdb") from None

    def ask(
        self,
        method: str,
        path: str,
        *,
        again: bool | None = None,
        expected: tuple[int, ...] = (),
        body: Callable[[], Iterator[bytes]] | None = None,
        **request: Any,
    ) -> httpx.Response:
        """An answer of status 2xx, or one that is `expected`. `again` says that asking twice does no harm (GET).

        `body` makes what is sent, for each time anew. Raises SemdbError.
        """
        if not path.startswith("/"):  # behind the address it could name another host, which would get the token
            raise UsageError(f"{for_terminal(path)!r}: a path of the service begins with a slash, as /v1/maps")
        harmless = again if again is not None else method == "GET"
        ends = time.monotonic() + self.patience_s
        for number in range(self.retries + 1):
            response, failed = self._once(method, path, body, request)
            if response is not None and (response.is_success or response.status_code in expected):
                return response
            wait = self._wait(response, failed, number, harmless)
            if wait is None or number == self.retries or time.monotonic() + wait > ends:
                break
            time.sleep(wait)
        if response is not None:
            raise error_of(response, self.url)
        raise DatabaseUnavailableError(self._lost(failed, harmless)) from failed

    def _once(
        self, method: str, path: str, body: Callable[[], Iterator[bytes]] | None, request: Mapping[str, Any]
    ) -> tuple[httpx.Response | None, Exception | None]:
        httpx = load_httpx()
        given = dict(request) if body is None else {**request, "content": body()}
        try:
            return self._client().request(method, f"{self.url}{path}", **given), None
        except (httpx.TransportError, httpx.DecodingError) as error:
            return None, error
        except httpx.InvalidURL as error:
            raise UsageError(f"{for_terminal(self.url)}: {error}") from None

    def _wait(
        self, response: httpx.Response | None, failed: Exception | None, number: int, harmless: bool
    ) -> float | None:
        """Seconds to wait before it is asked again; None where it is not."""
        httpx = load_httpx()
        backoff: float = min(LONGEST_WAIT_S, FIRST_WAIT_S * 2**number) * random.uniform(0.5, 1.0)
        if response is None:
            never_sent = isinstance(failed, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout)
            return backoff if harmless or never_sent else None
        if response.status_code not in (AGAIN if harmless else NOT_DONE) or kind_of(response) in FOR_GOOD:
            return None
        said = _retry_after(response.headers.get("retry-after"))
        return backoff if said is None else said + backoff / 4  # not all at the same moment

    def _lost(self, failed: Exception | None, harmless: bool) -> str:
        httpx = load_httpx()
        why = for_terminal(failed) or type(failed).__name__
        if isinstance(failed, httpx.TimeoutException) and not isinstance(failed, httpx.ConnectTimeout):
            text = f"{self.url}: no answer within {self.timeout_s:g} s (timeout_s=)"
        else:
            text = f"{self.url}: the service does not answer: {why}"
        if not harmless and not isinstance(failed, httpx.ConnectError | httpx.ConnectTimeout):
            text += "; whether it was done is not known: look before asking again"
        return text

    def _client(self) -> httpx.Client:
        with self._turn:
            if self._closed:
                raise UsageError("this connection is closed: open another one with semdb.connect")
            found = self._clients.get(os.getpid())
            if found is None:
                httpx = load_httpx()
                headers = {} if self.token is None else {"Authorization": f"Bearer {self.token}"}
                found = httpx.Client(
                    headers=headers,
                    timeout=httpx.Timeout(self.timeout_s, connect=min(CONNECT_S, self.timeout_s)),
                    limits=httpx.Limits(max_connections=MOST_CONNECTIONS, max_keepalive_connections=MOST_CONNECTIONS),
                    transport=self.handler,
                )
                self._clients[os.getpid()] = found
            return found

    def close(self) -> None:
        """Lets go of the connections of this process."""
        with self._turn:
            self._closed = True
            found = self._clients.pop(os.getpid(), None)
        if found is not None:
            with contextlib.suppress(Exception):
                found.close()


def _retry_after(text: str | None) -> float | None:
    """Seconds of a header Retry-After, a number or a date; None for what is neither."""
    if text is None:
        return None
    if text.strip().isdecimal():
        return float(text)
    try:
        moment = email.utils.parsedate_to_datetime(text)
    except (TypeError, ValueError):
        return None
    return max(0.0, moment.timestamp() - time.time())
