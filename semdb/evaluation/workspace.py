"""A database of an evaluation's own: a temporary SQLite file, or a schema that is made and dropped on the server."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import text
from sqlalchemy.engine import Connection
from sqlalchemy.exc import DBAPIError

from semdb.database import retry, schema
from semdb.database.engine import make_engine, parse_url, safe_url, sqlite_path
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError

_NOT_ALLOWED = {1044, 1142, 1227}  # the account is known and has not the right
PREFIX = "semdb_evaluate_"
_NAME = re.compile(PREFIX + r"([0-9a-f]{8})_(\d+)_(\d+)_[0-9a-f]{6}")
SETTLED_S = 60.0  # a schema younger than this is left alone whatever it looks like


@dataclass(frozen=True, slots=True)
class Workspace:
    """The schema of one evaluation, as its name tells: which machine and process made it, and when (Unix time)."""

    name: str
    host: str
    pid: int
    made_s: int


def new_name() -> str:
    """``semdb_evaluate_<machine>_<process>_<time>_<random>``."""
    return f"{PREFIX}{this_host()}_{os.getpid()}_{int(time.time())}_{secrets.token_hex(3)}"


def this_host() -> str:
    """Eight hexadecimal digits of this machine and its table of processes: containers have one each."""
    try:
        processes = os.readlink("/proc/self/ns/pid")
    except OSError:
        processes = ""
    return hashlib.sha256(f"{socket.gethostname()} {processes}".encode()).hexdigest()[:8]


def parse_name(name: str) -> Workspace | None:
    """None for a schema that no evaluation made."""
    match = _NAME.fullmatch(name)
    return None if match is None else Workspace(name, match.group(1), int(match.group(2)), int(match.group(3)))


def is_abandoned(
    found: Workspace, *, now_s: float, host: str, in_use: Sequence[str], is_running: Callable[[int], bool]
) -> bool:
    """Whether an evaluation left `found` behind: made on this machine by a process that is gone, and nobody uses it.

    `in_use` are the schemas that the server's connections are in.
    """
    if found.name in in_use or found.host != host or now_s - found.made_s < SETTLED_S:
        return False
    return not is_running(found.pid)


def process_is_running(pid: int) -> bool:
    """Whether a process of that number is there, whoever owns it."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


@contextlib.contextmanager
def evaluation_store(database_url: str, *, say: Callable[[str], None] | None = None) -> Iterator[Store]:
    """An empty store on the same kind of database as `database_url`, gone at the end. Never the user's own data.

    Schemas that killed evaluations of this machine left behind are dropped; others are named. Raises DatabaseError
    where the account may not create a schema.
    """
    if sqlite_path(parse_url(database_url)) is not None or database_url.startswith("sqlite"):
        with (
            tempfile.TemporaryDirectory(prefix="semdb-evaluate-") as folder,
            open_store(f"sqlite:///{Path(folder) / 'evaluation.sqlite3'}", create=True) as store,
        ):
            yield store
        return
    url = parse_url(database_url)
    for line in drop_abandoned(database_url):
        if say is not None:
            say(line)
    name = new_name()
    _run(database_url, f"CREATE DATABASE {name}")
    try:
        own = url.set(database=name).render_as_string(hide_password=False)
        engine = make_engine(own)
        schema.upgrade(engine)
        engine.dispose()
        with open_store(own) as store:
            yield store
    finally:
        _run(database_url, f"DROP DATABASE {name}")


def drop_abandoned(database_url: str) -> list[str]:
    """Drops what `is_abandoned`; lines about what was dropped, and about old ones of other machines, which stay."""
    engine = make_engine(database_url)
    lines = []
    try:
        with engine.connect() as connection:
            found = [known for known in map(parse_name, _schemas(connection)) if known is not None]
            in_use = _in_use(connection) if found else []
            for known in found:
                age_h = (time.time() - known.made_s) / 3600
                if is_abandoned(
                    known, now_s=time.time(), host=this_host(), in_use=in_use, is_running=process_is_running
                ):
                    connection.execute(text(f"DROP DATABASE IF EXISTS {known.name}"))
                    lines.append(f"dropped {known.name}, which an evaluation that was killed had left behind")
                elif known.host != this_host() and known.name not in in_use and age_h >= 24:
                    lines.append(
                        f"{known.name} was made by an evaluation on another machine {age_h / 24:.0f} days ago and "
                        f"nobody is connected to it; if none runs there: DROP DATABASE {known.name}"
                    )
    except DBAPIError as error:
        raise retry.explain(engine, error) from error
    finally:
        engine.dispose()
    return lines


def _schemas(connection: Connection) -> list[str]:
    query = text("SELECT schema_name FROM information_schema.schemata WHERE schema_name LIKE :like")
    return [str(row[0]) for row in connection.execute(query, {"like": PREFIX.replace("_", r"\_") + "%"})]


def _in_use(connection: Connection) -> list[str]:
    """Schemas of the connections that the account may see: all its own."""
    # Rows show the statements, too. MySQL cannot convert one that holds an image, so that it is asked for bytes.
    connection.execute(text("SET SESSION character_set_results = binary"))
    try:
        schemas = [row[3] for row in connection.execute(text("SHOW PROCESSLIST"))]
    finally:
        connection.execute(text("SET SESSION character_set_results = utf8mb4"))
    return sorted({bytes(schema).decode(errors="replace") for schema in schemas if schema is not None})


def _run(database_url: str, statement: str) -> None:
    engine = make_engine(database_url)
    try:
        with engine.begin() as connection:
            connection.execute(text(statement))
    except DBAPIError as error:
        if retry.error_code(error) not in _NOT_ALLOWED:
            raise retry.explain(engine, error) from error
        raise DatabaseError(
            f"{safe_url(engine.url)}: {statement} was refused ({error.orig}). An evaluation works in a schema of its "
            "own: use an account that may create schemas, or SEMDB_DATABASE_URL=sqlite:///FILE"
        ) from error
    finally:
        engine.dispose()
