"""Which tables and views there are to ask with `semdb sql`, with their columns."""

from __future__ import annotations

import difflib
import re
from collections.abc import Generator

from semdb.database.readonly import Row, file_of, run_readonly
from semdb.database.readonly_sqlite import read_own
from semdb.database.statement import HIDDEN
from semdb.errors import DatabaseError, SemdbError
from semdb.settings import Settings

_OWN = "alembic_version"  # of the migrations, not of users
_NO_TABLE = re.compile(
    r"no such table: (?:main\.)?(\w+)|Table '(?:[^'.]*\.)?([^'.]+)' doesn't exist"
    r"|command denied to user .* for table (?:`[^`]*`\.)?[`']([^`']+)[`']"
)  # SQLite; servers, and servers of which the reader has rights on what there is alone
_FILE = (
    "SELECT m.name, c.name FROM sqlite_master m, pragma_table_info(m.name) c WHERE m.type IN ('table', 'view') "
    f"AND m.name NOT LIKE 'sqlite%' AND m.name <> '{_OWN}' ORDER BY m.name, c.cid"
)
_SERVER = (
    "SELECT table_name AS t, column_name AS c FROM information_schema.columns "
    f"WHERE table_schema = DATABASE() AND table_name <> '{_OWN}' ORDER BY table_name, ordinal_position"
)


def tables_and_columns(settings: Settings) -> dict[str, tuple[str, ...]]:
    """The columns of each table and view, by its name. Raises what `run_readonly` raises."""
    file = file_of(settings)
    found: dict[str, tuple[str, ...]] = {}
    for table, column in run_readonly(settings, _SERVER)[1] if file is None else read_own(file, _FILE):
        if str(table).lower() not in HIDDEN:
            found[str(table)] = (*found.get(str(table), ()), str(column))
    return found


def ask(settings: Settings, sql: str, *, private: bool = False) -> tuple[tuple[str, ...], Generator[Row, None, None]]:
    """As `run_readonly`, and an error of a table that is not there names those that are called alike."""
    try:
        return run_readonly(settings, sql, private=private)
    except DatabaseError as error:
        missing = _NO_TABLE.search(str(error))
        if missing is None:
            raise
        try:
            known = tables_and_columns(settings)
        except SemdbError:  # the first error is the one to tell
            raise error from None
        name = next(group for group in missing.groups() if group)
        alike = difflib.get_close_matches(name, known)
        hint = f"alike are {', '.join(alike)}" if alike else "\\d in `semdb sql` lists tables and views"
        raise DatabaseError(f"{error}; {hint}") from error
