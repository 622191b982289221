"""A MariaDB server of the tests' own: on a free loopback port, with a data directory that goes with it.

`SEMDB_TEST_MYSQL_URL` names a server to use instead (an account that may create schemas and accounts; the schema in
the URL is the prefix of those that the tests make). Nothing of an installed server's own data or settings is touched.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pymysql
from sqlalchemy.engine import URL, make_url

START_TIMEOUT_S = 60
SETTINGS = (
    "--no-defaults",
    "--bind-address=127.0.0.1",
    "--skip-name-resolve",
    "--innodb-flush-log-at-trx-commit=0",
    "--innodb-flush-method=nosync",
    "--sync-frm=0",
    "--innodb-buffer-pool-size=64M",
    "--innodb-log-file-size=16M",
    "--innodb-lock-wait-timeout=5",
    "--performance-schema=off",
    "--max-allowed-packet=16M",
)


class MariaDBError(Exception):
    """There is no server for the tests; the message says what is missing."""


@dataclass
class TestServer:
    """A server and an account on it that may do everything."""

    __test__ = False
    admin: URL
    prefix: str
    _numbers: Iterator[int] = field(default_factory=itertools.count)

    @contextlib.contextmanager
    def schema(self) -> Iterator[str]:
        """The URL of a new, empty schema, dropped in the end."""
        name = f"{self.prefix}_{os.getpid()}_{next(self._numbers)}"
        self.execute(f"CREATE DATABASE `{name}` CHARACTER SET utf8mb4 COLLATE utf8mb4_bin")
        try:
            yield self.admin.set(database=name).render_as_string(hide_password=False)
        finally:
            self.execute(f"DROP DATABASE IF EXISTS `{name}`")

    def execute(self, *statements: str) -> None:
        """Run statements as the administrator."""
        with contextlib.closing(connect(self.admin)) as connection, connection.cursor() as cursor:
            for statement in statements:
                cursor.execute(statement)
            connection.commit()


def connect(url: URL) -> pymysql.Connection:
    """A plain connection to the server of `url`, without a schema."""
    return pymysql.connect(
        host=url.host,
        port=url.port or 3306,
        user=url.username,
        password=str(url.password or ""),
        connect_timeout=5,
        # A test that leaves a transaction open would otherwise hold up the drop of its schema for a day.
        init_command="SET SESSION lock_wait_timeout = 10",
    )


@contextlib.contextmanager
def server() -> Iterator[TestServer]:
    """The server for this process: the one that the environment names, or one that is started and stopped here."""
    named = os.environ.get("SEMDB_TEST_MYSQL_URL")
    if named:
        url = make_url(named)
        yield TestServer(url.set(database=None), url.database or "semdb_test")
        return
    with private_server() as started:
        yield started


@contextlib.contextmanager
def private_server(keep: Path | None = None, options: Sequence[str] = ()) -> Iterator[TestServer]:
    """A server that is started here and stopped in the end, with `options` of mariadbd beside the tests' own.

    With `keep` its data stay in that folder, which is used again when it holds some; else they go with the server.
    """
    programs = {name: shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin") for name in _PROGRAMS}
    missing = [name for name, path in programs.items() if path is None]
    if missing:
        raise MariaDBError(
            f"no {' and no '.join(missing)} here: install mariadb-server (apt-get install mariadb-server), or set "
            "SEMDB_TEST_MYSQL_URL=mysql+pymysql://USER:PASSWORD@HOST/semdb_test"
        )
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
    # Not below pytest's own folder, which is closed to the server's user.
    folder = keep or Path(tempfile.mkdtemp(prefix="semdb-mariadb-", dir=_parent()))
    try:
        paths = (str(programs["mariadbd"]), str(programs["mariadb-install-db"]))
        with _started(folder, *paths, options=options, kept=keep is not None) as started:
            yield started
    finally:
        if keep is None:
            shutil.rmtree(folder, ignore_errors=True)


_PROGRAMS = ("mariadbd", "mariadb-install-db")


@contextlib.contextmanager
def _started(folder: Path, mariadbd: str, install: str, *, options: Sequence[str], kept: bool) -> Iterator[TestServer]:
    password, port = secrets.token_hex(12), _free_port()
    account = "'semdb_test'@'127.0.0.1'"
    # The account is made anew: the data may be those of an earlier run.
    (folder / "init.sql").write_text(
        f"CREATE OR REPLACE USER {account} IDENTIFIED BY '{password}';\n"
        f"GRANT ALL ON *.* TO {account} WITH GRANT OPTION;\n"
    )
    empty = not (folder / "data").exists()
    (folder / "data").mkdir(exist_ok=True)
    # Servers delete temporary tables that they find at their start: in a shared folder, those of others too.
    (folder / "tmp").mkdir(exist_ok=True)
    user = _server_user()
    if user is not None:
        for path in (folder, folder / "init.sql", folder / "data", folder / "tmp"):
            shutil.chown(path, user, user)
    folder.chmod(0o755)
    if empty:
        _install(folder, install, user)
    process = subprocess.Popen(
        [
            mariadbd,
            *SETTINGS,
            *options,
            f"--datadir={folder / 'data'}",
            f"--tmpdir={folder / 'tmp'}",
            f"--socket={folder / 'socket'}",
            f"--pid-file={folder / 'pid'}",
            f"--log-error={folder / 'error.log'}",
            f"--init-file={folder / 'init.sql'}",
            f"--port={port}",
        ],
        user=user,
        group=user,
        extra_groups=[] if user else None,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=_die_with_parent,  # noqa: PLW1509 (the fixture starts before any thread of a test)
    )
    try:
        url = URL.create("mysql+pymysql", "semdb_test", password, "127.0.0.1", port)
        _wait(process, url, folder / "error.log")
        yield TestServer(url, "semdb_test")
    finally:
        if kept:
            process.terminate()
        else:
            process.kill()  # nothing in it is worth a clean shutdown
        process.wait()


def _install(folder: Path, install: str, user: str | None, options: Sequence[str] = ()) -> None:
    as_user = [f"--user={user}"] if user else []
    made = subprocess.run(
        [
            install,
            "--no-defaults",
            f"--datadir={folder / 'data'}",
            f"--tmpdir={folder / 'tmp'}",
            "--skip-test-db",
            *options,
            *as_user,
        ],
        capture_output=True,
        text=True,
        timeout=START_TIMEOUT_S,
        check=False,
    )
    if made.returncode != 0:
        raise MariaDBError(f"mariadb-install-db failed: {(made.stdout + made.stderr)[-500:]}")


def _parent() -> str:
    """Memory where there is enough of it: making and dropping tables is three times as fast there."""
    memory = "/dev/shm"
    if os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > 2**30:
        return memory
    return "/tmp"


def _server_user() -> str | None:
    """The account that the server runs under: not root; None for the one we are."""
    if os.geteuid() != 0:
        return None
    try:
        return pwd.getpwnam("mysql").pw_name
    except KeyError as error:
        raise MariaDBError("there is no user mysql on this machine: install mariadb-server") from error


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: a killed test run leaves no server behind


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def _wait(process: subprocess.Popen[bytes], url: URL, log: Path) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        try:
            connect(url).close()
            return
        except pymysql.err.OperationalError:
            time.sleep(0.05)
    tail = log.read_text(errors="replace")[-800:] if log.exists() else "no log"
    raise MariaDBError(f"the test server did not start: {tail}")
