"""Accounts of a server with the least rights that do: owner (schema), writer (ingest), reader (`semdb sql`)."""

from __future__ import annotations

import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from semdb.database import retry
from semdb.database.engine import make_server_engine, parse_url
from semdb.errors import UsageError

ROLES = ("owner", "writer", "reader")
RIGHTS: Mapping[str, str] = {
    "owner": "SELECT, INSERT, UPDATE, DELETE, CREATE, ALTER, DROP, INDEX, REFERENCES, CREATE VIEW, SHOW VIEW",
    "writer": "SELECT, INSERT, UPDATE, DELETE",
    "reader": "SELECT, SHOW VIEW",
}
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,32}")
_HOST = re.compile(r"[A-Za-z0-9_.:%/-]{1,255}")


@dataclass(frozen=True, slots=True)
class Accounts:
    """The statements that make the accounts, and the URL of each (with its password)."""

    statements: tuple[str, ...]
    urls: Mapping[str, str]  # owner, writer, reader


def plan_accounts(
    url: str,
    *,
    names: Mapping[str, str] | None = None,
    passwords: Mapping[str, str] | None = None,
    host: str = "%",
    roles: Sequence[str] = ROLES,
) -> Accounts:
    """Accounts for the schema of `url`, of all roles or of `roles`; nothing is executed.

    `names` and `passwords` by role; a name that is not given is ``semdb_<role>``, a password is made up. `host` is
    where the accounts may connect from. Raises UsageError for SQLite, which has no accounts, and for impossible names.
    """
    parsed = parse_url(url)
    if parsed.get_backend_name() == "sqlite":
        raise UsageError("SQLite has no accounts: its file's rights decide who may read and write it")
    if not _HOST.fullmatch(host):
        raise UsageError(f"{host!r} is no host for an account")
    schema = parsed.database or ""
    statements = []
    if "owner" in roles:
        statements.append(
            f"CREATE DATABASE IF NOT EXISTS {_identifier(schema)} CHARACTER SET utf8mb4 COLLATE utf8mb4_bin"
        )
    urls: dict[str, str] = {}
    for role in roles:
        name = (names or {}).get(role, f"semdb_{role}")
        password = (passwords or {}).get(role) or secrets.token_urlsafe(18)
        if not _NAME.fullmatch(name):
            raise UsageError(f"{name!r} cannot be the name of an account: 1 to 32 of A-Z a-z 0-9 _ . -")
        account = f"'{name}'@'{host}'"
        statements.append(f"CREATE USER {account} IDENTIFIED BY {_quoted(password)}")
        # _ and % in the schema of a GRANT are patterns
        pattern = _identifier(re.sub(r"([_%])", r"\\\1", schema))
        statements.append(f"GRANT {RIGHTS[role]} ON {pattern}.* TO {account}")
        urls[role] = parsed.set(username=name, password=password).render_as_string(hide_password=False)
    return Accounts(tuple(statements), urls)


def execute(url: str, statements: Sequence[str]) -> None:
    """Run the statements as the account of `url`, which must be allowed to. Raises DatabaseError."""
    parsed = parse_url(url)
    engine = make_server_engine(parsed.set(database=None))  # the schema may be what they make
    try:
        with engine.connect() as connection:
            for statement in statements:
                connection.exec_driver_sql(statement.replace("%", "%%"))
            connection.commit()
    except SQLAlchemyError as error:
        raise retry.explain(engine, error) from error
    finally:
        engine.dispose()


def _identifier(name: str) -> str:
    return "`" + name.replace("`", "``") + "`"


def _quoted(password: str) -> str:
    if "\\" in password or not password.isprintable():
        raise UsageError("a password is made of printable characters and has no backslash")
    return "'" + password.replace("'", "''") + "'"
