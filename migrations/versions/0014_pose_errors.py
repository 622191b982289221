"""How far the poses of a recording are off its images.

Revision ID: 0014
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
NUMBERS = ("position_m", "position_freedom", "rotation_rad", "rotation_freedom")

RECORDING_POSE_ERRORS = """
    SELECT m.name AS map, r.name AS recording, e.position_m * 1000 AS position_mm, e.position_freedom,
        e.rotation_rad * 57.29577951308232 AS rotation_deg, e.rotation_freedom, e.keyframes, e.measured_at
    FROM pose_errors e
    JOIN recordings r ON r.id = e.recording_id
    JOIN maps m ON m.id = r.map_id
"""


def upgrade() -> None:
    foreign_key = sa.ForeignKey("recordings.id", ondelete="CASCADE")
    op.create_table(
        "pose_errors",
        sa.Column("recording_id", Id, foreign_key, nullable=False, autoincrement=False, primary_key=True),
        *(sa.Column(name, sa.Double, nullable=False) for name in NUMBERS),
        sa.Column("keyframes", sa.Integer, nullable=False),
        sa.Column("measured_at", sa.DateTime, nullable=False, server_default=sa.func.current_timestamp()),
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
    )
    security = "" if op.get_bind().dialect.name == "sqlite" else "SQL SECURITY INVOKER"
    op.execute(f"CREATE {security} VIEW recording_pose_errors AS {RECORDING_POSE_ERRORS}")


def downgrade() -> None:
    op.execute("DROP VIEW recording_pose_errors")
    op.drop_table("pose_errors")
