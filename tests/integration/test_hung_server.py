"""A server that hangs: its machine answers, it never does. In a bounded time it is left for another, or given up."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Connection, Engine, text

import semdb.database.engine
from semdb.database import retry
from semdb.database.engine import make_engine
from semdb.errors import DatabaseUnavailableError
from tests import servers

BOUND_S = 40.0  # limits below add up to a few seconds; without them it would be for ever
PORT = text("SELECT @@port")
WORD = "of-both-servers"


@pytest.fixture(scope="module")
def two_servers(server_kind: servers.Kind) -> Iterator[list[servers.Server]]:
    with servers.server(server_kind, password=WORD) as one, servers.server(server_kind, password=WORD) as other:
        for server in (one, other):
            server.execute("CREATE TABLE semdb.blobs (id INT PRIMARY KEY AUTO_INCREMENT, data LONGBLOB)")
        yield [one, other]


@pytest.fixture(autouse=True)
def short_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semdb.database.engine, "CONNECT_TIMEOUT_S", 1)
    monkeypatch.setattr(semdb.database.engine, "READ_TIMEOUT_S", 1)
    monkeypatch.setattr(retry, "ATTEMPTS", 3)


def is_stopped(stat: Path) -> bool:
    return stat.read_text().rpartition(") ")[2].startswith("T")


@pytest.fixture
def hang(two_servers: list[servers.Server]) -> Iterator[Callable[[], None]]:
    """Stops the first server; it goes on in the end."""
    process = two_servers[0].process
    assert process is not None

    def stop() -> None:
        os.kill(process.pid, signal.SIGSTOP)
        threads = Path(f"/proc/{process.pid}/task")
        deadline = time.monotonic() + 10
        while any(not is_stopped(thread / "stat") for thread in threads.iterdir()) and time.monotonic() < deadline:
            time.sleep(0.01)  # one that still runs may answer

    yield stop
    os.kill(process.pid, signal.SIGCONT)


@pytest.fixture
def engine(two_servers: list[servers.Server]) -> Iterator[Engine]:
    """Of the first server alone."""
    made = make_engine(two_servers[0].url())
    yield made
    made.dispose()


@pytest.fixture
def both(two_servers: list[servers.Server]) -> Iterator[Engine]:
    """Of the first server, and of the second when the first does not answer; no cluster, so both are always ready."""
    one, other = two_servers
    made = make_engine(one.url().replace(f":{one.port}/", f":{one.port},127.0.0.1:{other.port}/"))
    yield made
    made.dispose()


@pytest.fixture(autouse=True)
def in_time() -> Iterator[None]:
    began = time.monotonic()
    yield
    assert time.monotonic() - began < BOUND_S


def test_a_transaction_goes_on_at_the_next_host(
    two_servers: list[servers.Server], both: Engine, hang: Callable[[], None]
) -> None:
    ports: list[int] = []

    def work(connection: Connection) -> str:
        ports.append(connection.execute(PORT).scalar_one())
        if len(ports) == 1:
            hang()
        connection.execute(text("INSERT INTO blobs (data) VALUES ('x')"))
        return "done"

    assert retry.write(both, work) == "done"
    assert ports == [server.port for server in two_servers]


def test_what_a_hung_server_does_not_take_is_sent_to_the_next_host(
    two_servers: list[servers.Server], both: Engine, hang: Callable[[], None]
) -> None:
    ports: list[int] = []
    large = bytes(12 * 2**20)  # more than the buffers of the sockets

    def work(connection: Connection) -> int:
        ports.append(connection.execute(PORT).scalar_one())
        if len(ports) == 1:
            hang()
        return connection.execute(text("INSERT INTO blobs (data) VALUES (:data)"), {"data": large}).rowcount

    assert retry.write(both, work) == 1
    assert ports == [server.port for server in two_servers]


def test_a_connection_that_was_kept_is_not_waited_for(
    two_servers: list[servers.Server], both: Engine, hang: Callable[[], None]
) -> None:
    assert retry.read(both, lambda c: c.execute(PORT).scalar_one()) == two_servers[0].port
    hang()
    assert retry.read(both, lambda c: c.execute(PORT).scalar_one()) == two_servers[1].port


def test_the_only_server_is_given_up_and_comes_back(
    two_servers: list[servers.Server], engine: Engine, hang: Callable[[], None]
) -> None:
    assert retry.read(engine, lambda c: c.execute(PORT).scalar_one()) == two_servers[0].port
    hang()
    with pytest.raises(DatabaseUnavailableError, match="failed 3 times in a row: the server is down or overloaded"):
        retry.read(engine, lambda c: c.execute(PORT).scalar_one())
    process = two_servers[0].process
    assert process is not None
    timer = threading.Timer(1.5, os.kill, (process.pid, signal.SIGCONT))
    timer.start()
    assert retry.read(engine, lambda c: c.execute(PORT).scalar_one()) == two_servers[0].port
    timer.join()


def test_what_is_not_run_again_takes_as_long_as_it_takes(engine: Engine) -> None:
    slow = text("SELECT SLEEP(2.5)")
    with engine.connect() as connection:  # as a change of tables does
        assert connection.execute(slow).scalar_one() == 0
    with pytest.raises(DatabaseUnavailableError, match="failed 3 times in a row"):
        retry.read(engine, lambda c: c.execute(slow).scalar_one())
    with engine.connect() as connection:  # the same connection or another: no limit is left over
        assert connection.execute(slow).scalar_one() == 0


def test_the_kernel_asks_whether_the_machine_is_there(engine: Engine) -> None:
    with engine.connect() as connection:
        driver = connection.connection.driver_connection
        assert driver is not None
        assert driver._sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) != 0
        assert driver._sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 30
