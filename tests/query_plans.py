"""Which statements read a big table from end to end: whatever goes to a database is explained on its way."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection, Engine, event

SMALL = 300  # rows that may be read from end to end
_EXPLAINED = re.compile(r"\s*(SELECT|WITH|UPDATE|DELETE|INSERT\b.*\bSELECT)\b", re.IGNORECASE | re.DOTALL)
_CONDITION = re.compile(r"\b(WHERE|HAVING|LIMIT)\b", re.IGNORECASE)
_FULL_SCANS = {"ALL", "index", "hash_ALL", "hash_index"}


@dataclass
class PlanCheck:
    """Statements that were explained, and what of them reads too much.

    A statement without any condition asks about everything: it may read an index, which is smaller than its table.
    """

    statements: set[str] = field(default_factory=set)
    full_scans: list[str] = field(default_factory=list)

    def explain(self, connection: Connection, statement: str, parameters: Any) -> None:
        if statement in self.statements or not _EXPLAINED.match(statement):
            return
        self.statements.add(statement)
        everything = _CONDITION.search(statement) is None
        cursor = connection.connection.cursor()
        try:
            look = _sqlite if connection.dialect.name == "sqlite" else _server
            found = list(look(cursor, statement, parameters, everything))
        finally:
            cursor.close()
        self.full_scans += [f"{reason}\n{statement}\n{parameters!r:.300}\n" for reason in found]


@contextlib.contextmanager
def checked_plans() -> Iterator[PlanCheck]:
    """Explains all statements that any engine of this process sends meanwhile."""
    check = PlanCheck()

    def before(connection: Connection, _: Any, statement: str, parameters: Any, _context: Any, many: bool) -> None:
        check.explain(connection, statement, parameters[0] if many else parameters)

    event.listen(Engine, "before_cursor_execute", before)
    try:
        yield check
    finally:
        event.remove(Engine, "before_cursor_execute", before)


def _server(cursor: Any, statement: str, parameters: Any, everything: bool) -> Iterator[str]:
    cursor.execute("EXPLAIN FORMAT=TRADITIONAL " + statement, parameters or None)
    names = [column[0] for column in cursor.description]
    for row in (dict(zip(names, values, strict=True)) for values in cursor.fetchall()):
        if row["type"] not in _FULL_SCANS or int(row["rows"] or 0) <= SMALL or str(row["table"]).startswith("<"):
            continue
        covered = "Using index" in (row["Extra"] or "").split("; ") and row["key"] != "PRIMARY"
        if not (everything and covered):
            key = f" of the index {row['key']}" if row["key"] else ""
            yield f"a scan{key} of {row['table']}, {row['rows']} rows ({row['type']}):"


def _sqlite(cursor: Any, statement: str, parameters: Any, everything: bool) -> Iterator[str]:
    big = _big_tables(cursor)
    aliases = _aliases(cursor, statement)
    cursor.execute("EXPLAIN QUERY PLAN " + statement, parameters)
    for *_, detail in cursor.fetchall():
        words = detail.split()
        if words[0] not in ("SCAN", "SEARCH") or not (aliases.get(words[1], {words[1]}) & big):
            continue
        automatic = "USING AUTOMATIC" in detail  # an index that is made for this statement alone, and thrown away
        covered = "USING COVERING INDEX" in detail
        if automatic or (words[0] == "SCAN" and not (everything and covered)):
            yield f"{detail}:"


def _big_tables(cursor: Any) -> set[str]:
    """By what ANALYZE has counted; nothing is big in a database that was never analysed."""
    if not cursor.execute("SELECT 1 FROM sqlite_master WHERE name = 'sqlite_stat1'").fetchone():
        return set()
    rows = cursor.execute("SELECT tbl, stat FROM sqlite_stat1").fetchall()
    return {table for table, stat in rows if int(stat.split()[0]) > SMALL}


def _aliases(cursor: Any, statement: str) -> dict[str, set[str]]:
    """Names in plans -> tables, for the aliases of a statement and of the views that it may go through."""
    objects = cursor.execute("SELECT type, name, sql FROM sqlite_master WHERE type IN ('table', 'view')").fetchall()
    text = " ".join([statement, *(sql for kind, _, sql in objects if kind == "view")])
    found: dict[str, set[str]] = {}
    for kind, name, _ in objects:
        if kind == "table":
            for alias in re.findall(rf"\b{name}\s+(?:AS\s+)?(\w+)", text, re.IGNORECASE):
                found.setdefault(alias, set()).add(name)
            found.setdefault(name, set()).add(name)
    return found
