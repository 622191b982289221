"""Several hosts in one URL: nodes of a cluster, tried one after the other until one takes connections, and writes.

In a Galera cluster each node that is part of it does. In a group of MySQL one takes writes, the primary, and after its
death the others elect another: a node that takes none is only used, to read, while there is no primary.
"""

from __future__ import annotations

import re
from typing import Any

import pymysql
from sqlalchemy import URL

from semdb.errors import UsageError

HOSTS = "hosts"  # query parameter that holds the hosts after the first
NOT_READY = 1047
READ_ONLY = 1290  # of a server with one of several options: its message names it
# A node that shuts down (1053), turned read-only in the middle (1836), could not commit as it left its group (3100), is
# offline (3032), hands over to another (3098: it takes no cascading foreign keys meanwhile), or is not far enough to be
# read from (3796 to 3799).
_LEFT = frozenset({NOT_READY, 1053, 1836, 3032, 3098, 3100, 3796, 3797, 3798, 3799})
_DENIED = 1142
MEMBERS_TABLE = "performance_schema.replication_group_members"
MEMBERS = f"SELECT member_state, member_id = @@server_uuid FROM {MEMBERS_TABLE}"
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


def is_left(code: int | None, reason: str) -> bool:
    """Whether an error of the server says that this node is of no use now, and another one may be."""
    return code in _LEFT or (code == READ_ONLY and "read-only" in reason)


class Failover:
    """Connects to the host that answered last, else to the next that does; to one that takes writes before others."""

    def __init__(self, url: URL) -> None:
        """Raises UsageError for a host or port that is none."""
        others = url.query.get(HOSTS, "")
        self._hosts = [(url.host or "localhost", url.port or 3306)]
        self._hosts += [_host(text) for text in str(others).split(",") if text]
        self._first = 0

    def connect(self, dialect: Any, parameters: dict[str, Any]) -> Any:
        """A connection of the driver. Raises the driver's error of the last host when none answers."""
        count, failure, reads = len(self._hosts), None, None
        for turn in range(count):
            position = (self._first + turn) % count
            host, port = self._hosts[position]
            try:
                connection = dialect.connect(**{**parameters, "host": host, "port": port})
                writable = count == 1 or _takes_writes(connection)
            except pymysql.err.OperationalError as error:
                failure = error
                continue
            if writable:
                self._first = position
                _close(reads)
                return connection
            if reads is None:
                reads = connection
            else:
                _close(connection)
        if reads is not None:
            return reads
        raise failure or AssertionError("unreachable")


def _takes_writes(connection: Any) -> bool:
    """Whether a node does. Raises the driver's error where it is not part of its cluster now.

    Both take connections all the same. A server that is none of a cluster passes: MariaDB calls it not ready, too, but
    does not replicate by it.
    """
    try:
        with connection.cursor() as cursor:
            variables = "'wsrep_on', 'read_only', 'group_replication_group_name'"
            cursor.execute(f"SHOW GLOBAL VARIABLES WHERE Variable_name IN ({variables})")
            found = dict(cursor.fetchall())
            member = True
            if found.get("wsrep_on") == "ON":
                cursor.execute("SHOW STATUS LIKE 'wsrep_ready'")
                ready = cursor.fetchone()
                member = ready is None or ready[1] == "ON"
            elif found.get("group_replication_group_name"):
                member = _is_online(cursor)
        if not member:
            raise pymysql.err.OperationalError(NOT_READY, "the node is not part of its cluster")
    except pymysql.err.OperationalError:
        _close(connection)
        raise
    return str(found.get("read_only", "OFF")).upper() in ("OFF", "0")


def _is_online(cursor: Any) -> bool:
    """Whether a MySQL server is a member of its group that has all that the others have, as far as we may know."""
    try:
        cursor.execute(MEMBERS)
    except pymysql.err.OperationalError as error:
        if error.args[0] != _DENIED:
            raise
        return True  # docs/scaling.md names the right that this takes
    members = cursor.fetchall()
    return not members or any(own and state == "ONLINE" for state, own in members)


def _close(connection: Any) -> None:
    if connection is not None:
        connection.close()


def _host(text: str) -> tuple[str, int]:
    found = _HOST.fullmatch(text)
    if found is None:
        raise UsageError(
            f"{text!r} is no HOST:PORT in the list of hosts of the database URL; addresses of IPv6 are in brackets"
        )
    return found["name"].strip("[]"), int(found["port"] or 3306)
