"""Who may use a service on this database."""

from __future__ import annotations

from typing import Any

from semdb.api.base import Base
from semdb.door.access import ROLES, AccessToken, NewToken
from semdb.errors import UsageError
from semdb.storable_names import name_problem

LONGEST_LIFE_S = 100 * 366 * 86_400


class Granting(Base):
    """Makes, lists and revokes tokens."""

    def create_token(
        self, role: str, *, map: str | None = None, expires_s: int | None = None, name: str | None = None
    ) -> NewToken:
        """A new token for a service: `role` is read, localize, ingest or admin, `map` the only map that it is for.

        It ends after `expires_s` seconds, or when it is revoked, or its map is deleted. `name` is for people. Its
        secret is given once, and only its hash is kept. Raises UsageError, NotFoundError.
        """
        from semdb.database import tokens

        if role not in ROLES:
            raise UsageError(f"a role is one of {', '.join(ROLES)}, not {role!r}")
        if expires_s is not None and not 1 <= expires_s <= LONGEST_LIFE_S:
            raise UsageError(f"a token lives between a second and a hundred years, not {expires_s} s")
        if (problem := name_problem(name or role)) is not None:
            raise UsageError(f"the name {name!r} {problem}")
        store = self._store()
        made, secret = tokens.make_token(store.engine, name or role, role, self._map_id(map), expires_s)
        [row] = [row for row in tokens.list_tokens(store.engine) if row.id == made]
        return NewToken(_token(row), secret)

    def tokens(self) -> list[AccessToken]:
        """All tokens by id, those that ended too; never their secrets."""
        from semdb.database.tokens import list_tokens

        return [_token(row) for row in list_tokens(self._store().engine)]

    def revoke_token(self, token_id: int) -> None:
        """Ends a token at once, for all services. Raises NotFoundError."""
        from semdb.database.tokens import revoke_token

        revoke_token(self._store().engine, token_id)

    def access(self, secret: str | None) -> tuple[AccessToken | None, bool]:
        """The token with this `secret`, if it is valid now, and whether there is any that was not revoked.

        Raises CodecError.
        """
        from semdb.database.tokens import find_token

        row, any_there = find_token(self._store().engine, secret)
        return None if row is None else _token(row), any_there


def _token(row: Any) -> AccessToken:
    return AccessToken(row.id, row.name, row.role, row.map, row.created_at, row.expires_at, row.revoked_at)
