"""Who may use a service."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

ROLES = ("read", "localize", "ingest", "admin")
"""Each may what those before it may."""


@dataclass(frozen=True, slots=True)
class AccessToken:
    """A token as it is listed: never the secret itself. `map` None: all maps. Times are UTC."""

    id: int
    name: str
    role: str
    map: str | None
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


@dataclass(frozen=True, slots=True)
class NewToken:
    """A token that was just made; its `secret` is nowhere else."""

    token: AccessToken
    secret: str
