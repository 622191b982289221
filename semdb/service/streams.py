"""Answers that go on: events for those who follow, of which there are only so many."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from semdb.service.problems import busy

MOST, MOST_EACH = 64, 32
LONGEST_S = 3600.0


class Streams:
    """Counts them by who follows, so that one token takes no place of all others; used on the loop alone."""

    def __init__(self, most: int = MOST, most_each: int = MOST_EACH) -> None:
        self._most, self._most_each = most, most_each
        self._open: Counter[str] = Counter()

    def __len__(self) -> int:
        return self._open.total()

    def check(self, who: str) -> None:
        """Raises Problem 429 where there is no place for one more."""
        if len(self) >= self._most or self._open[who] >= self._most_each:
            raise busy("too many follow", 10)

    @contextmanager
    def one(self, who: str) -> Iterator[None]:
        """Holds a place."""
        self._open[who] += 1
        try:
            yield
        finally:
            self._open[who] -= 1
            if self._open[who] <= 0:
                del self._open[who]
