"""How good the image of each keyframe is.

Revision ID: 0013
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
NUMBERS = ("sharpness", "exposure", "contrast", "blur_px", "blur_deg")

KEYFRAME_QUALITY = """
    SELECT m.name AS map, r.name AS recording, k.frame_index, q.keyframe_id, q.sharpness, q.exposure, q.contrast,
        q.blur_px, q.blur_deg, p.count AS keypoints, p.count_3d AS keypoints_3d
    FROM keyframe_qualities q
    JOIN keyframes k ON k.id = q.keyframe_id
    JOIN recordings r ON r.id = k.recording_id
    JOIN maps m ON m.id = r.map_id
    JOIN keypoints p ON p.keyframe_id = q.keyframe_id
"""


def upgrade() -> None:
    foreign_key = sa.ForeignKey("keyframes.id", ondelete="CASCADE")
    op.create_table(
        "keyframe_qualities",
        sa.Column("keyframe_id", Id, foreign_key, nullable=False, autoincrement=False, primary_key=True),
        *(sa.Column(name, sa.Double, nullable=False) for name in NUMBERS),
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
    )
    security = "" if op.get_bind().dialect.name == "sqlite" else "SQL SECURITY INVOKER"
    op.execute(f"CREATE {security} VIEW keyframe_quality AS {KEYFRAME_QUALITY}")


def downgrade() -> None:
    op.execute("DROP VIEW keyframe_quality")
    op.drop_table("keyframe_qualities")
