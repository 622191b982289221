"""Times by the database's clock, the only one that all workers share."""

from __future__ import annotations

from typing import Any

from sqlalchemy import DateTime, Integer, literal
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement


class now_plus(FunctionElement[Any]):  # noqa: N801 (an SQL function)
    """The time on the database, UTC, in `seconds` (whole, may be negative) from now."""

    type = DateTime()
    inherit_cache = True  # the number is a parameter: statements are compiled once
    name = "now_plus"

    def __init__(self, seconds: int = 0) -> None:
        super().__init__(literal(int(seconds), Integer))


@compiles(now_plus)
def _server(element: Any, compiler: Any, **options: Any) -> str:
    return f"TIMESTAMPADD(SECOND, {compiler.process(element.clauses, **options)}, UTC_TIMESTAMP())"


@compiles(now_plus, "sqlite")
def _sqlite(element: Any, compiler: Any, **options: Any) -> str:
    return f"datetime('now', {compiler.process(element.clauses, **options)} || ' seconds')"
