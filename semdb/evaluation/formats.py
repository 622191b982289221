"""Numbers as the cells of tables have them; ``-`` for what is undefined."""

from __future__ import annotations

from semdb.shown import measure

NOTHING = "-"


def percent(share: float | None) -> str:
    """0.5 becomes ``50.0 %``."""
    return NOTHING if share is None else f"{measure(100 * share, 1, unless=(0.0, 100.0))} %"


def errors(metres: float | None, degrees: float | None) -> str:
    """Metres and degrees, ``0.0450 / 0.90``."""
    return NOTHING if metres is None or degrees is None else f"{metres:.4f} / {degrees:.2f}"


def whole(value: float | None) -> str:
    """Rounded to a whole number."""
    return NOTHING if value is None else f"{value:.0f}"
