"""How often a tracker looks at what others did to its map."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from semdb.api import tracking
from semdb.api.tracking import HEADS_S, LOOKED_S, MapTracker


class Maps:
    """Maps of which one is there; `refreshed` counts looks at its keyframes, `heads` those at what it is made of."""

    def __init__(self) -> None:
        self.heads = self.refreshed = 0
        self.entry = self.opened()

    def opened(self) -> Any:
        localizer = SimpleNamespace(cache=object(), refresh=self._refresh)
        return SimpleNamespace(head=SimpleNamespace(name="office"), localizer=localizer)

    def _refresh(self) -> None:
        self.refreshed += 1

    def asked(self, name: str | None, coarse: str) -> list[Any]:
        self.heads += 1
        return [self.entry]


def test_keyframes_are_looked_at_every_second_and_models_every_ten(monkeypatch: pytest.MonkeyPatch) -> None:
    now, maps = [100.0], Maps()
    monkeypatch.setattr(tracking.time, "monotonic", lambda: now[0])
    tracker = MapTracker(maps, None, None, None)  # type: ignore[arg-type]
    assert (maps.heads, maps.refreshed) == (1, 0)
    for _ in range(120):  # at twelve frames a second
        tracker._look()
        now[0] += 1 / 12
    assert maps.refreshed == pytest.approx(10 / LOOKED_S, abs=1)
    assert maps.heads == 2  # made, and at the first frame
    maps.entry = maps.opened()  # refined meanwhile
    now[0] = 100.0 + HEADS_S + LOOKED_S
    tracker._look()
    assert maps.heads == 3
    assert tracker._entry is maps.entry
    assert tracker._tracker.keyframes is maps.entry.localizer.cache
