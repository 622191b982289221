"""Classes of keyframes as landmarks complete them.

Revision ID: 0017
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
KEYS = ("map_id", "category_id", "keyframe_id")
NUMBERS = ("count", "upper_strength", "lower_strength", "keyframe_strength")
FILTER = "ix_completed_categories_filter"
OPTIONS = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}


def upgrade() -> None:
    there = sa.inspect(op.get_bind()).get_table_names()
    if "completed_categories" not in there:  # an upgrade that was cut off on a server goes on here
        op.create_table(
            "completed_categories",
            _key("map_id", sa.ForeignKey("maps.id", ondelete="CASCADE")),
            _key("category_id", sa.ForeignKey("categories.id"), index=True),
            _key("keyframe_id", sa.ForeignKey("keyframes.id", ondelete="CASCADE"), index=True),
            *(sa.Column(name, sa.Integer, nullable=False) for name in NUMBERS),
            **OPTIONS,
        )
    if FILTER not in {found["name"] for found in sa.inspect(op.get_bind()).get_indexes("completed_categories")}:
        op.create_index(FILTER, "completed_categories", [*KEYS, *NUMBERS])
    if "map_completions" not in there:
        op.create_table(
            "map_completions",
            _key("map_id", sa.ForeignKey("maps.id", ondelete="CASCADE")),
            sa.Column("map_state", sa.String(255), nullable=False),
            **OPTIONS,
        )


def _key(name: str, foreign_key: sa.ForeignKey, *, index: bool = False) -> sa.Column[int]:
    return sa.Column(name, Id, foreign_key, nullable=False, autoincrement=False, primary_key=True, index=index)


def downgrade() -> None:
    op.drop_table("map_completions")
    op.drop_table("completed_categories")
