"""What frames that are no keyframes show, beside the keyframes.

Revision ID: 0015
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGBLOB

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
Blob = sa.LargeBinary().with_variant(LONGBLOB(), "mysql", "mariadb")
POSE = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")


def upgrade() -> None:
    foreign_key = sa.ForeignKey("keyframes.id", ondelete="CASCADE")
    op.create_table(
        "frame_views",
        sa.Column("keyframe_id", Id, foreign_key, nullable=False, autoincrement=False, primary_key=True),
        sa.Column("frame_index", sa.Integer, nullable=False, autoincrement=False, primary_key=True),
        *(sa.Column(name, sa.Double, nullable=False) for name in POSE),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("keypoints", Blob, nullable=False),
        sa.Column("descriptors", Blob, nullable=False),
        sa.Column("grey", Blob, nullable=False),
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
    )


def downgrade() -> None:
    op.drop_table("frame_views")
