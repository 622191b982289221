"""How often a tracker looks at what others did to its map."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from semdb.api import tracking
from semdb.api.tracking import HEADS_S, LOOKED_S, MapTracker
from semdb.errors import ProvenanceError


class Maps:
    """Maps of which one is there; `refreshed` counts looks at its keyframes, `heads` those at what it is made of."""

    def __init__(self) -> None:
        self.heads = self.refreshed = 0
        self.another_encoder = False
        self.keyframes = 20
        self.entry = self.opened()

    def opened(self, key: int = 1) -> Any:
        localizer = SimpleNamespace(cache=object())
        found = SimpleNamespace(head=SimpleNamespace(id=key, name="office"), localizer=localizer)
        localizer.refresh = lambda: self._refresh(found)
        return found

    def _refresh(self, entry: Any) -> int:
        self.refreshed += 1
        if entry is self.entry:
            return 20
        if self.another_encoder:
            raise ProvenanceError("described anew by another encoder")
        return self.keyframes

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


def test_a_map_that_is_described_anew_or_replaced_is_taken_over_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now, maps = [100.0], Maps()
    monkeypatch.setattr(tracking.time, "monotonic", lambda: now[0])
    tracker = MapTracker(maps, None, None, None)  # type: ignore[arg-type]
    tracker._look()
    first = tracker._tracker
    maps.entry, maps.another_encoder = maps.opened(), True
    now[0] += LOOKED_S
    tracker._look()
    assert tracker._entry is maps.entry
    assert tracker._tracker is first  # poses are those of the same map
    assert first.keyframes is maps.entry.localizer.cache
    maps.entry, maps.another_encoder, maps.keyframes = maps.opened(2), False, 0  # deleted, and another one of that name
    now[0] += LOOKED_S
    tracker._look()
    assert tracker._entry is maps.entry
    assert tracker._tracker is not first  # nothing is carried on in it
    assert tracker._tracker.keyframes is maps.entry.localizer.cache
    assert maps.heads == 4
