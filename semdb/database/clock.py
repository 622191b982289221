"""Times by the database's clock, the only one that all workers share."""

from __future__ import annotations

from typing import Any

from sqlalchemy import DateTime
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement


class now_plus(FunctionElement[Any]):  # noqa: N801 (an SQL function)
    """The time on the database, UTC, in `seconds` (whole, may be negative) from now."""

    type = DateTime()
    inherit_cache = False  # the number is part of the statement's text
    name = "now_plus"

    def __init__(self, seconds: int = 0) -> None:
        super().__init__()
        self.seconds = int(seconds)


@compiles(now_plus)
def _server(element: Any, _compiler: Any, **_options: Any) -> str:
    return f"TIMESTAMPADD(SECOND, {element.seconds}, UTC_TIMESTAMP())"


@compiles(now_plus, "sqlite")
def _sqlite(element: Any, _compiler: Any, **_options: Any) -> str:
    return f"datetime('now', '{element.seconds:+d} seconds')"
