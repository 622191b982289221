"""Database servers of the tests' own: on a free loopback port, with a data directory that goes with them.

What is different between MariaDB and MySQL is in `tests.mariadb` and `tests.mysql`. Nothing of an installed server's
own data or settings is touched.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import pymysql
from sqlalchemy.engine import URL, make_url

from tests.services import free_port

START_TIMEOUT_S = 60
ACCOUNT = "'semdb_test'@'127.0.0.1'"
PASSWORD = "only-for-tests"
# What both kinds know by the same name; what they write need not outlive them.
SETTINGS = (
    "--bind-address=127.0.0.1",
    "--skip-name-resolve",
    "--innodb-flush-log-at-trx-commit=0",
    "--innodb-flush-method=nosync",
    "--innodb-buffer-pool-size=64M",
    "--innodb-lock-wait-timeout=5",
    "--performance-schema=off",
    "--max-allowed-packet=16M",
)


class ServerError(Exception):
    """There is no such server for the tests; the message says what is missing."""


class Kind(Protocol):
    """What is different between servers of different make."""

    name: str
    variable: str  # of the environment: the URL of a server to use instead (`server_for_tests`)
    with_tls: Sequence[str]  # what lets a server encrypt that has a certificate
    first_statement: str  # of the file that makes the account of the tests

    def command(self) -> Sequence[str]:
        """The program with what it is always started with. Raises ServerError where there is none."""

    def user(self) -> str | None:
        """The account that the server runs under; None for the one we are."""

    def make_data(self, folder: Path, options: Sequence[str]) -> None:
        """Fills the empty ``folder/data``; `options` are those of the server that matter to it. Raises ServerError."""


@dataclass
class TestServer:
    """A server and an account on it that may do everything."""

    __test__ = False
    admin: URL
    prefix: str
    kind: str
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

    def execute(self, *statements: str) -> list[tuple[object, ...]]:
        """Runs statements as the administrator. Returns the rows of the last one."""
        with contextlib.closing(connect(self.admin)) as connection, connection.cursor() as cursor:
            for statement in statements:
                cursor.execute(statement)
            connection.commit()
            return [tuple(row) for row in cursor.fetchall()] if statements else []


class Server(TestServer):
    """One server process with a data directory of its own. ``semdb`` is the schema that tests use."""

    def __init__(
        self,
        kind: Kind,
        folder: Path,
        options: Sequence[str] = (),
        *,
        install_options: Sequence[str] = (),
        password: str | None = None,
    ) -> None:
        self.folder, self.options, self.port = folder, list(options), free_port()
        password = password or secrets.token_hex(12)
        url = URL.create("mysql+pymysql", "semdb_test", password, "127.0.0.1", self.port)
        super().__init__(url, "semdb_test", kind.name)
        self.process: subprocess.Popen[bytes] | None = None
        self._command, self._user = kind.command(), kind.user()
        # Servers delete temporary tables that they find at their start: in a shared folder, those of others too.
        for part in ("", "data", "tmp"):
            (folder / part).mkdir(exist_ok=True)
            if self._user is not None:
                shutil.chown(folder / part, self._user, self._user)
        folder.chmod(0o755)
        # The account is made anew: the data may be those of an earlier run.
        (folder / "init.sql").write_text(
            f"{kind.first_statement}DROP USER IF EXISTS {ACCOUNT};\n"
            f"CREATE USER {ACCOUNT} IDENTIFIED BY '{password}';\nGRANT ALL ON *.* TO {ACCOUNT} WITH GRANT OPTION;\n"
        )
        if not any((folder / "data").iterdir()):
            kind.make_data(folder, install_options)

    def launch(self, *options: str) -> None:
        """Starts the process; `wait` says when it answers."""
        files = {name: self.folder / name for name in ("data", "tmp", "socket", "pid", "error.log")}
        self.process = subprocess.Popen(
            [
                *self._command,
                f"--datadir={files['data']}",
                f"--tmpdir={files['tmp']}",
                f"--socket={files['socket']}",
                f"--pid-file={files['pid']}",
                f"--log-error={files['error.log']}",
                f"--port={self.port}",
                *self.options,
                *options,
            ],
            user=self._user,
            group=self._user,
            extra_groups=[] if self._user else None,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=_die_with_parent,  # noqa: PLW1509 (no thread of a test holds a lock here)
        )

    def wait(self, seconds: float = START_TIMEOUT_S) -> None:
        """Returns when the server answers. Raises ServerError with the end of its log when it does not."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and self.process is not None and self.process.poll() is None:
            with contextlib.suppress(pymysql.err.MySQLError):
                connect(self.admin).close()
                return
            time.sleep(0.05)
        log = self.folder / "error.log"
        raise ServerError(
            f"the test server did not start: {log.read_text(errors='replace')[-1500:] if log.exists() else 'no log'}"
        )

    def start(self, *options: str) -> None:
        self.launch(*options)
        self.wait()

    def kill(self) -> None:
        """SIGKILL."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def stop(self) -> None:
        """A clean end."""
        if self.process is not None:
            self.process.terminate()
            self.process.wait()

    def url(self, schema: str = "semdb", query: str = "") -> str:
        return self.admin.set(database=schema).render_as_string(hide_password=False) + query

    def make_schema(self, schema: str = "semdb") -> None:
        self.execute(f"CREATE DATABASE IF NOT EXISTS {schema} CHARACTER SET utf8mb4 COLLATE utf8mb4_bin")


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
def server(
    kind: Kind,
    *options: str,
    install_options: Sequence[str] = (),
    password: str | None = None,
    keep: Path | None = None,
) -> Iterator[Server]:
    """A server that runs, with an empty schema ``semdb``, and `options` beside the tests' own; gone in the end.

    With `keep` its data stay in that folder, which is used again when it holds some. A password is made up where none
    is given. Raises ServerError.
    """
    with contextlib.ExitStack() as stack:
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
        folder = keep or stack.enter_context(server_folder())
        options = (*options, f"--init-file={folder / 'init.sql'}")
        made = Server(kind, folder, options, install_options=install_options, password=password)
        try:
            made.start()
            made.make_schema()
            yield made
        finally:
            if keep is None:
                made.kill()  # nothing in it is worth a clean shutdown
            else:
                made.stop()


@contextlib.contextmanager
def server_for_tests(kind: Kind) -> Iterator[TestServer]:
    """The server of a kind for this process: the one that the environment names, or one that is started here."""
    named = os.environ.get(kind.variable)
    if named:
        url = make_url(named)
        yield TestServer(url.set(database=None), url.database or "semdb_test", kind.name)
        return
    with server(kind) as started:
        yield started


@contextlib.contextmanager
def server_folder() -> Iterator[Path]:
    """A folder that the servers' user may enter, which one below pytest's own is not.

    In memory where there is enough of it: making and dropping tables is three times as fast there.
    """
    memory = "/dev/shm"
    roomy = os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > 2**30
    folder = Path(tempfile.mkdtemp(prefix="semdb-server-", dir=memory if roomy else "/tmp"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: a killed test run leaves no server behind
