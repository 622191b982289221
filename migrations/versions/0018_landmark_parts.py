"""What refine remembers of the computation of landmarks.

Revision ID: 0018
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGBLOB

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
Blob = sa.LargeBinary().with_variant(LONGBLOB(), "mysql", "mariadb")


def upgrade() -> None:
    if "landmark_parts" in sa.inspect(op.get_bind()).get_table_names():
        return  # an upgrade that was cut off on a server goes on here
    op.create_table(
        "landmark_parts",
        sa.Column(
            "map_id",
            Id,
            sa.ForeignKey("maps.id", ondelete="CASCADE"),
            nullable=False,
            autoincrement=False,
            primary_key=True,
        ),
        sa.Column("kind", sa.String(16), primary_key=True),
        sa.Column("name", sa.String(40), primary_key=True),
        sa.Column("size", sa.Integer, nullable=False),
        sa.Column("data", Blob, nullable=False),
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
    )


def downgrade() -> None:
    op.drop_table("landmark_parts")
