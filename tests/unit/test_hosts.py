"""Several hosts in a database URL."""

from __future__ import annotations

import re
from typing import Any

import pymysql
import pytest

from semdb.database.engine import parse_url, safe_url
from semdb.database.hosts import Failover
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
    monkeypatch.setattr("semdb.database.hosts._check_ready", lambda _connection: None)
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
