"""What `semdb refine` computes of a whole map: when and from what, and which classes the detector confuses.

Revision ID: 0004
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGTEXT

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
LongText = sa.Text().with_variant(LONGTEXT(), "mysql", "mariadb")


def _table(name: str, *columns: Any) -> None:
    op.create_table(name, *columns, mysql_engine="InnoDB", mysql_charset="utf8mb4", mysql_collate="utf8mb4_bin")


def _ref(name: str, target: str, *, cascade: bool = True, **options: Any) -> sa.Column[int]:
    foreign_key = sa.ForeignKey(target, ondelete="CASCADE" if cascade else None)
    return sa.Column(name, Id, foreign_key, nullable=False, autoincrement=False, **options)


def upgrade() -> None:
    _table(
        "refinements",
        _ref("map_id", "maps.id", primary_key=True),
        sa.Column("kind", sa.String(32), primary_key=True),
        sa.Column("map_state", sa.String(255), nullable=False),
        sa.Column("computed_at", sa.DateTime, nullable=False, server_default=sa.func.current_timestamp()),
        sa.Column("parameters", LongText, nullable=False),
        sa.Column("row_count", sa.BigInteger, nullable=False),
    )
    _table(
        "class_confusions",
        _ref("map_id", "maps.id", primary_key=True),
        _ref("category_id", "categories.id", cascade=False, primary_key=True, index=True),
        _ref("other_category_id", "categories.id", cascade=False, primary_key=True, index=True),
        sa.Column("pairs", sa.BigInteger, nullable=False),
        sa.Column("weight", sa.Integer, nullable=False),
    )


def downgrade() -> None:
    op.drop_table("class_confusions")
    op.drop_table("refinements")
