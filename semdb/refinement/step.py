"""What a step of `semdb refine` must be: one file with a class that satisfies `Step`, named in `steps.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from sqlalchemy import Connection

from semdb.database.store import Store


class Step(Protocol):
    """One thing that is computed of a map. `kind` names its row in `refinements`."""

    @property
    def kind(self) -> str: ...

    @property
    def summary(self) -> str:
        """For people, in a few words."""

    @property
    def by_default(self) -> bool:
        """Whether it is run where no step is named."""

    @property
    def moves(self) -> bool:
        """Whether it changes the poses that the state of a map is made from."""

    @property
    def parameters(self) -> Mapping[str, Any]:
        """All that changes the result, beside the map: other ones make it out of date."""

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> Any:
        """Reads the map and computes: what `write` takes."""

    def write(self, connection: Connection, map_id: int, result: Any) -> int:
        """Replaces the rows of the map within the transaction of `connection`. Returns how many there are now."""
