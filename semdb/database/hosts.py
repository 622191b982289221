"""Several hosts in one URL: nodes of a cluster, tried one after the other until one takes connections."""

from __future__ import annotations

import re
from typing import Any

import pymysql
from sqlalchemy import URL

from semdb.errors import UsageError

HOSTS = "hosts"  # query parameter that holds the hosts after the first
NOT_READY = 1047
_NETLOC = re.compile(r"(?P<head>[\w+]+://(?:[^@]*@)?)(?P<hosts>[^/?]+)(?P<tail>.*)", re.DOTALL)
_SERVER = re.compile(r"(?:mysql|mariadb)\b[\w+]*://(?P<authority>[^/?]*)(?P<tail>.*)", re.DOTALL)
_HOST = re.compile(r"(?P<name>\[[^\[\]]+\]|[^:\[\]]+)(?::(?P<port>[0-9]+))?")


def split_hosts(url: str) -> str:
    """`url` with its first host alone, the others in the query, so that it is a URL as any other.

    Raises UsageError, which shows nothing of `url`, where a character of the password could also end it.
    """
    _check_escapes(url)
    found = _NETLOC.fullmatch(url)
    if found is None or "," not in found["hosts"]:
        return url
    first, *others = found["hosts"].split(",")
    if not first or not all(others):
        raise UsageError("the list of hosts in the database URL has an empty place: HOST1:PORT1,HOST2:PORT2")
    separator = "&" if "?" in found["tail"] else "?"
    return f"{found['head']}{first}{found['tail']}{separator}{HOSTS}={','.join(others)}"


def _check_escapes(url: str) -> None:
    """One @, and before any / and ?: else a part of a password could be taken for a host, which messages show."""
    found = _SERVER.fullmatch(url)
    if found is not None and ("@" in found["tail"] or found["authority"].count("@") > 1):
        raise UsageError(
            "the database URL can be read in several ways: write each @ of user, password, schema and parameters as "
            "%40, and each / and ? of user and password as %2F and %3F"
        )


def join_hosts(text: str, url: URL) -> str:
    """The rendered `text` of `url` as a person writes it."""
    others = url.query.get(HOSTS)
    if not isinstance(others, str) or not url.host:
        return text
    shown = url.difference_update_query([HOSTS]).render_as_string(hide_password=True)
    found = _NETLOC.fullmatch(shown)
    return text if found is None else f"{found['head']}{found['hosts']},{others}{found['tail']}"


class Failover:
    """Connects to the host that answered last, else to the next that does."""

    def __init__(self, url: URL) -> None:
        """Raises UsageError for a host or port that is none."""
        others = url.query.get(HOSTS, "")
        self._hosts = [(url.host or "localhost", url.port or 3306)]
        self._hosts += [_host(text) for text in str(others).split(",") if text]
        self._first = 0

    def connect(self, dialect: Any, parameters: dict[str, Any]) -> Any:
        """A connection of the driver. Raises the driver's error of the last host when none answers."""
        count = len(self._hosts)
        for turn in range(count):
            position = (self._first + turn) % count
            host, port = self._hosts[position]
            try:
                connection = dialect.connect(**{**parameters, "host": host, "port": port})
                if count > 1:
                    _check_ready(connection)
            except pymysql.err.OperationalError:
                if turn == count - 1:
                    raise
                continue
            self._first = position
            return connection
        raise AssertionError("unreachable")


def _check_ready(connection: Any) -> None:
    """Raises the driver's error for a node that is not part of its cluster now: it takes connections all the same.

    A server that is none of a Galera cluster passes: MariaDB calls it not ready, too, but does not replicate by it.
    """
    with connection.cursor() as cursor:
        cursor.execute("SHOW GLOBAL VARIABLES LIKE 'wsrep_on'")
        used = cursor.fetchone()
        cursor.execute("SHOW STATUS LIKE 'wsrep_ready'")
        ready = cursor.fetchone()
    if used is not None and used[1] == "ON" and ready is not None and ready[1] != "ON":
        connection.close()
        raise pymysql.err.OperationalError(NOT_READY, "the node is not part of its cluster")


def _host(text: str) -> tuple[str, int]:
    found = _HOST.fullmatch(text)
    if found is None:
        raise UsageError(
            f"{text!r} is no HOST:PORT in the list of hosts of the database URL; addresses of IPv6 are in brackets"
        )
    return found["name"].strip("[]"), int(found["port"] or 3306)
