"""Tokens of those who may use the service: only their hashes are stored.

A token is 32 random bytes, so its hash says nothing of it, and needs no salt. Each request looks its token up, so one
that is revoked is so at once, for all services on the database.
"""

from __future__ import annotations

import hashlib
import secrets
from typing import Any

from sqlalchemy import ColumnElement, Engine, Select, and_, bindparam, insert, or_, select, update

from semdb.database import checked, retry
from semdb.database.clock import now_plus
from semdb.database.tables import access_tokens, maps
from semdb.errors import CodecError, NotFoundError

PREFIX = "semdb_"
LONGEST = 128  # characters of what can be a token
_t = access_tokens.c


def make_token(
    engine: Engine, name: str, role: str, map_id: int | None = None, expires_s: int | None = None
) -> tuple[int, str]:
    """The id of a new token, and the token itself, which is nowhere else. Raises DatabaseError."""
    secret = PREFIX + secrets.token_urlsafe(32)
    values = {
        "name": name,
        "role": role,
        "map_id": map_id,
        "hash": hash_of(secret),
        "created_at": now_plus(0),
        "expires_at": None if expires_s is None else now_plus(expires_s),
    }

    def work(connection: Any) -> int:
        connection.execute(insert(access_tokens).values(values))
        return int(connection.execute(select(_t.id).where(_t.hash == values["hash"])).scalar_one())

    return retry.write(engine, work), secret


def hash_of(secret: str) -> str:
    """What is stored of a token."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def list_tokens(engine: Engine) -> list[Any]:
    """The rows of all tokens by id, with the name of their map."""
    return retry.read(engine, lambda connection: list(connection.execute(_rows().order_by(_t.id))))


def find_token(engine: Engine, secret: str | None) -> tuple[Any | None, bool]:
    """The row of a token that is valid now, and whether there is any that was not revoked. Raises CodecError.

    One that has expired is still there: the end of the last one must not open the service to all.
    """
    wanted = None if secret is None or len(secret) > LONGEST else hash_of(secret)

    def work(connection: Any) -> tuple[Any | None, bool]:
        row = None if wanted is None else connection.execute(_FIND, {"wanted": wanted}).one_or_none()
        return row, row is not None or connection.execute(_ANY).first() is not None

    row, any_there = retry.read(engine, work)
    if row is not None:
        check_row(row)
    return row, any_there


def check_row(row: Any) -> None:
    """Raises CodecError for a token whose rights nobody can tell."""
    where = f"of token {row.id}"
    checked.text(row.role, f"access_tokens.role {where}")
    if row.map_id is not None and row.map is None:
        raise CodecError(f"access_tokens.map_id {where} is of no map")


def revoke_token(engine: Engine, token_id: int) -> None:
    """Ends a token for good; one that is revoked already stays so. Raises NotFoundError."""
    statement = update(access_tokens).where(_t.id == int(token_id), _t.revoked_at.is_(None))

    def work(connection: Any) -> bool:
        connection.execute(statement.values(revoked_at=now_plus(0)))
        return connection.execute(select(_t.id).where(_t.id == int(token_id))).scalar() is not None

    if not retry.write(engine, work):
        raise NotFoundError(f"there is no token {token_id}: `semdb token list` lists them")


def _rows() -> Select[Any]:
    columns = (_t.id, _t.name, _t.role, _t.map_id, maps.c.name.label("map"))
    return select(*columns, _t.created_at, _t.expires_at, _t.revoked_at).select_from(
        access_tokens.outerjoin(maps, maps.c.id == _t.map_id)
    )


def _valid() -> ColumnElement[bool]:
    return and_(_t.revoked_at.is_(None), or_(_t.expires_at.is_(None), _t.expires_at > now_plus(0)))


# Each request asks these: made once, since making them takes longer than asking.
_FIND = _rows().where(_t.hash == bindparam("wanted"), _valid())
_ANY = select(_t.id).where(_t.revoked_at.is_(None)).limit(1)
