"""Three nodes on loopback that hold the same: a Galera cluster of MariaDB, group replication of MySQL."""

from __future__ import annotations

import contextlib
import secrets
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from tests.mariadb import MARIADB
from tests.mysql import MYSQL
from tests.servers import Server, ServerError, server_folder
from tests.services import free_port

PROVIDER = Path("/usr/lib/galera/libgalera_smm.so")


AnyCluster = TypeVar("AnyCluster", bound="Cluster")


class Cluster:
    """Three nodes, the first of which takes writes."""

    sync: str  # what a session says to see all that the cluster has committed

    def __init__(self) -> None:
        self.nodes: list[Server] = []
        self.password = secrets.token_hex(12)

    def start(self) -> None:
        raise NotImplementedError

    def rejoin(self, node: Server) -> None:
        """Starts a node, which takes the state of the others; returns when it is one of them."""
        raise NotImplementedError

    def url(self, first: int = 0) -> str:
        """The URL with all nodes, beginning with one."""
        order = [*self.nodes[first:], *self.nodes[:first]]
        return order[0].url().replace(f":{order[0].port}/", ":" + ",127.0.0.1:".join(str(n.port) for n in order) + "/")

    def kill(self) -> None:
        for node in self.nodes:
            node.kill()


class Galera(Cluster):
    """Of MariaDB: each node takes writes."""

    sync = "SET SESSION wsrep_sync_wait = 1"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        if not PROVIDER.exists():
            pytest.skip("no Galera here (galera-4): scripts/install-services.sh installs it")
        group = [free_port() for _ in range(3)]
        self.address = "gcomm://" + ",".join(f"127.0.0.1:{port}" for port in group)
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
            self.nodes.append(Server(MARIADB, folder / name, options, password=self.password))

    def start(self) -> None:
        first, *others = self.nodes
        init = f"--init-file={first.folder / 'init.sql'}"
        first.start("--wsrep-new-cluster", "--wsrep-cluster-address=gcomm://", init)
        for node in others:
            self.rejoin(node)

    def rejoin(self, node: Server) -> None:
        node.start(f"--wsrep-cluster-address={self.address}")
        _wait(node, "SHOW STATUS LIKE 'wsrep_local_state_comment'", ("wsrep_local_state_comment", "Synced"))


class Group(Cluster):
    """Of MySQL, with group replication: one node takes writes, the others copy them and elect another."""

    sync = "SET SESSION group_replication_consistency = 'BEFORE'"

    def __init__(self, folder: Path, *options: str) -> None:
        """Raises ServerError where there is no MySQL."""
        super().__init__()
        ports = [free_port() for _ in range(3)]
        seeds = ",".join(f"127.0.0.1:{port}" for port in ports)
        name = str(uuid.uuid4())
        for number, port in enumerate(ports):
            node = Server(MYSQL, folder / f"node{number}", password=self.password)
            node.options = [
                *MYSQL.with_tls,  # nodes do not start without it, though they do not use it among them
                "--performance-schema=ON",  # it has the list of members
                "--performance-schema-instrument=%=OFF",
                # With less a node that is killed has in its binary log what it has lost, and never gets it again.
                "--innodb-flush-log-at-trx-commit=1",
                f"--server-id={number + 1}",
                "--log-bin=changes",
                "--gtid-mode=ON",
                "--enforce-gtid-consistency=ON",
                "--plugin-load-add=group_replication.so",
                f"--loose-group-replication-group-name={name}",
                f"--loose-group-replication-local-address=127.0.0.1:{port}",
                f"--loose-group-replication-group-seeds={seeds}",
                "--loose-group-replication-start-on-boot=OFF",
                "--loose-group-replication-recovery-get-public-key=ON",
                "--report-host=127.0.0.1",
                f"--report-port={node.port}",
                *options,
            ]
            self.nodes.append(node)

    def start(self) -> None:
        for node in self.nodes:
            node.launch(f"--init-file={node.folder / 'init.sql'}")
        for node in self.nodes:
            node.wait()
            node.execute(
                "CHANGE REPLICATION SOURCE TO SOURCE_USER = 'semdb_test', "
                f"SOURCE_PASSWORD = '{self.password}' FOR CHANNEL 'group_replication_recovery'"
            )
        first, *others = self.nodes
        first.execute("SET GLOBAL group_replication_bootstrap_group = ON", "START GROUP_REPLICATION")
        first.execute("SET GLOBAL group_replication_bootstrap_group = OFF")
        for node in others:
            self.join(node)

    def rejoin(self, node: Server) -> None:
        node.start()
        self.join(node)

    def join(self, node: Server) -> None:
        node.execute("START GROUP_REPLICATION")
        state = "SELECT member_state FROM performance_schema.replication_group_members WHERE member_id = @@server_uuid"
        _wait(node, state, ("ONLINE",))

    def elect(self, node: Server) -> None:
        """Makes a node the one that takes writes."""
        node.execute("DO group_replication_set_as_primary(@@server_uuid)")

    def primary(self, seen_by: Server) -> Server | None:
        """The node that takes writes, as another sees it; None while there is none."""
        query = (
            "SELECT member_port FROM performance_schema.replication_group_members "
            "WHERE member_role = 'PRIMARY' AND member_state = 'ONLINE'"
        )
        ports = seen_by.execute(query)
        return next((node for node in self.nodes if ports == [(node.port,)]), None)


def _wait(node: Server, query: str, row: tuple[object, ...]) -> None:
    deadline = time.monotonic() + 60
    while node.execute(query) != [row]:
        if time.monotonic() > deadline:
            raise ServerError("the node did not become one of the cluster")
        time.sleep(0.1)


@contextlib.contextmanager
def galera() -> Iterator[Galera]:
    """A cluster that runs, with an empty schema ``semdb``."""
    with server_folder() as folder:
        folder.chmod(0o755)
        with _started(Galera(folder)) as made:
            yield made


@contextlib.contextmanager
def group(*options: str) -> Iterator[Group]:
    """A group that runs, with an empty schema ``semdb`` and `options` of mysqld for all nodes.

    Raises ServerError where there is no MySQL.
    """
    with server_folder() as folder, _started(Group(folder, *options)) as made:
        yield made


@contextlib.contextmanager
def _started(made: AnyCluster) -> Iterator[AnyCluster]:
    try:
        made.start()
        made.nodes[0].make_schema()
        yield made
    finally:
        made.kill()
