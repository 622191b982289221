"""Relations know the class of the landmark itself and its map: what of one class stands so to another is one range.

Revision ID: 0019
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

TABLE = "landmark_relations"
Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
COLUMNS = ("category_id", "map_id")  # of the landmark
PAIR = "ix_landmark_relations_pair"
OTHER = "ix_landmark_relations_other"
INDEXES = {
    PAIR: ["category_id", "other_category_id", "map_id", "kind", "landmark_id", "score"],
    OTHER: ["other_landmark_id", "category_id", "kind", "landmark_id", "score"],
}
BEFORE = "ix_landmark_relations_other_landmark_id_kind"


def upgrade() -> None:
    there = _columns()
    for name in COLUMNS:  # an upgrade that was cut off on a server goes on here
        if name not in there:
            op.add_column(TABLE, sa.Column(name, Id, nullable=True))
    values = ", ".join(
        f"{name} = (SELECT l.{name} FROM landmarks l WHERE l.id = {TABLE}.landmark_id)" for name in COLUMNS
    )
    op.execute(f"UPDATE {TABLE} SET {values}")
    known = _indexes()
    for name, columns in INDEXES.items():
        if name not in known:
            op.create_index(name, TABLE, columns)
    if BEFORE in known:  # after the one that takes its place: the foreign key wants one
        op.drop_index(BEFORE, TABLE)


def downgrade() -> None:
    known = _indexes()  # one that was cut off on a server goes on here, too
    if BEFORE not in known:
        op.create_index(BEFORE, TABLE, ["other_landmark_id", "kind"])
    for name in INDEXES:
        if name in known:
            op.drop_index(name, TABLE)
    there = _columns()
    for name in COLUMNS:
        if name in there:
            op.drop_column(TABLE, name)


def _columns() -> set[str]:
    return {column["name"] for column in sa.inspect(op.get_bind()).get_columns(TABLE)}


def _indexes() -> set[str | None]:
    return {found["name"] for found in sa.inspect(op.get_bind()).get_indexes(TABLE)}
