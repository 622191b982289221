"""Sums of whole numbers that no sum overflows: SQLite's end with an error at 2**63, servers count on in decimals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Engine, func, literal_column
from sqlalchemy.sql.elements import ColumnElement

_PART = 2**31


def exact_sum(engine: Engine, value: ColumnElement[int]) -> tuple[ColumnElement[Any], ...]:
    """What to select for the sum of `value` over all rows; `whole` makes the sum of what comes.

    On SQLite it is the sum of quotients and the sum of remainders: four thousand million rows overflow neither.
    """
    if engine.dialect.name != "sqlite":
        return (func.coalesce(func.sum(value), 0),)
    part: ColumnElement[int] = literal_column(str(_PART))
    return func.coalesce(func.sum(value.op("/")(part)), 0), func.coalesce(func.sum(value.op("%")(part)), 0)


def whole(parts: Sequence[Any]) -> int:
    """The sum."""
    if len(parts) == 1:
        return int(parts[0])
    return int(parts[0]) * _PART + int(parts[1])
