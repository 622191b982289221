"""MariaDB servers that a test kills and starts again: a fixed port and account, single or in a Galera cluster."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pymysql
import pytest
from sqlalchemy.engine import URL

from tests.mariadb import SETTINGS, MariaDBError, _die_with_parent, _install, _parent, _server_user, connect
from tests.services import free_port

PASSWORD = "only-for-tests"
PROVIDER = Path("/usr/lib/galera/libgalera_smm.so")


class Server:
    """One mariadbd with a data directory of its own. `name` is the schema that tests use."""

    def __init__(self, folder: Path, options: Sequence[str] = (), install_options: Sequence[str] = ()) -> None:
        self.folder, self.options = folder, list(options)
        self.port = free_port()
        self.process: subprocess.Popen[bytes] | None = None
        self.admin = URL.create("mysql+pymysql", "semdb_test", PASSWORD, "127.0.0.1", self.port)
        program = shutil.which("mariadbd", path="/usr/sbin:/usr/bin:/usr/local/sbin")
        install = shutil.which("mariadb-install-db")
        if program is None or install is None:
            raise MariaDBError("no mariadbd or no mariadb-install-db here: scripts/install-services.sh installs them")
        self._program, self._user = program, _server_user()
        for part in ("", "data", "tmp"):
            (folder / part).mkdir(exist_ok=True)
            if self._user is not None:
                shutil.chown(folder / part, self._user, self._user)
        folder.chmod(0o755)
        account = "'semdb_test'@'127.0.0.1'"
        (folder / "init.sql").write_text(
            f"CREATE OR REPLACE USER {account} IDENTIFIED BY '{PASSWORD}';\n"
            f"GRANT ALL ON *.* TO {account} WITH GRANT OPTION;\n"
        )
        _install(folder, install, self._user, install_options)

    def launch(self, *options: str) -> None:
        """Starts the process; `wait` says when it answers."""
        files = {name: self.folder / name for name in ("data", "tmp", "socket", "pid", "error.log", "init.sql")}
        self.process = subprocess.Popen(
            [
                self._program,
                *SETTINGS,
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

    def wait(self, seconds: float = 60.0) -> None:
        """Returns when the server answers. Raises MariaDBError with the end of its log when it does not."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and self.process is not None and self.process.poll() is None:
            with contextlib.suppress(pymysql.err.MySQLError):
                connect(self.admin).close()
                return
            time.sleep(0.05)
        log = self.folder / "error.log"
        raise MariaDBError(
            f"the server did not start: {log.read_text(errors='replace')[-1500:] if log.exists() else ''}"
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

    def execute(self, *statements: str) -> list[tuple[object, ...]]:
        """Runs statements as the administrator. Returns the rows of the last one."""
        with contextlib.closing(connect(self.admin)) as connection, connection.cursor() as cursor:
            for statement in statements:
                cursor.execute(statement)
            connection.commit()
            return [tuple(row) for row in cursor.fetchall()]

    def url(self, schema: str = "semdb", query: str = "") -> str:
        return self.admin.set(database=schema).render_as_string(hide_password=False) + query

    def make_schema(self, schema: str = "semdb") -> None:
        self.execute(f"CREATE DATABASE IF NOT EXISTS {schema} CHARACTER SET utf8mb4 COLLATE utf8mb4_bin")


@contextlib.contextmanager
def server(*options: str, install_options: Sequence[str] = ()) -> Iterator[Server]:
    """A server that runs, with an empty schema ``semdb``; gone in the end."""
    with server_folder() as folder:
        made = Server(folder, [*options, f"--init-file={folder / 'init.sql'}"], install_options)
        try:
            made.start()
            made.make_schema()
            yield made
        finally:
            made.kill()


@contextlib.contextmanager
def server_folder() -> Iterator[Path]:
    """A folder that the servers' user may enter."""
    folder = Path(tempfile.mkdtemp(prefix="semdb-server-", dir=_parent()))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class Cluster:
    """Three Galera nodes on loopback."""

    def __init__(self, folder: Path) -> None:
        if not PROVIDER.exists():
            pytest.skip("no Galera here (galera-4): scripts/install-services.sh installs it")
        self.nodes: list[Server] = []
        group = [free_port() for _ in range(3)]
        self.address = "gcomm://" + ",".join(f"127.0.0.1:{port}" for port in group)
        folder.chmod(0o755)
        for number, port in enumerate(group):
            name = f"node{number}"
            transfer = free_port()
            provider = (
                f"base_port={port};gmcast.listen_addr=tcp://127.0.0.1:{port};ist.recv_addr=127.0.0.1:{free_port()}"
            )
            provider += ";gcache.size=32M"
            options = [
                "--performance-schema=on",  # without it galera-4 26.4 cannot start its threads
                "--binlog-format=ROW",
                "--innodb-autoinc-lock-mode=2",
                "--wsrep-on=ON",
                f"--wsrep-provider={PROVIDER}",
                f"--wsrep-provider-options={provider}",
                "--wsrep-cluster-name=semdb_tests",
                f"--wsrep-node-name={name}",
                f"--wsrep-node-address=127.0.0.1:{port}",
                "--wsrep-sst-method=rsync",
                f"--wsrep-sst-receive-address=127.0.0.1:{transfer}",
            ]
            self.nodes.append(Server(folder / name, options))

    def start(self) -> None:
        first, *others = self.nodes
        init = f"--init-file={first.folder / 'init.sql'}"
        first.start("--wsrep-new-cluster", "--wsrep-cluster-address=gcomm://", init)
        for node in others:
            self.rejoin(node)

    def rejoin(self, node: Server) -> None:
        """Starts a node, which takes the state of the others; returns when it is one of them."""
        node.start(f"--wsrep-cluster-address={self.address}")
        deadline = time.monotonic() + 60
        while node.execute("SHOW STATUS LIKE 'wsrep_local_state_comment'")[0][1] != "Synced":
            if time.monotonic() > deadline:
                raise MariaDBError("the node did not become one of the cluster")
            time.sleep(0.1)

    def url(self, first: int = 0) -> str:
        """The URL with all nodes, beginning with one."""
        order = [self.nodes[(first + turn) % len(self.nodes)] for turn in range(len(self.nodes))]
        hosts = ",".join(f"127.0.0.1:{node.port}" for node in order)
        return f"mysql+pymysql://semdb_test:{PASSWORD}@{hosts}/semdb"

    def kill(self) -> None:
        for node in self.nodes:
            node.kill()


@contextlib.contextmanager
def cluster() -> Iterator[Cluster]:
    """A cluster that runs, with an empty schema ``semdb``."""
    with server_folder() as folder:
        made = Cluster(folder)
        try:
            made.start()
            made.nodes[0].make_schema()
            yield made
        finally:
            made.kill()
