"""Fixtures for all tests."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest
from hypothesis import HealthCheck, settings

from tests import compiling
from tests.mariadb import MARIADB
from tests.mysql import MYSQL
from tests.rooms import render
from tests.servers import Kind, ServerError, TestServer, server_for_tests

REPOSITORY = Path(__file__).resolve().parent.parent

# What a developer has set is not what is tested; commands that are cut off hear Ctrl-C, also below `nohup ... &`.
for _name in [name for name in os.environ if name.startswith("SEMDB_") and not name.startswith("SEMDB_TEST_")]:
    del os.environ[_name]
os.environ["SEMDB_CHECK_RECORDINGS"] = "false"  # a second for each ingest; tests of the check say otherwise
signal.signal(signal.SIGINT, signal.default_int_handler)
# how long examples take says more of the machine's load than of the code
settings.register_profile("semdb", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("semdb")
compiling.one_at_a_time()


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder with real recordings and models beside the checkout; skips where it is absent."""
    folder = REPOSITORY.parent / "shared"
    if not (folder / "recordings").is_dir():
        pytest.skip("no ../shared with real recordings and models beside the checkout")
    return folder


@pytest.fixture(scope="session")
def mariadb_server() -> Iterator[TestServer]:
    """A MariaDB of the tests' own (one per process), or that of SEMDB_TEST_MARIADB_URL; fails without either."""
    with _running(MARIADB) as server:
        yield server


@pytest.fixture(scope="session")
def mysql_server() -> Iterator[TestServer]:
    """A MySQL of the tests' own (one per process), or that of SEMDB_TEST_MYSQL_URL.

    Without either it skips, or fails where SEMDB_TEST_REQUIRE_MYSQL is set.
    """
    with _running(MYSQL) as server:
        yield server


@contextlib.contextmanager
def _running(kind: Kind) -> Iterator[TestServer]:
    with contextlib.ExitStack() as stack:
        try:
            server: TestServer | str = stack.enter_context(server_for_tests(kind))
        except ServerError as error:
            server = str(error)
        yield server if isinstance(server, TestServer) else _give_up(kind, server)


def _give_up(kind: Kind, reason: str) -> NoReturn:
    if kind is MYSQL and os.environ.get("SEMDB_TEST_REQUIRE_MYSQL", "0") in ("", "0"):
        pytest.skip(reason)
    pytest.fail(reason, pytrace=False)


@pytest.fixture(scope="session")
def needs_mysql() -> None:
    """For tests that start MySQL servers of their own."""
    _check(MYSQL)


@pytest.fixture(scope="module", params=[MARIADB, MYSQL], ids=lambda kind: kind.name)
def server_kind(request: pytest.FixtureRequest) -> Kind:
    """Each kind of server in turn, for tests that start their own."""
    kind: Kind = request.param
    _check(kind)
    return kind


def _check(kind: Kind) -> None:
    try:
        kind.command()
        return
    except ServerError as error:
        reason = str(error)
    _give_up(kind, reason)


@pytest.fixture(params=["mariadb", "mysql"])
def database_server(request: pytest.FixtureRequest) -> TestServer:
    """Each server in turn."""
    return request.getfixturevalue(f"{request.param}_server")  # type: ignore[no-any-return]


@pytest.fixture
def server_url(database_server: TestServer) -> Iterator[str]:
    """The URL of a new, empty schema, on each server in turn."""
    with database_server.schema() as url:
        yield url


@pytest.fixture
def mariadb_url(mariadb_server: TestServer) -> Iterator[str]:
    """The URL of a new, empty schema of MariaDB."""
    with mariadb_server.schema() as url:
        yield url


@pytest.fixture
def mysql_url(mysql_server: TestServer) -> Iterator[str]:
    """The URL of a new, empty schema of MySQL."""
    with mysql_server.schema() as url:
        yield url


@pytest.fixture
def any_server_url(request: pytest.FixtureRequest) -> str:
    """The URL of a new, empty schema of MySQL, or of MariaDB where there is no MySQL."""
    try:
        found = bool(os.environ.get(MYSQL.variable) or MYSQL.command())
    except ServerError:
        found = False
    return str(request.getfixturevalue("mysql_url" if found else "mariadb_url"))


@pytest.fixture(params=["sqlite", "mariadb", "mysql"])
def empty_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of a database without a schema, on each server in turn."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'semdb.sqlite3'}"
    return str(request.getfixturevalue(f"{request.param}_url"))


@pytest.fixture
def server_of_url(request: pytest.FixtureRequest, empty_url: str) -> TestServer | None:
    """The server that `empty_url` is on; None for SQLite."""
    kind = request.node.callspec.params["empty_url"]
    return None if kind == "sqlite" else request.getfixturevalue(f"{kind}_server")


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered recording of 24 frames, 320x240."""
    return render(tmp_path_factory.mktemp("rendered") / "room")
