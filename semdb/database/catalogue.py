"""Which tables and views there are to ask, with their columns, through the same door as `semdb sql`."""

from __future__ import annotations

from semdb.database.engine import parse_url, sqlite_path
from semdb.database.readonly import run_readonly
from semdb.settings import Settings

_OWN = "alembic_version"  # of the migrations, not of users
_FILE = (
    "SELECT name FROM sqlite_master WHERE type IN ('table', 'view') AND name NOT LIKE 'sqlite%' "
    f"AND name <> '{_OWN}' ORDER BY name"
)
_SERVER = (
    "SELECT table_name AS t, column_name AS c FROM information_schema.columns "
    f"WHERE table_schema = DATABASE() AND table_name <> '{_OWN}' ORDER BY table_name, ordinal_position"
)


def tables_and_columns(settings: Settings) -> dict[str, tuple[str, ...]]:
    """The columns of each table and view, by its name. Raises what `run_readonly` raises."""
    if sqlite_path(parse_url(settings.database_url)) is None:
        found: dict[str, tuple[str, ...]] = {}
        for table, column in run_readonly(settings, _SERVER)[1]:
            found[str(table)] = (*found.get(str(table), ()), str(column))
        return found
    names = [str(name) for (name,) in run_readonly(settings, _FILE)[1]]
    return {name: _columns(settings, name) for name in names}


def _columns(settings: Settings, name: str) -> tuple[str, ...]:
    quoted = '"' + name.replace('"', '""') + '"'
    columns, rows = run_readonly(settings, f"SELECT * FROM {quoted} LIMIT 0")
    rows.close()
    return columns
