"""Fixtures for all tests."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.mariadb import MariaDBError, TestServer, server
from tests.rooms import render

REPOSITORY = Path(__file__).resolve().parent.parent

# What a developer has set is not what is tested; commands that are cut off hear Ctrl-C, also below `nohup ... &`.
for _name in [name for name in os.environ if name.startswith("SEMDB_") and not name.startswith("SEMDB_TEST_")]:
    del os.environ[_name]
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder with real recordings and models beside the checkout; skips where it is absent."""
    folder = REPOSITORY.parent / "shared"
    if not (folder / "recordings").is_dir():
        pytest.skip("no ../shared with real recordings and models beside the checkout")
    return folder


@pytest.fixture(scope="session")
def mariadb_server() -> Iterator[TestServer]:
    """A MariaDB of the tests' own (one per process), or the server of SEMDB_TEST_MYSQL_URL; fails without either."""
    with contextlib.ExitStack() as stack:
        try:
            started = stack.enter_context(server())
        except MariaDBError as error:
            pytest.fail(str(error), pytrace=False)
        yield started


@pytest.fixture
def mariadb_url(mariadb_server: TestServer) -> Iterator[str]:
    """The URL of a new, empty schema."""
    with mariadb_server.schema() as url:
        yield url


@pytest.fixture(params=["sqlite", "mariadb"])
def empty_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of a database without a schema, on each server in turn."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'semdb.sqlite3'}"
    return str(request.getfixturevalue("mariadb_url"))


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered recording of 24 frames, 320x240."""
    return render(tmp_path_factory.mktemp("rendered") / "room")
