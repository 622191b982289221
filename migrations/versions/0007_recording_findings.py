"""What a recording's images were found to contradict when it was ingested, and was not certain enough to stop it.

Revision ID: 0007
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGTEXT

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
LongText = sa.Text().with_variant(LONGTEXT(), "mysql", "mariadb")


def upgrade() -> None:
    op.create_table(
        "recording_findings",
        sa.Column(
            "recording_id",
            Id,
            sa.ForeignKey("recordings.id", ondelete="CASCADE"),
            primary_key=True,
            nullable=False,
            autoincrement=False,
        ),
        sa.Column("kind", sa.String(32), primary_key=True, nullable=False),
        sa.Column("certain", sa.Integer, nullable=False),
        sa.Column("value", sa.String(255), nullable=False),
        sa.Column("fix", sa.String(255), nullable=False),
        sa.Column("message", LongText, nullable=False),
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
    )


def downgrade() -> None:
    op.drop_table("recording_findings")
