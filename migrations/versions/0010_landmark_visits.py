"""What each recording of a map says of its landmarks: there, not there, or not looked at.

Revision ID: 0010
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
COUNTS = ("keyframes", "points", "seen", "seen_through", "occluded", "missed")

LANDMARK_VISIT_LIST = """
    SELECT m.name AS map, v.landmark_id, c.name AS category, l.state, r.name AS recording, v.presence, v.keyframes,
        v.points, v.seen, v.seen_through, v.occluded, v.missed, v.x, v.y, v.z, v.size_x, v.size_y, v.size_z
    FROM landmark_visits v
    JOIN landmarks l ON l.id = v.landmark_id
    JOIN categories c ON c.id = l.category_id
    JOIN recordings r ON r.id = v.recording_id
    JOIN maps m ON m.id = l.map_id
"""


def _ref(name: str, target: str, **options: Any) -> sa.Column[int]:
    foreign_key = sa.ForeignKey(target, ondelete="CASCADE")
    return sa.Column(name, Id, foreign_key, nullable=False, autoincrement=False, **options)


def upgrade() -> None:
    op.create_table(
        "landmark_visits",
        _ref("landmark_id", "landmarks.id", primary_key=True),
        _ref("recording_id", "recordings.id", primary_key=True, index=True),
        sa.Column("presence", sa.String(16), nullable=False),
        *(sa.Column(name, sa.Integer, nullable=False) for name in COUNTS),
        *(sa.Column(name, sa.Double) for name in ("x", "y", "z", "size_x", "size_y", "size_z")),
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
    )
    security = "" if op.get_bind().dialect.name == "sqlite" else "SQL SECURITY INVOKER"
    op.execute(f"CREATE {security} VIEW landmark_visit_list AS {LANDMARK_VISIT_LIST}")


def downgrade() -> None:
    op.execute("DROP VIEW landmark_visit_list")
    op.drop_table("landmark_visits")
