"""Cameras that this process tracks: so many at once, each for as long as frames of it come."""

from __future__ import annotations

import asyncio
import secrets
import threading
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

from semdb.door.protocol import CameraTracker
from semdb.service.problems import busy
from semdb.service.roles import ON_LOOPBACK

MOST_WAITING = 4  # frames of one camera
MOST_PLACES = 300  # of its path that are kept


@dataclass(eq=False)
class Live:
    """A camera that is tracked, or is about to be, for whoever asked."""

    who: str = ""
    tracker: CameraTracker | None = None
    opened: bool = False  # by its first request, not by a frame
    frames: int = 0
    used_s: float = 0.0
    waiting: int = 0
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    running: threading.Lock = field(default_factory=threading.Lock)  # also of those whose client went away meanwhile
    last: tuple[bytes | None, dict[str, Any]] | None = None
    map: str | None = None
    name: str = field(default_factory=lambda: secrets.token_hex(4))  # as others see it; says nothing of the session
    path: deque[list[float]] = field(default_factory=lambda: deque(maxlen=MOST_PLACES))

    def saw(self, map_name: str, answer: dict[str, Any]) -> None:
        """What those who watch are shown of an answer: the pose, and where the camera came from."""
        self.map = map_name
        if answer.get("pose") is not None:
            self.path.append([round(float(value), 4) for value in answer["pose"]["position"]])

    def shown(self, now: float) -> dict[str, Any]:
        """The camera for those who watch."""
        answer = {} if self.last is None else self.last[1]
        kept = ("state", "pose", "covariance", "confidence", "reason", "timestamp_ns", "frame_index")
        return {
            "camera": self.name,
            "frames": self.frames,
            "age_s": round(max(0.0, now - self.used_s), 2),
            "path": list(self.path),
            **{key: answer.get(key) for key in kept},
        }


class Sessions:
    """The cameras of this process by the id of their session; used on the loop alone."""

    def __init__(self, most: int, most_each: int, idle_s: float) -> None:
        self._most, self._most_each, self._idle_s = most, most_each, idle_s
        self._live: dict[str, Live] = {}

    def __len__(self) -> int:
        return len(self._live)

    @asynccontextmanager
    async def use(self, name: str, who: str) -> AsyncIterator[Live]:
        """The camera of that session, for one at a time. Raises Problem 429 where no more are taken, or of this token.

        Without a token there is nobody else whose places could be taken.
        """
        live = self._live.get(name)
        if live is None:
            self.forget()
            if len(self._live) >= self._most:
                raise busy(f"{self._most} cameras are tracked already", self._idle_s / 4)
            if who != ON_LOOPBACK.who and self.of(who) >= self._most_each:
                raise busy(f"{self._most_each} cameras of this token are tracked already", self._idle_s / 4)
            live = self._live[name] = Live(who)
        if live.waiting >= MOST_WAITING:
            raise busy("frames of this session wait already: send the next one when the last one is answered", 1)
        live.waiting += 1
        try:
            async with live.turn:
                live.used_s = time.monotonic()
                yield live
        finally:
            live.waiting -= 1
            live.used_s = time.monotonic()
            if live.tracker is None and not live.waiting and self._live.get(name) is live:
                self.end(name)

    def of(self, who: str) -> int:
        """How many are tracked for a token."""
        return sum(live.who == who for live in self._live.values())

    def watched(self, map_name: str) -> list[dict[str, Any]]:
        """The cameras that move in a map, the one that moved last first."""
        now = time.monotonic()
        found = [live for live in self._live.values() if live.map == map_name and live.last is not None]
        fresh = [live for live in found if live.waiting or now - live.used_s < self._idle_s]
        return [live.shown(now) for live in sorted(fresh, key=lambda live: -live.used_s)]

    def end(self, name: str) -> None:
        """Lets a camera go."""
        self._live.pop(name, None)

    def forget(self) -> None:
        """Lets those go of which nothing came for too long."""
        last = time.monotonic() - self._idle_s
        for name in [name for name, live in self._live.items() if not live.waiting and live.used_s < last]:
            self.end(name)
