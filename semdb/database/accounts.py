"""Accounts of a server with the least rights that do: owner (schema), writer (ingest), reader (`semdb sql`)."""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import URL, Connection, Engine
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from semdb.database import retry
from semdb.database.engine import make_server_engine, parse_url
from semdb.database.statement import HIDDEN
from semdb.database.tables import metadata
from semdb.errors import DatabaseError, UsageError

ROLES = ("owner", "writer", "reader")
RIGHTS: Mapping[str, str] = {
    "owner": "SELECT, INSERT, UPDATE, DELETE, CREATE, ALTER, DROP, INDEX, REFERENCES, CREATE VIEW, SHOW VIEW",
    "writer": "SELECT, INSERT, UPDATE, DELETE",
    "reader": "SELECT, SHOW VIEW",
}
VIEWS = (
    *("keyframe_objects", "category_counts", "recording_summary", "covisible_objects", "keypoint_counts"),
    *("keyframe_links", "keyframe_quality", "landmark_list", "landmark_relations_named", "landmark_visit_list"),
    "recording_pose_errors",
)
READABLE = ("alembic_version", *sorted(set(metadata.tables) - set(HIDDEN)), *VIEWS)
"""What the reader may read: all but the tokens and jobs of the service."""
_CANNOT_USER = 1396
_LONGEST_SCHEMA = 32 - len("_writer")  # in names of accounts, of which MySQL takes 32 characters
_CREATED = re.compile(r"CREATE USER (\S+) ")
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,32}")
_HOST = re.compile(r"[A-Za-z0-9_.:%/-]{1,255}")


@dataclass(frozen=True, slots=True)
class Accounts:
    """The statements that make the accounts, or give them new passwords, and the URL of each (with its password)."""

    statements: tuple[str, ...]
    urls: Mapping[str, str]  # owner, writer, reader


def plan_accounts(
    url: str,
    *,
    names: Mapping[str, str] | None = None,
    passwords: Mapping[str, str] | None = None,
    host: str = "%",
    roles: Sequence[str] = ROLES,
    rotate: bool = False,
    grants: bool = False,
) -> Accounts:
    """Accounts for the schema of `url`, of all roles or of `roles`; nothing is executed.

    `names` and `passwords` by role; a name that is not given is that of `account_name`, a password is made up. `host`
    is where the accounts may connect from. With `rotate` they are there and get new passwords, with `grants` the rights
    that they have in this version. Raises UsageError for SQLite, which has no accounts, and for impossible names.
    """
    parsed = parse_url(url)
    if parsed.get_backend_name() == "sqlite":
        raise UsageError("SQLite has no accounts: its file's rights decide who may read and write it")
    if not _HOST.fullmatch(host):
        raise UsageError(f"{host!r} is no host for an account")
    schema = parsed.database or ""
    statements = []
    if "owner" in roles and not rotate and not grants:
        statements.append(
            f"CREATE DATABASE IF NOT EXISTS {_identifier(schema)} CHARACTER SET utf8mb4 COLLATE utf8mb4_bin"
        )
    urls: dict[str, str] = {}
    for role in roles:
        name = (names or {}).get(role) or account_name(schema, role)
        password = (passwords or {}).get(role) or _new_password()
        if not _NAME.fullmatch(name):
            raise UsageError(f"{name!r} cannot be the name of an account: 1 to 32 of A-Z a-z 0-9 _ . -")
        account = f"'{name}'@'{host}'"
        if not grants:
            statements.append(f"{'ALTER' if rotate else 'CREATE'} USER {account} IDENTIFIED BY {_quoted(password)}")
        if not rotate:
            statements += _grants(role, schema, account, there=grants)
        if grants:
            continue
        urls[role] = parsed.set(username=name, password=password).render_as_string(hide_password=False)
    return Accounts(tuple(statements), urls)


def _grants(role: str, schema: str, account: str, *, there: bool) -> list[str]:
    """The rights of an account; of one that is `there` those are taken that earlier versions gave it."""
    # _ and % in the schema of a GRANT are patterns
    pattern = _identifier(re.sub(r"([_%])", r"\\\1", schema))
    whole = f"GRANT {RIGHTS[role]} ON {pattern}.* TO {account}"
    if role != "reader":
        return [whole]
    # a right that is not there cannot be taken away, so it is given first
    statements = [whole, f"REVOKE {RIGHTS[role]} ON {pattern}.* FROM {account}"] if there else []
    for name in READABLE:
        table = f"{_identifier(schema)}.{_identifier(name)}"
        # rights on a table that is still to be made are given with that to make it alone
        statements.append(f"GRANT CREATE, {RIGHTS[role]} ON {table} TO {account}")
        statements.append(f"REVOKE CREATE ON {table} FROM {account}")
    return statements


def account_name(schema: str, role: str) -> str:
    """The name of the account of a role for a schema, which no other schema's account has: ``semdb_reader``.

    Names of schemas that are too long, or have characters that names here have not, are told apart by their hash.
    """
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", schema)
    if plain != schema or len(plain) > _LONGEST_SCHEMA:
        plain = f"{plain[: _LONGEST_SCHEMA - 9]}_{hashlib.sha256(schema.encode()).hexdigest()[:8]}"
    return f"{plain}_{role}"


def _new_password() -> str:
    """24 random characters, and of every kind that a server may ask for."""
    return secrets.token_urlsafe(18) + "-0aA"


def execute(url: str, statements: Sequence[str]) -> None:
    """Run the statements as the account of `url`, which must be allowed to. Raises DatabaseError.

    When one fails, the accounts that those before it made are gone again: nobody would know their passwords. New
    passwords of accounts that were there cannot be taken back: the error holds those that were given.
    """
    parsed = parse_url(url)
    who = (parsed.drivername, parsed.username, parsed.password)
    # without the schema, which may be what they make
    engine = make_server_engine(URL.create(*who, host=parsed.host, port=parsed.port, query=parsed.query))
    done: list[str] = []
    try:
        with engine.connect() as connection:
            for statement in statements:
                try:
                    _run(connection, statement)
                except DBAPIError as error:
                    for made in filter(None, map(_CREATED.match, done)):
                        _run(connection, f"DROP USER {made[1]}")
                    raise _refused(engine, error, statement, done) from error
                done.append(statement)
            connection.commit()
    except SQLAlchemyError as error:
        raise retry.explain(engine, error) from error
    finally:
        engine.dispose()


def _run(connection: Connection, statement: str) -> None:
    connection.exec_driver_sql(statement.replace("%", "%%"))


def _refused(engine: Engine, error: DBAPIError, statement: str, done: Sequence[str]) -> DatabaseError:
    explained = retry.explain(engine, error)
    if retry.error_code(error) == _CANNOT_USER:
        account = statement.split()[2]
        explained = DatabaseError(
            f"the account {account} is there already, and no account was made: --rotate gives it a new password"
            if statement.startswith("CREATE")
            else f"there is no account {account}, whose password could be changed: leave out --rotate to make it"
        )
    changed = "; ".join(before for before in done if before.startswith("ALTER"))
    return DatabaseError(f"{explained}. Changed before that: {changed}") if changed else explained


def _identifier(name: str) -> str:
    return "`" + name.replace("`", "``") + "`"


def _quoted(password: str) -> str:
    if "\\" in password or not password.isprintable():
        raise UsageError("a password is made of printable characters and has no backslash")
    return "'" + password.replace("'", "''") + "'"
