"""Limits of `semdb sql`: time and memory whatever the statement is, no locks, nothing left behind or still running."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.engine import make_url

from semdb.database import readonly_server, readonly_sqlite, schema
from semdb.database.engine import make_engine
from semdb.database.readonly import run_readonly
from semdb.database.store import open_store
from semdb.errors import DatabaseError, UsageError
from semdb.settings import Settings
from tests.database_samples import fill
from tests.integration.test_readonly import reader_of
from tests.other_user import NOBODY, as_somebody_else, give
from tests.servers import TestServer, connect

OTHER = 65533
# MySQL counts a product of tables without making it.
ENDLESS = "SELECT SUM(a.score * h.score) FROM " + ", ".join(f"objects {name}" for name in "abcdefgh")
ENDED = r"longer than 0\.5 s and was ended: narrow it, or raise SEMDB_SQL_TIME_LIMIT_S$"
ONE_CALL = "SELECT instr(zeroblob(60000000), zeroblob(30000000) || x'01')"  # hours, within one function


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that every account can use, which one below pytest's own is not."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        os.chmod(name, 0o777)
        yield Path(name)


@pytest.fixture
def file(folder: Path) -> Path:
    path = folder / "maps.sqlite3"
    with open_store(f"sqlite:///{path}", create=True) as store:
        fill(store)
    return path


@pytest.fixture
def for_all(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An interpreter, and the program that it is to run, where every account can reach them."""
    if not Path("/usr/bin/python3").exists():
        pytest.skip("no /usr/bin/python3, and other users may not reach the interpreter of the tests")
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        os.chmod(name, 0o755)
        program = Path(shutil.copy(readonly_sqlite._PROGRAM, name))
        monkeypatch.setattr(readonly_sqlite, "_PROGRAM", program)
        monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
        yield


def own(file: Path, limit_s: float = 30.0) -> Settings:
    return Settings(database_url=f"sqlite:///{file}", sql_time_limit_s=limit_s)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def children() -> set[str]:
    """Processes of this one that still run."""
    listed = subprocess.run(
        ["ps", "-o", "pid=,args=", "--ppid", str(os.getpid())], capture_output=True, text=True, check=False
    )
    return {line for line in listed.stdout.splitlines() if "_sqlite_child" in line}


@pytest.mark.parametrize("statement", [ONE_CALL, ENDLESS])
def test_a_statement_ends_in_time_also_within_one_function(file: Path, statement: str) -> None:
    began = time.monotonic()
    with pytest.raises(DatabaseError, match=r"longer than 0\.5 s and was ended.*SEMDB_SQL_TIME_LIMIT_S"):
        run_readonly(own(file, 0.5), statement)
    assert time.monotonic() - began < 8  # without the limit: hours
    assert children() == set()


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT hex(zeroblob(100000000)), hex(zeroblob(100000000)), hex(zeroblob(100000000))",
        "SELECT replace(hex(zeroblob(60000000)), '0', 'aaaaaaaa')",
        "SELECT " + ", ".join(["zeroblob(120000000)"] * 30),
        "SELECT group_concat(hex(zeroblob(1000000))) FROM objects a, objects b, objects c",
    ],
)
def test_memory_is_bounded(file: Path, statement: str) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024  # of children of other tests, too
    with pytest.raises(DatabaseError, match=r"memory that it has|memory: narrow it|too big|out of memory"):
        list(run_readonly(own(file), statement)[1])
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    assert peak < max(before + 1, readonly_sqlite.MEMORY + 2**27)
    assert children() == set()


def test_large_rows_come_one_after_the_other(file: Path) -> None:
    """8 GB in all, of which a process holds one row."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    _, rows = run_readonly(own(file), "SELECT zeroblob(80000000) FROM objects a, objects b LIMIT 100")
    assert sum(len(next(rows)[0]) for _ in range(4)) == 320_000_000
    rows.close()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # KiB
    assert children() == set()


def test_values_come_as_they_are(file: Path) -> None:
    columns, rows = run_readonly(
        own(file), "SELECT NULL, 1 AS a, -9223372036854775808, 0.1, 'ä€🍳', x'00ff', CAST(x'61ff' AS TEXT), 1e999, ''"
    )
    assert columns[1] == "a"
    assert list(rows) == [(None, 1, -(2**63), 0.1, "ä€🍳", b"\x00\xff", "a\\xff", float("inf"), "")]
    _, rows = run_readonly(own(file), "SELECT rgb FROM keyframe_images ORDER BY keyframe_id")
    with closing(sqlite3.connect(file)) as connection:
        assert list(rows) == connection.execute("SELECT rgb FROM keyframe_images ORDER BY keyframe_id").fetchall()


@pytest.mark.parametrize("statement", ["SELECT 1\0", "SELECT '\ud800'", "SELECT 1 FROM", "SELECT 1; SELECT 2"])
def test_statements_that_are_none(file: Path, statement: str) -> None:
    with pytest.raises(DatabaseError, match="the database refused the statement"):
        run_readonly(own(file), statement)


def test_the_process_ends_when_its_client_is_killed(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = (
        "import sys; from semdb.database import readonly_sqlite; from semdb.database.readonly import run_readonly\n"
        "from semdb.settings import Settings\nreadonly_sqlite._SELF_DESTRUCTION_S = 0.5\n"
        f"run_readonly(Settings(database_url={own(file).database_url!r}, sql_time_limit_s=1), sys.argv[1])"
    )
    client = subprocess.Popen([sys.executable, "-c", program, ONE_CALL])
    found: list[str] = []
    deadline = time.monotonic() + 30
    while not found and time.monotonic() < deadline:
        listed = subprocess.run(["pgrep", "-P", str(client.pid)], capture_output=True, text=True, check=False)
        found = listed.stdout.split()
        time.sleep(0.02)
    client.kill()
    client.wait()
    [process] = found
    while Path(f"/proc/{process}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{process}").exists()


def test_an_owner_leaves_nothing_behind(folder: Path, file: Path) -> None:
    _, rows = run_readonly(own(file), "SELECT id FROM objects")
    next(rows)
    with open_store(f"sqlite:///{file}") as store:  # beside a reader
        store.ensure_map("another")
    assert len(list(rows)) > 2
    assert names(folder) == ["maps.sqlite3"]
    with pytest.raises(DatabaseError):
        run_readonly(own(file), "SELECT nothing")
    assert names(folder) == ["maps.sqlite3"]


@pytest.mark.usefixtures("for_all")
@pytest.mark.parametrize("rights", [0o644, 0o666])
def test_another_user_reads_and_does_not_lock_the_owner_out(folder: Path, file: Path, rights: int) -> None:
    """In a folder that everybody can write, with the file of another user, in use and at rest."""
    give(OTHER, file)
    file.chmod(rights)

    def look() -> list[Any]:
        return list(run_readonly(own(file), "SELECT name FROM maps ORDER BY id")[1])

    look()  # imports
    assert as_somebody_else(look, NOBODY) == [("room",)]
    assert names(folder) == ["maps.sqlite3"]

    def write() -> None:
        with open_store(f"sqlite:///{file}") as store:
            store.ensure_map("of the owner")

    as_somebody_else(write, OTHER)
    assert as_somebody_else(look, NOBODY) == [("room",), ("of the owner",)]
    with open_store(f"sqlite:///{file}") as store:  # by root, whose files are the owner's
        store.ensure_map("in use")
        assert len(names(folder)) == 3
        assert as_somebody_else(look, NOBODY) == [("room",), ("of the owner",), ("in use",)]
    assert names(folder) == ["maps.sqlite3"]
    as_somebody_else(write, OTHER)


@pytest.mark.usefixtures("for_all")
def test_a_change_below_a_reader_without_locks_is_told(folder: Path, file: Path) -> None:
    give(OTHER, file)
    file.chmod(0o644)

    def look() -> str:
        _, rows = run_readonly(own(file), "SELECT a.id FROM objects a, objects b, objects c, objects d")
        next(rows)
        os.seteuid(0)
        with closing(sqlite3.connect(file)) as connection:
            connection.execute("UPDATE maps SET name = 'x'")
            connection.commit()
        os.seteuid(NOBODY)
        with pytest.raises(DatabaseError) as caught:
            list(rows)
        return str(caught.value)

    def partly() -> str:
        os.setegid(NOBODY)
        os.seteuid(NOBODY)
        return look()

    assert "was changed while it was read, and rows may be wrong: run the statement again" in as_somebody_else(
        partly, 0
    )


# Servers.


@pytest.fixture
def server(database_server: TestServer, server_url: str) -> Iterator[tuple[TestServer, str, str]]:
    """A server, and the URLs of a database with rows and of its reader."""
    engine = make_engine(server_url)
    schema.upgrade(engine)
    engine.dispose()
    with open_store(server_url) as store:
        fill(store)
    with reader_of(database_server, server_url) as reader:
        yield database_server, server_url, reader


def running(server: TestServer, reader: str) -> list[str]:
    """What connections of the reader do."""
    with closing(connect(server.admin)) as connection, connection.cursor() as cursor:
        cursor.execute("SHOW FULL PROCESSLIST")
        return [str(row[7]) for row in cursor.fetchall() if row[1] == make_url(reader).username and row[7]]


def wait_until_nothing_runs(server: TestServer, reader: str) -> None:
    deadline = time.monotonic() + 10
    while found := running(server, reader):
        assert time.monotonic() < deadline, found
        time.sleep(0.05)


def without_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if a hint had lifted the server's own limit."""
    monkeypatch.setattr(readonly_server, "_limit_time", lambda *_: None)


def test_the_client_ends_a_statement_whose_limit_was_lifted(
    server: tuple[TestServer, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    without_limit(monkeypatch)
    where, url, reader = server
    began = time.monotonic()
    settings = Settings(database_url=url, reader_url=reader, sql_time_limit_s=0.5)
    with pytest.raises(DatabaseError, match=ENDED):
        run_readonly(settings, ENDLESS)
    assert time.monotonic() - began < 8
    wait_until_nothing_runs(where, reader)


@pytest.mark.parametrize("hint", ["MAX_EXECUTION_TIME(3600000)", "SET_VAR(max_execution_time = 0)"])
def test_a_hint_lifts_no_limit(
    mysql_server: TestServer, mysql_url: str, monkeypatch: pytest.MonkeyPatch, hint: str
) -> None:
    """Also where the statement is not looked at."""
    monkeypatch.setattr("semdb.database.readonly._check_statement", lambda *_, **__: None)
    engine = make_engine(mysql_url)
    schema.upgrade(engine)
    engine.dispose()
    with open_store(mysql_url) as store:
        fill(store)
    with reader_of(mysql_server, mysql_url) as reader:
        settings = Settings(database_url=mysql_url, reader_url=reader, sql_time_limit_s=0.5)
        began = time.monotonic()
        with pytest.raises(DatabaseError, match=ENDED):
            run_readonly(settings, ENDLESS.replace("SELECT", f"SELECT /*+ {hint} */"))
        wait_until_nothing_runs(mysql_server, reader)
        with contextlib.suppress(DatabaseError):  # the server ends it with the plan as far as it came
            run_readonly(settings, f"EXPLAIN ANALYZE {ENDLESS}")[1].close()
        wait_until_nothing_runs(mysql_server, reader)
        assert time.monotonic() - began < 20


def test_a_statement_ends_with_its_reader(server: tuple[TestServer, str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    without_limit(monkeypatch)
    where, url, reader = server
    settings = Settings(database_url=url, reader_url=reader, sql_time_limit_s=100)
    many = "SELECT a.id, SLEEP(0) FROM objects a, objects b, objects c, objects d, objects e, objects f, objects g"
    _, rows = run_readonly(settings, many)
    next(rows)
    assert running(where, reader) == [many]
    rows.close()
    wait_until_nothing_runs(where, reader)

    def interrupt() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            run_readonly(settings, ENDLESS)

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    import signal

    before = signal.signal(signal.SIGALRM, stop)  # as Ctrl-C comes, while the driver waits
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.7)
        interrupt()
    finally:
        signal.signal(signal.SIGALRM, before)
    wait_until_nothing_runs(where, reader)


def test_a_server_that_cannot_be_told_is_said(
    server: tuple[TestServer, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second connection leads elsewhere, as through a proxy: nothing is killed there."""
    without_limit(monkeypatch)
    where, url, reader = server
    real = readonly_server._identity
    monkeypatch.setattr(readonly_server, "_identity", lambda connection: (real(connection)[0], ("elsewhere", 1)))
    settings = Settings(database_url=url, reader_url=reader, sql_time_limit_s=0.5)
    monkeypatch.setattr("semdb.database.readonly._READ_GRACE_S", 2)
    with pytest.raises(DatabaseError, match=r"it could not be ended at the server: its connection there is \d+"):
        run_readonly(settings, ENDLESS)
    [left] = running(where, reader)
    assert left == ENDLESS
    with closing(connect(where.admin)) as connection, connection.cursor() as cursor:
        cursor.execute("SHOW PROCESSLIST")
        for row in cursor.fetchall():
            if row[1] == make_url(reader).username:
                cursor.execute(f"KILL {row[0]}")
    wait_until_nothing_runs(where, reader)


def test_locks_and_lifted_limits_are_refused(server: tuple[TestServer, str, str]) -> None:
    _, url, reader = server
    settings = Settings(database_url=url, reader_url=reader)
    for statement in ("SELECT * FROM maps FOR UPDATE", "SELECT * FROM maps LOCK IN SHARE MODE"):
        with pytest.raises(UsageError, match="makes writers wait"):
            run_readonly(settings, statement)
    with pytest.raises(UsageError, match="MAX_EXECUTION_TIME is not allowed"):
        run_readonly(settings, "SELECT /*+ MAX_EXECUTION_TIME(0) */ * FROM maps")
    assert list(run_readonly(settings, "SELECT 'FOR UPDATE', name FROM maps")[1]) == [("FOR UPDATE", "room")]


def test_a_reader_makes_no_writer_wait(server: tuple[TestServer, str, str]) -> None:
    _, url, reader = server
    settings = Settings(database_url=url, reader_url=reader)
    _, rows = run_readonly(settings, "SELECT a.id FROM objects a, objects b, objects c, objects d, objects e")
    next(rows)
    with open_store(url) as store:
        began = time.monotonic()
        assert store.delete_recording(1).keyframes == 5
        assert time.monotonic() - began < 4  # the tests' servers wait 5 s for a lock
    rows.close()
