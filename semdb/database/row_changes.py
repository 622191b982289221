"""Rows in place of those that are there, of which only what differs is written: the rest stays as it is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, Select, Table, bindparam, delete, insert, update
from sqlalchemy.sql.elements import ColumnElement

CHUNK = 500  # rows of a statement
Rows = Sequence[Mapping[str, Any]]


def write_groups(
    connection: Connection, table: Table, group: str, stored: Select[Any], wanted: Rows, *own: ColumnElement[bool]
) -> None:
    """Makes the rows of `table` that `stored` selects (all columns) those of `wanted`.

    Rows belong together by the column `group`: where one of a group differs, all of it are written anew. Where rows
    of a group may be there that `stored` does not select, `own` are the conditions that tell its rows from them.
    """
    names = [column.name for column in table.columns]
    there = _grouped(map(tuple, connection.execute(stored)), names.index(group))
    new = _grouped((tuple(row[name] for name in names) for row in wanted), names.index(group))
    changed = {key for key in there.keys() | new.keys() if set(there.get(key, ())) != set(new.get(key, ()))}
    delete_keys(connection, table, table.c[group], sorted(changed & there.keys()), *own)
    rows = [dict(zip(names, row, strict=True)) for key in sorted(changed & new.keys()) for row in new[key]]
    insert_rows(connection, table, rows)


def update_rows(connection: Connection, table: Table, stored: Select[Any], wanted: Rows) -> None:
    """Makes the rows of `table` with these ids, which `stored` selects (all columns), those of `wanted`."""
    names = [column.name for column in table.columns]
    there = {row.id: tuple(row) for row in connection.execute(stored)}
    changed = [row for row in wanted if there.get(row["id"]) != tuple(row[name] for name in names)]
    if changed:
        others = [name for name in names if name != "id"]
        query = update(table).where(table.c.id == bindparam("of_id"))
        query = query.values({name: bindparam(f"to_{name}") for name in others})
        values = [{"of_id": row["id"], **{f"to_{name}": row[name] for name in others}} for row in changed]
        for start in range(0, len(values), CHUNK):
            connection.execute(query, values[start : start + CHUNK])


def delete_keys(
    connection: Connection, table: Table, column: ColumnElement[Any], keys: Sequence[Any], *own: ColumnElement[bool]
) -> None:
    """Deletes the rows of `table` with these values of `column`, where `own` holds, in bounded statements."""
    for start in range(0, len(keys), CHUNK):
        connection.execute(delete(table).where(column.in_(keys[start : start + CHUNK]), *own))


def insert_rows(connection: Connection, table: Table, rows: Rows) -> None:
    """Inserts rows, in statements of bounded size."""
    for start in range(0, len(rows), CHUNK):
        connection.execute(insert(table), list(rows[start : start + CHUNK]))


def _grouped(rows: Iterable[tuple[Any, ...]], column: int) -> dict[Any, list[tuple[Any, ...]]]:
    found: dict[Any, list[tuple[Any, ...]]] = {}
    for row in rows:
        found.setdefault(row[column], []).append(row)
    return found
