"""Roles, what a request may do, and how many requests a second."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

from semdb.door.access import ROLES
from semdb.service.problems import busy

READ, LOCALIZE, INGEST, ADMIN = ROLES
PUBLIC = "public"
MOST_KNOWN = 10_000
SLASH = "\ue000"  # stands in paths for the slash of a name, which cannot have it: it is not printable


@dataclass(frozen=True, slots=True)
class Access:
    """What a request may do. `map` None: all maps."""

    role: str
    map: str | None
    who: str  # for logs and limits: the id of the token

    def has(self, role: str) -> bool:
        """Whether a role is within this one."""
        return ROLES.index(self.role) >= ROLES.index(role)

    def sees(self, map_name: str) -> bool:
        """Whether a map is one of those that may be asked."""
        return self.map is None or self.map == map_name


ON_LOOPBACK = Access(ADMIN, None, "loopback")


class Rates:
    """A bucket of requests for each token, filled all the time. `rate` 0: no limit."""

    def __init__(self, rate: float, burst: int) -> None:
        self._rate, self._burst = rate, burst
        self._turn = threading.Lock()
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()  # requests left, and when

    def take(self, who: str) -> None:
        """Raises Problem 429 where nothing is left."""
        if not self._rate:
            return
        now = time.monotonic()
        with self._turn:
            left, then = self._left.pop(who, (float(self._burst), now))
            left = min(float(self._burst), left + (now - then) * self._rate)
            allowed = left >= 1
            self._left[who] = (left - allowed, now)
            if len(self._left) > MOST_KNOWN:
                self._left.popitem(last=False)
        if not allowed:
            raise busy("this token asks more often than it may", 1 / self._rate)
