"""Which revision the schema has, and moving it: Alembic, called as a library, with scripts from inside the package."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from sqlalchemy import Connection, Engine, inspect, text
from sqlalchemy.exc import SQLAlchemyError

from semdb.database import retry
from semdb.database.engine import safe_url
from semdb.database.inspection import COLLATION, collation_of
from semdb.database.tables import metadata
from semdb.errors import SchemaError

# Ascending; the last one is what this version of semdb reads and writes. A test compares them with the scripts.
REVISIONS = (
    "0001",
    "0002",
    "0003",
    "0004",
    "0005",
    "0006",
    "0007",
    "0008",
    "0009",
    "0010",
    "0011",
    "0012",
    "0013",
    "0014",
    "0015",
    "0016",
    "0017",
    "0018",
    "0019",
)
HEAD = REVISIONS[-1]
_NOT_ALLOWED = {1044, 1142, 1227}


def current_revision(engine: Engine) -> str | None:
    """The schema's revision, None where there is no semdb schema. Raises DatabaseError."""

    def work(connection: Connection) -> str | None:
        if not inspect(connection).has_table("alembic_version"):
            return None
        revision = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
        return None if revision is None else str(revision)

    return retry.read(engine, work)


def check_schema(engine: Engine) -> None:
    """Raises SchemaError unless the schema is exactly the one that this version of semdb knows."""
    revision = current_revision(engine)
    where = safe_url(engine.url)
    if revision == HEAD:
        return
    if revision is None:
        raise SchemaError(f"there is no semdb schema in {where}: run `semdb init`")
    if revision in REVISIONS:
        raise SchemaError(
            f"the schema of {where} is revision {revision}, older than this semdb needs ({HEAD}): run `semdb init`"
        )
    raise SchemaError(
        f"the schema of {where} is revision {revision}, which this semdb does not know (it knows {HEAD}): upgrade semdb"
    )


def upgrade(engine: Engine, revision: str = HEAD) -> str | None:
    """Create the schema, or move it up to `revision`; nothing happens when it is there already.

    On SQLite all of it is one transaction. On a server the schema's collation for new tables becomes binary before
    anything is made in it; returns the one that it had, None where it was so. Raises SchemaError for a schema that is
    newer than this semdb, or holds tables of something else, or a new one whose collation the account may not change.
    """
    before = _refuse_unknown(engine)
    _refuse_others(engine)
    changed = None if engine.dialect.name == "sqlite" else _set_collation(engine, required=before is None)
    _alembic(engine, "upgrade", revision)
    return changed


def downgrade(engine: Engine, revision: str = "base") -> None:
    """Move the schema down to `revision`. ``base`` removes every table and all data. Raises SchemaError."""
    _refuse_unknown(engine)
    _alembic(engine, "downgrade", revision)


def _refuse_unknown(engine: Engine) -> str | None:
    revision = current_revision(engine)
    if revision is not None and revision not in REVISIONS:
        check_schema(engine)
    return revision


def _set_collation(engine: Engine, *, required: bool) -> str | None:
    """Makes the schema's collation binary. Returns the former one where that was another and could be changed."""
    found = retry.read(engine, collation_of)
    if found == COLLATION:
        return None
    name = engine.dialect.identifier_preparer.quote_identifier(engine.url.database or "")
    statement = f"ALTER DATABASE {name} CHARACTER SET utf8mb4 COLLATE {COLLATION}"
    try:
        with engine.connect() as connection:
            connection.exec_driver_sql(statement.replace("%", "%%"))
    except SQLAlchemyError as error:
        if retry.error_code(error) not in _NOT_ALLOWED:
            raise retry.explain(engine, error) from error
        if not required:
            return None  # its tables name their own; `semdb doctor` tells
        raise SchemaError(
            f"the schema of {safe_url(engine.url)} has the collation {found}, which takes different names for the "
            f"same, and this account may not change it; run `{statement};` as one that may, and `semdb init` again"
        ) from error
    return found


def _refuse_others(engine: Engine) -> None:
    """Raises SchemaError where no semdb is, and another program, or an upgrade that was cut off, left tables.

    A SQLite file belongs to one program; a schema of a server may be shared as long as no name is there twice.
    """
    if current_revision(engine) is not None:
        return
    there = set(retry.read(engine, lambda connection: inspect(connection).get_table_names())) - {"alembic_version"}
    in_the_way = there if engine.dialect.name == "sqlite" else there & set(metadata.tables)
    if in_the_way:
        few = ", ".join(sorted(in_the_way)[:5]) + (", ..." if len(in_the_way) > 5 else "")
        what = "file" if engine.dialect.name == "sqlite" else "schema"
        raise SchemaError(
            f"{safe_url(engine.url)} is not empty and is no semdb database (tables {few}): give semdb a {what} of its "
            "own, or drop the tables where an upgrade that was cut off left them"
        )


def _alembic(engine: Engine, command: str, revision: str) -> None:
    from alembic import command as alembic_command
    from alembic.config import Config

    config = Config()
    folder = Path(str(import_module("semdb.migrations").__file__)).parent
    config.set_main_option("script_location", str(folder).replace("%", "%%"))

    def work(connection: Connection) -> None:
        config.attributes["connection"] = connection
        getattr(alembic_command, command)(config, revision)

    if engine.dialect.name == "sqlite":
        retry.write(engine, work)
    else:  # DDL commits by itself on these servers: Alembic records each step as it is done
        try:
            with engine.connect() as connection:
                work(connection)
                connection.commit()
        except SQLAlchemyError as error:
            raise retry.explain(engine, error) from error
