"""Alembic's environment. semdb hands over an open connection; there is no alembic.ini."""

from __future__ import annotations

from alembic import context

from semdb.database.tables import metadata

connection = context.config.attributes["connection"]
context.configure(
    connection=connection,
    target_metadata=metadata,
    # On SQLite the caller has begun one transaction for all steps; on MySQL each DDL statement commits by itself.
    transactional_ddl=connection.dialect.name == "sqlite",
    transaction_per_migration=connection.dialect.name != "sqlite",
    render_as_batch=False,
)
with context.begin_transaction():
    context.run_migrations()
