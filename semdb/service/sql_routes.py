"""Rows by statements that can only read."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import Query, Request
from starlette.responses import Response

from semdb.errors import DatabaseError, DatabaseUnavailableError, SchemaError, UsageError
from semdb.jsonable import to_jsonable
from semdb.service import sql_schemas
from semdb.service.answers import as_json
from semdb.service.problems import Problem, scrubbed
from semdb.service.roles import ADMIN, READ
from semdb.service.routing import Table
from semdb.service.settings import MIB
from semdb.service.state import Service, access_of, read, service_of

table = Table("sql")
LONGEST = 20_000  # characters of a statement
TRUNCATED = "Semdb-Truncated"


def for_all_maps(request: Request) -> None:
    """Raises Problem 403 for a token of one map: a statement sees all of them."""
    if access_of(request).map is not None:
        raise Problem(403, "a statement sees all maps, and this token is for one")


@table.route("GET", "/v1/sql", READ, sql_schemas.Rows, also={"text/csv": {"schema": {"type": "string"}}})
async def get_sql(
    request: Request,
    sql: Annotated[str, Query(min_length=1, max_length=LONGEST, description="one SELECT", examples=["SELECT 1"])],
    format: Annotated[Literal["json", "csv"] | None, Query(description="instead of the header Accept")] = None,
) -> Response:
    """Rows of one SELECT: read-only, for a limited time, a limited number of them, as JSON or CSV.

    Where files lie is only for role admin: such columns are null, and of a server their tables are refused. Bytes are
    hex. The header Semdb-Truncated says whether rows were left out. Only for tokens of all maps.
    """
    for_all_maps(request)
    service, private = service_of(request), not access_of(request).has(ADMIN)
    columns, rows, truncated = await service.statements.run(lambda: _ask(service, sql, private))
    headers = {TRUNCATED: "true" if truncated else "false"}
    wanted = format or ("csv" if "text/csv" in request.headers.get("accept", "") else "json")
    if wanted == "csv":
        return Response(_csv(columns, rows), 200, headers, "text/csv; charset=utf-8")
    return as_json({"columns": columns, "rows": rows, "truncated": truncated}, headers=headers)


def _ask(service: Service, sql: str, private: bool) -> tuple[list[str], list[list[Any]], bool]:
    """Columns, rows, and whether there were more. Raises Problem 422."""
    try:
        with service.database.sql(sql, private=private) as found:
            columns = [str(name) for name in found.columns]
            rows, truncated = _some(iter(found), service.settings.sql_rows, int(service.settings.sql_mb * MIB))
            return columns, rows, truncated
    except (DatabaseUnavailableError, SchemaError):
        raise
    except UsageError as error:
        if "SEMDB_READER_URL" in str(error):
            raise Problem(501, "the service has no account that may only read: SEMDB_READER_URL") from error
        raise Problem(422, scrubbed(error), kind="usage") from error
    except DatabaseError as error:
        if "SEMDB_READER_URL" in str(error):
            raise Problem(501, "the account that may only read may do more, or cannot be used") from error
        raise Problem(422, scrubbed(error), kind="statement") from error


def _some(found: Iterator[tuple[Any, ...]], most_rows: int, most_bytes: int) -> tuple[list[list[Any]], bool]:
    rows: list[list[Any]] = []
    size = 0
    for row in found:
        plain = to_jsonable(row)
        size += sum(len(value) if isinstance(value, str) else 8 for value in plain)
        if len(rows) >= most_rows or size > most_bytes:
            return rows, True
        rows.append(plain)
    return rows, False


def _csv(columns: list[str], rows: list[list[Any]]) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


@table.route("GET", "/v1/tables", READ, sql_schemas.Tables)
async def get_tables(request: Request) -> Response:
    """Tables and views that statements can ask, with their columns, and what these are for."""
    for_all_maps(request)
    found = await read(request, lambda db: db.tables())
    about = {name: text for name, text in page_texts()["tables"].items() if name in found}
    return as_json({"tables": {name: list(columns) for name, columns in found.items()}, "about": about})


@table.route("GET", "/v1/questions", READ, sql_schemas.Questions)
async def get_questions(request: Request) -> Response:
    """Statements to begin with: those of the cookbook, docs/sql.md."""
    return as_json({"questions": page_texts()["questions"]})


@cache
def page_texts() -> dict[str, Any]:
    """What docs/schema.md and docs/sql.md say, as scripts/page_texts.py writes it."""
    found: dict[str, Any] = json.loads((Path(__file__).parent / "page_texts.json").read_text("utf-8"))
    return found
