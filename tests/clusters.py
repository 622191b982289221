"""Three nodes on loopback that hold the same: a Galera cluster of MariaDB."""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.mariadb import MARIADB
from tests.servers import Server, ServerError, server_folder
from tests.services import free_port

PROVIDER = Path("/usr/lib/galera/libgalera_smm.so")


def url_of(nodes: Sequence[Server]) -> str:
    """The URL of several servers, which have the same account."""
    hosts = ",".join(f"127.0.0.1:{node.port}" for node in nodes)
    return nodes[0].url().replace(f"127.0.0.1:{nodes[0].port}", hosts)


class Cluster:
    """Three Galera nodes on loopback."""

    def __init__(self, folder: Path) -> None:
        if not PROVIDER.exists():
            pytest.skip("no Galera here (galera-4): scripts/install-services.sh installs it")
        self.nodes: list[Server] = []
        password = secrets.token_hex(12)
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
            self.nodes.append(Server(MARIADB, folder / name, options, password=password))

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
                raise ServerError("the node did not become one of the cluster")
            time.sleep(0.1)

    def url(self, first: int = 0) -> str:
        """The URL with all nodes, beginning with one."""
        return url_of([*self.nodes[first:], *self.nodes[:first]])

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
