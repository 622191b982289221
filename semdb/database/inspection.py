"""What a server is and how it is set up, and what of that semdb should not be run with."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import DBAPIError

from semdb.database import retry
from semdb.database.hosts import MEMBERS, MEMBERS_TABLE
from semdb.shown import number

OLDEST = {"MariaDB": (10, 11), "MySQL": (8, 0)}
COLLATION = "utf8mb4_bin"
LEAST_PACKET = 16 * 2**20
LEAST_BUFFER = 128 * 2**20
_VARIABLES = (
    "max_allowed_packet",
    "innodb_buffer_pool_size",
    "innodb_flush_log_at_trx_commit",
    "tx_isolation",
    "transaction_isolation",
    "character_set_connection",
    "innodb_strict_mode",
    "read_only",
    "wsrep_on",
    "group_replication_group_name",
)


@dataclass(frozen=True, slots=True)
class ServerFacts:
    """What a server says of itself, its schema and this connection."""

    version: str
    variables: Mapping[str, str]
    collation: str  # of the schema
    cipher: str  # of this connection; "" without TLS
    local: bool  # whether the connection stays on this machine
    cluster_size: int  # nodes of a Galera cluster, or members of MySQL's group; 0 for a single server

    @property
    def kind(self) -> str:
        """``MariaDB`` or ``MySQL`` (also for what only speaks its protocol)."""
        return "MariaDB" if "mariadb" in self.version.lower() else "MySQL"

    @property
    def numbers(self) -> tuple[int, int]:
        """Major and minor version; (0, 0) where they cannot be told."""
        found = re.match(r"(?:5\.5\.5-)?(\d+)\.(\d+)", self.version)
        return (int(found[1]), int(found[2])) if found else (0, 0)


@dataclass(frozen=True, slots=True)
class Finding:
    """`state` is "ok", "info" or "problem"; `text` says what to change."""

    state: str
    what: str
    text: str


def server_facts(engine: Engine) -> ServerFacts:
    """Asks the server. Raises DatabaseError."""
    names = ", ".join(f"'{name}'" for name in _VARIABLES)

    def work(connection: Connection) -> ServerFacts:
        variables = {
            str(name): str(value)
            for name, value in connection.execute(text(f"SHOW SESSION VARIABLES WHERE Variable_name IN ({names})"))
        }
        cipher = connection.execute(text("SHOW SESSION STATUS LIKE 'Ssl_cipher'")).first()
        return ServerFacts(
            version=str(connection.execute(text("SELECT VERSION()")).scalar()),
            variables=variables,
            collation=collation_of(connection),
            cipher=str(cipher[1]) if cipher is not None else "",
            local=engine.url.host in (None, "localhost", "127.0.0.1", "::1"),
            cluster_size=_cluster_size(connection, variables),
        )

    return retry.read(engine, work)


def _cluster_size(connection: Connection, variables: Mapping[str, str]) -> int:
    if variables.get("wsrep_on") == "ON":
        nodes = connection.execute(text("SHOW STATUS LIKE 'wsrep_cluster_size'")).first()
        return int(nodes[1]) if nodes is not None else 0
    if variables.get("group_replication_group_name"):
        try:
            return [state for state, _ in connection.exec_driver_sql(MEMBERS)].count("ONLINE")
        except DBAPIError:  # not every account may
            return 0
    return 0


def collation_of(connection: Connection) -> str:
    """Which one tables of the schema have that name none."""
    query = "SELECT default_collation_name FROM information_schema.schemata WHERE schema_name = DATABASE()"
    return str(connection.execute(text(query)).scalar())


def judge(facts: ServerFacts) -> Iterator[Finding]:
    """What is right and what to change, one finding for each thing."""
    yield _version(facts)
    packet = int(facts.variables.get("max_allowed_packet", "0"))
    advice = f"; SET GLOBAL max_allowed_packet = {4 * LEAST_PACKET}, and the same in the server's configuration"
    yield _finding(packet >= LEAST_PACKET, "packet size", f"max_allowed_packet {number(packet / 2**20)} MiB", advice)
    isolation = facts.variables.get("transaction_isolation") or facts.variables.get("tx_isolation", "?")
    yield _finding(
        isolation == "REPEATABLE-READ",
        "isolation",
        isolation,
        "; semdb asks each connection for REPEATABLE-READ: what lies between (a proxy?) must not change it",
    )
    right = facts.collation == COLLATION and facts.variables.get("character_set_connection") == "utf8mb4"
    yield _finding(
        right,
        "character set",
        f"schema {facts.collation}, connection {facts.variables.get('character_set_connection', '?')}",
        f"; run `semdb init` as the owner, or ALTER DATABASE ... CHARACTER SET utf8mb4 COLLATE {COLLATION}",
    )
    yield _tls(facts)
    if facts.variables.get("read_only") == "ON":
        yield Finding("problem", "read_only", "the server takes no writes; give the URL of the one that does")
    buffer = int(facts.variables.get("innodb_buffer_pool_size", "0"))
    if 0 < buffer < LEAST_BUFFER:
        size = f"innodb_buffer_pool_size {number(buffer / 2**20)} MiB"
        yield Finding("info", "buffer pool", f"{size}; a quarter of the server's memory or more makes queries faster")
    yield from _cluster(facts)


def _cluster(facts: ServerFacts) -> Iterator[Finding]:
    group = bool(facts.variables.get("group_replication_group_name"))
    if facts.cluster_size:
        kind = "group replication" if group else "Galera"
        state = "info" if facts.cluster_size < 3 else "ok"
        yield Finding(
            state, "cluster", f"{kind}, {facts.cluster_size} nodes" + ("; 3 outlive one" if state != "ok" else "")
        )
    elif group:
        yield Finding(
            "info",
            "cluster",
            "group replication, and this account cannot see whether a node is a member, so that one outside of the "
            f"group may be written to: GRANT SELECT ON {MEMBERS_TABLE} TO it",
        )


def _finding(right: bool, what: str, value: str, advice: str) -> Finding:
    return Finding("ok", what, value) if right else Finding("problem", what, value + advice)


def _version(facts: ServerFacts) -> Finding:
    oldest = OLDEST[facts.kind]
    wanted = ".".join(map(str, oldest))
    if facts.numbers >= oldest:
        return Finding("ok", "version", f"{facts.kind} {facts.version}")
    return Finding("problem", "version", f"{facts.kind} {facts.version} is older than {wanted}: upgrade the server")


def _tls(facts: ServerFacts) -> Finding:
    if facts.cipher:
        return Finding("ok", "TLS", facts.cipher)
    if facts.local:
        return Finding("info", "TLS", "none, on this machine")
    return Finding(
        "problem",
        "TLS",
        "what is sent can be read on the way: give the server a certificate, and add ?ssl_mode=REQUIRED",
    )
