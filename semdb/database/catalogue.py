"""Which tables and views there are to ask with `semdb sql`, with their columns."""

from __future__ import annotations

from semdb.database.readonly import file_of, run_readonly
from semdb.database.readonly_sqlite import read_own
from semdb.settings import Settings

_OWN = "alembic_version"  # of the migrations, not of users
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
        found[str(table)] = (*found.get(str(table), ()), str(column))
    return found
