"""Several hosts in a database URL."""

from __future__ import annotations

import contextlib
import re
from types import SimpleNamespace
from typing import Any

import pymysql
import pytest

from semdb.database.engine import parse_url, safe_url
from semdb.database.hosts import Failover, is_left
from semdb.errors import UsageError

URL = "mysql+pymysql://me:se%40cret@one:3307,two,three:3309/room"


def test_a_list_of_hosts_is_read_and_shown_without_the_password() -> None:
    url = parse_url(URL)
    assert (url.host, url.port, url.database, url.password) == ("one", 3307, "room", "se@cret")
    assert safe_url(url) == "mysql+pymysql://me:***@one:3307,two,three:3309/room"
    again = parse_url(url.render_as_string(hide_password=False))
    assert again == url


def test_a_list_of_hosts_with_parameters() -> None:
    url = parse_url("mysql://me@one,two:3308/room?ssl_mode=REQUIRED")
    assert url.query["ssl_mode"] == "REQUIRED"
    assert "one,two:3308/room" in safe_url(url)


def test_a_list_of_addresses_of_ipv6() -> None:
    text = "mysql+pymysql://me:secret@[::1]:3306,[::1]:3307,[fe80::2],four/room"
    url = parse_url(text)
    assert safe_url(url) == text.replace("secret", "***")
    assert parse_url(url.render_as_string(hide_password=False)) == url
    assert Failover(url)._hosts == [("::1", 3306), ("::1", 3307), ("fe80::2", 3306), ("four", 3306)]


def test_a_schema_with_the_name_of_a_host() -> None:
    assert safe_url(parse_url("mysql://me@one,two/someone")) == "mysql+pymysql://me@one,two/someone"


@pytest.mark.parametrize("hosts", ["one,,two", ",one", "one,"])
def test_an_empty_place_is_refused(hosts: str) -> None:
    with pytest.raises(UsageError, match="empty place"):
        parse_url(f"mysql://me@{hosts}/room")


@pytest.mark.parametrize("host", ["two:x", "two:", ":3306", "::1", "[::1", "[::1]x", "[]"])
def test_a_host_or_port_that_is_none_is_refused(host: str) -> None:
    with pytest.raises(UsageError, match=rf"'{re.escape(host)}' is no HOST:PORT"):
        Failover(parse_url(f"mysql://me@one,{host}/room"))


class Nodes:
    """A driver for which some hosts are down."""

    def __init__(self) -> None:
        self.down: set[str] = set()
        self.tried: list[tuple[str, int]] = []

    def connect(self, **parameters: Any) -> str:
        self.tried.append((parameters["host"], parameters["port"]))
        if parameters["host"] in self.down:
            raise pymysql.err.OperationalError(2003, "down")
        return str(parameters["host"])


def test_the_next_host_is_taken_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("semdb.database.hosts._takes_writes", lambda _connection: True)
    nodes, failover = Nodes(), Failover(parse_url(URL))
    assert failover.connect(nodes, {"user": "me"}) == "one"
    nodes.down = {"one", "two"}
    assert failover.connect(nodes, {}) == "three"
    nodes.down, nodes.tried = set(), []
    assert failover.connect(nodes, {}) == "three"
    assert nodes.tried == [("three", 3309)]
    nodes.down = {"one", "two", "three"}
    with pytest.raises(pymysql.err.OperationalError, match="down"):
        failover.connect(nodes, {})
    assert nodes.tried[1:] == [("three", 3309), ("one", 3307), ("two", 3306)]


class Node:
    """A connection to a server with these variables, status and members of its group; a cursor of itself."""

    def __init__(self, name: str, variables: dict[str, str], ready: str = "ON", members: Any = ()) -> None:
        self.name, self.closed, self._members, self._rows = name, False, members, []
        self._answers = {"SHOW GLOBAL": list(variables.items()), "SHOW STATUS": [("wsrep_ready", ready)]}

    def cursor(self) -> Any:
        return contextlib.nullcontext(self)

    def execute(self, statement: str) -> None:
        if statement.startswith("SELECT") and self._members is None:
            raise pymysql.err.OperationalError(1142, "denied")
        self._rows = self._answers.get(" ".join(statement.split()[:2]), self._members)

    def fetchall(self) -> Any:
        return self._rows

    def fetchone(self) -> Any:
        return self._rows[0]

    def close(self) -> None:
        self.closed = True


GROUP = {"group_replication_group_name": "g", "read_only": "OFF"}
REPLICA = {"group_replication_group_name": "g", "read_only": "ON"}
ONLINE, RECOVERING = [("ONLINE", 0), ("ONLINE", 1)], [("ONLINE", 0), ("RECOVERING", 1)]


@pytest.mark.parametrize(
    ("nodes", "taken"),
    [
        ([Node("one", {"read_only": "ON"}), Node("two", {"read_only": "OFF"}), None], "two"),
        ([None, Node("two", {"read_only": "ON"}), Node("three", {"read_only": "ON"})], "two"),  # to read
        ([Node("one", REPLICA, members=ONLINE), Node("two", GROUP, members=ONLINE), None], "two"),
        ([Node("one", GROUP, members=[("OFFLINE", 0)]), Node("two", REPLICA, members=ONLINE), None], "two"),
        ([Node("one", REPLICA, members=RECOVERING), Node("two", REPLICA, members=ONLINE), None], "two"),
        ([Node("one", GROUP, members=None), None, None], "one"),  # the account may not see who is a member
        ([Node("one", GROUP, members=()), None, None], "one"),  # nor anybody: the server keeps no list
        ([Node("one", {"wsrep_on": "ON"}, "OFF"), Node("two", {"wsrep_on": "ON"}), None], "two"),
        ([Node("one", {"wsrep_on": "OFF"}, "OFF"), None, None], "one"),
    ],
)
def test_a_node_that_takes_writes_is_preferred_and_one_outside_is_left(nodes: list[Node | None], taken: str) -> None:
    def connect(host: str, **_: Any) -> Node:
        node = nodes[["one", "two", "three"].index(host)]
        if node is None:
            raise pymysql.err.OperationalError(2003, "down")
        return node

    driver = SimpleNamespace(connect=connect)
    found = Failover(parse_url(URL)).connect(driver, {})
    assert found.name == taken
    assert [node.name for node in nodes if node is not None and not node.closed] == [taken]


def test_no_node_is_part_of_the_cluster() -> None:
    driver = SimpleNamespace(connect=lambda **_: Node("any", GROUP, members=[("ERROR", 1)]))
    with pytest.raises(pymysql.err.OperationalError, match="not part of its cluster"):
        Failover(parse_url(URL)).connect(driver, {})


@pytest.mark.parametrize(
    ("code", "reason", "left"),
    [
        (1290, "The MySQL server is running with the --super-read-only option so it cannot ...", True),
        (1290, "The MySQL server is running with the --secure-file-priv option so it cannot ...", False),
        (1836, "Running in read-only mode", True),
        (3100, "Error on observer while running replication hook 'before_commit'.", True),
        (1213, "Deadlock found", False),
        (None, "", False),
    ],
)
def test_errors_that_say_to_take_another_node(code: int | None, reason: str, left: bool) -> None:
    assert is_left(code, reason) == left
