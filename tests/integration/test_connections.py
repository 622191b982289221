"""Databases that cannot be used say so, without the password, and transactions that may be repeated are."""

from __future__ import annotations

import socket
import threading
import time
from itertools import pairwise
from pathlib import Path

import pymysql
import pytest
from sqlalchemy import Connection, text
from sqlalchemy.exc import OperationalError

import semdb.database.engine
from semdb.database import retry, schema
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError, UsageError
from tests.servers import TestServer


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("nonsense", "cannot be read"),
        ("postgresql://localhost/x", "databases of the kind 'postgresql' are not supported"),
        ("sqlite://", "in memory is not supported"),
        ("sqlite:///:memory:", "in memory is not supported"),
        ("mysql+pymysql://me:secret@localhost", "names no schema"),
    ],
)
def test_urls_that_cannot_be_used(url: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        make_engine(url)
    assert "mysql+pymysql://" in str(caught.value)
    assert "secret" not in str(caught.value)


def test_a_server_that_is_not_there() -> None:
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        url = f"mysql+pymysql://me:secret@127.0.0.1:{taken.getsockname()[1]}/semdb"
        with pytest.raises(DatabaseError, match=r"mysql\+pymysql://me:\*\*\*@.*does not answer: check") as caught:
            open_store(url)
    assert "secret" not in str(caught.value)


def test_a_server_that_accepts_and_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semdb.database.engine, "CONNECT_TIMEOUT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        began = time.monotonic()
        with pytest.raises(DatabaseError, match="does not answer"):
            open_store(f"mysql+pymysql://me:secret@127.0.0.1:{silent.getsockname()[1]}/semdb")
        assert time.monotonic() - began < 30  # a limit exists, however slow the machine


def test_a_first_connection_that_is_cut_while_it_is_set_up_is_made_again(
    server_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server has let us in, so it is there."""
    configure, lost = semdb.database.engine._configure_server, []

    def cut_twice(connection: pymysql.Connection, record: object) -> None:
        if len(lost) < 2:
            lost.append(connection)
            connection._sock.shutdown(socket.SHUT_RDWR)
        configure(connection, record)

    monkeypatch.setattr(semdb.database.engine, "_configure_server", cut_twice)
    engine = make_engine(server_url)
    assert retry.read(engine, lambda connection: connection.execute(text("SELECT 5")).scalar()) == 5
    assert len(lost) == 2
    engine.dispose()


def test_a_wrong_password_and_a_wrong_schema(database_server: TestServer) -> None:
    for url in (
        database_server.admin.set(password="wrong-secret", database="mysql"),
        database_server.admin.set(database="no_such_schema"),
    ):
        with pytest.raises(DatabaseError, match="refuses: check user, password and schema") as caught:
            open_store(url.render_as_string(hide_password=False))
        assert str(url.password) not in str(caught.value)


def test_files_that_are_no_database(tmp_path: Path) -> None:
    (tmp_path / "text.sqlite3").write_text("this is no database, however long the text is. " * 100)
    with pytest.raises(DatabaseError, match="is not a database"):
        open_store(f"sqlite:///{tmp_path / 'text.sqlite3'}")
    with pytest.raises(DatabaseError, match="cannot be opened: check that its folder exists"):
        open_store(f"sqlite:///{tmp_path / 'missing' / 'a.sqlite3'}", create=True)


def _lost(code: int) -> OperationalError:
    return OperationalError("SELECT 1", {}, pymysql.err.OperationalError(code, "made up"))


@pytest.mark.parametrize("code", sorted(retry.RETRIED_CODES))
def test_transactions_are_repeated_when_the_server_asks(
    store: Store, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    delays: list[float] = []
    monkeypatch.setattr(retry.time, "sleep", delays.append)
    calls: list[int] = []

    def work(connection: Connection) -> str:
        calls.append(1)
        connection.execute(text("INSERT INTO maps (name) VALUES ('room')"))
        if len(calls) < 4:
            raise _lost(code)
        return "done"

    assert retry.write(store.engine, work) == "done"
    assert len(calls) == 4
    assert [info.name for info in store.maps()] == ["room"]  # earlier attempts left nothing
    assert len(delays) == 3
    assert delays[2] > delays[0]


def test_repeating_ends(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry.time, "sleep", lambda _: None)
    calls: list[int] = []

    def work(_: Connection) -> None:
        calls.append(1)
        raise _lost(1213)

    with pytest.raises(DatabaseError, match="failed 10 times in a row"):
        retry.write(store.engine, work)
    assert len(calls) == retry.ATTEMPTS == 10


@pytest.mark.parametrize(("write", "code", "waits"), [(True, 2013, True), (False, 2013, False), (True, 1213, False)])
def test_a_write_waits_for_a_server_that_starts_again(
    store: Store, monkeypatch: pytest.MonkeyPatch, write: bool, code: int, waits: bool
) -> None:
    """For a minute, with pauses of at most 3 s; what only reads, or meets a server that is there, gives up before."""
    clock = [1000.0]
    monkeypatch.setattr(retry.time, "sleep", lambda seconds: clock.__setitem__(0, clock[0] + seconds))
    monkeypatch.setattr(retry, "_now", lambda: clock[0])
    store.maps()  # it has answered
    calls: list[float] = []

    def work(_: Connection) -> str:
        calls.append(clock[0])
        if clock[0] - 1000.0 < 50.0:
            raise _lost(code)
        return "done"

    run = retry.write if write else retry.read
    if waits:
        assert run(store.engine, work) == "done"
        assert 20 <= len(calls) <= 45
        assert max(b - a for a, b in pairwise(calls)) <= 3.0
        return
    with pytest.raises(DatabaseError, match="failed 10 times in a row"):
        run(store.engine, work)
    assert len(calls) == 10


def test_a_write_waits_a_minute_at_most(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1000.0]
    monkeypatch.setattr(retry.time, "sleep", lambda seconds: clock.__setitem__(0, clock[0] + seconds))
    monkeypatch.setattr(retry, "_now", lambda: clock[0])
    store.maps()

    def work(_: Connection) -> None:
        raise _lost(2013)

    with pytest.raises(DatabaseError, match=r"failed \d\d times in a row"):
        retry.write(store.engine, work)
    assert 60.0 <= clock[0] - 1000.0 <= 64.0


def test_a_refused_statement_is_not_repeated(store: Store) -> None:
    calls: list[int] = []

    def work(connection: Connection) -> None:
        calls.append(1)
        connection.execute(text("SELECT id FROM nowhere"))

    with pytest.raises(DatabaseError, match=r"refused a statement \(.*nowhere"):
        retry.read(store.engine, work)
    assert len(calls) == 1


def test_a_deadlock_is_resolved(server_url: str) -> None:
    """Two transactions lock two rows in opposite order: the server ends one, and it is run again."""
    schema.upgrade(make_engine(server_url))
    with open_store(server_url) as store:
        first, second = store.ensure_map("a"), store.ensure_map("b")
        barrier = threading.Barrier(2, timeout=10)
        calls: list[int] = []
        failures: list[Exception] = []

        def cross(one: int, other: int) -> None:
            def work(connection: Connection) -> None:
                calls.append(1)
                rename = text("UPDATE maps SET name = CONCAT(name, 'x') WHERE id = :id")
                connection.execute(rename, {"id": one})
                if len(calls) <= 2:
                    barrier.wait()
                connection.execute(rename, {"id": other})

            try:
                retry.write(store.engine, work)
            except Exception as error:
                failures.append(error)

        threads = [threading.Thread(target=cross, args=pair) for pair in ((first, second), (second, first))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert failures == []
        assert len(calls) == 3
        assert [info.name for info in store.maps()] == ["axx", "bxx"]


def test_a_killed_connection_is_replaced(server_url: str) -> None:
    schema.upgrade(make_engine(server_url))
    with open_store(server_url) as store:
        calls: list[int] = []

        def work(connection: Connection) -> int:
            calls.append(1)
            if len(calls) == 1:
                own = connection.execute(text("SELECT CONNECTION_ID()")).scalar_one()
                with store.engine.connect() as other:
                    other.execute(text(f"KILL {own}"))
            return int(connection.execute(text("SELECT 42")).scalar_one())

        assert retry.read(store.engine, work) == 42
        assert len(calls) == 2


def test_a_connection_that_the_server_ended_while_nothing_was_asked_is_replaced(server_url: str) -> None:
    """MySQL says so with an error of its own (4031)."""
    engine = make_engine(server_url)
    calls: list[int] = []

    def work(connection: Connection) -> int:
        calls.append(1)
        if len(calls) == 1:
            connection.execute(text("SET SESSION wait_timeout = 1"))
            time.sleep(2.5)
        return int(connection.execute(text("SELECT 42")).scalar_one())

    assert retry.read(engine, work) == 42
    assert len(calls) == 2
    engine.dispose()


def test_sqlite_writers_wait_for_each_other(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with open_store(url, create=True) as one, open_store(url) as other:
        inside, free = threading.Event(), threading.Event()

        def hold(connection: Connection) -> None:
            connection.execute(text("INSERT INTO maps (name) VALUES ('first')"))
            inside.set()
            free.wait(10)

        thread = threading.Thread(target=retry.write, args=(one.engine, hold))
        thread.start()
        inside.wait(10)
        assert other.maps() == []  # readers see the state before, and do not wait
        timer = threading.Timer(0.2, free.set)
        timer.start()
        assert other.ensure_map("second") == 2
        thread.join()
        assert [info.name for info in other.maps()] == ["first", "second"]
