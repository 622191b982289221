"""Values as JSON holds them."""

from __future__ import annotations

import math
from datetime import date, datetime, time, timedelta
from decimal import Decimal
from typing import Any

from semdb.shown import number


def to_jsonable(value: Any) -> Any:
    """`value` with what JSON cannot hold replaced: NaN and infinities by null, bytes by hex, times by ISO 8601.

    A decimal of a database is a number where one of eight bytes holds it exactly, else a text with all its digits.
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if isinstance(value, bytes | bytearray | memoryview):
        return bytes(value).hex()
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    if isinstance(value, timedelta):
        return _span(value)
    if isinstance(value, Decimal):  # what servers return for SUM and AVG
        return _decimal(value)
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return to_jsonable(value.tolist())
    return value


def _decimal(value: Decimal) -> int | float | str | None:
    if not value.is_finite():
        return None
    if value == value.to_integral_value():
        return int(value)
    return float(value) if Decimal(repr(float(value))) == value else number(value)


def _span(value: timedelta) -> str:
    """A TIME of a server as it writes it: ``-26:03:04.5``, hours first, however many."""
    microseconds = abs(value) // timedelta(microseconds=1)
    seconds, rest = divmod(microseconds, 10**6)
    fraction = f".{rest:06d}".rstrip("0") if rest else ""
    sign = "-" if value < timedelta(0) else ""
    return f"{sign}{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}{fraction}"
