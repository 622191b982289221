"""Where poses come from, what ties keyframes together, and poses before and after they were moved.

Revision ID: 0008
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGBLOB, LONGTEXT

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
Blob = sa.LargeBinary().with_variant(LONGBLOB(), "mysql", "mariadb")
LongText = sa.Text().with_variant(LONGTEXT(), "mysql", "mariadb")
POSE = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")

# Standard SQL only; a root is not, so lengths are squared.
KEYFRAME_LINKS = """
    SELECT m.name AS map, r.name AS recording, k.frame_index, o.name AS other_recording,
        p.frame_index AS other_frame_index, l.kind, l.state, l.inliers, l.tx, l.ty, l.tz,
        l.tx * l.tx + l.ty * l.ty + l.tz * l.tz AS distance_squared,
        l.reason, l.provenance, l.keyframe_id, l.other_keyframe_id
    FROM loop_closures l
    JOIN keyframes k ON k.id = l.keyframe_id
    JOIN recordings r ON r.id = k.recording_id
    JOIN maps m ON m.id = r.map_id
    JOIN keyframes p ON p.id = l.other_keyframe_id
    JOIN recordings o ON o.id = p.recording_id
"""


def _table(name: str, *columns: Any) -> None:
    counted = any(isinstance(column, sa.Column) and column.primary_key and column.name == "id" for column in columns)
    op.create_table(
        name,
        *columns,
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
        sqlite_autoincrement=counted,
    )


def _ref(name: str, target: str, *, nullable: bool = False, **options: Any) -> sa.Column[int]:
    foreign_key = sa.ForeignKey(target, ondelete="CASCADE")
    return sa.Column(name, Id, foreign_key, nullable=nullable, autoincrement=False, **options)


def _time(name: str) -> sa.Column[Any]:
    return sa.Column(name, sa.DateTime, nullable=False, server_default=sa.func.current_timestamp())


def _pose(prefix: str = "") -> list[sa.Column[Any]]:
    return [sa.Column(f"{prefix}{name}", sa.Double, nullable=False) for name in POSE]


def _link() -> list[sa.Column[Any]]:
    return [
        *_pose(),
        sa.Column("information", Blob, nullable=False),
        sa.Column("inliers", sa.Integer, nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("provenance", sa.String(255), nullable=False),
    ]


def upgrade() -> None:
    _table(
        "pose_sources",
        _ref("recording_id", "recordings.id", primary_key=True),
        sa.Column("pose_source", sa.String(16), nullable=False),
        sa.Column("world", sa.String(32), nullable=False),
        sa.Column("upright", sa.Integer),
        *_pose(),
    )
    # What is there was recorded, in the frame that it is stored in.
    op.execute(
        "INSERT INTO pose_sources (recording_id, pose_source, world, qw, qx, qy, qz, tx, ty, tz) "
        "SELECT id, 'recorded', 'recording', 1, 0, 0, 0, 0, 0, 0 FROM recordings"
    )
    _table(
        "planned_poses",
        _ref("recording_id", "recordings.id", primary_key=True),
        sa.Column("frame_index", sa.Integer, primary_key=True, autoincrement=False),
        *_pose(),
        sa.Column("covariance", Blob),
    )
    _table(
        "planned_links",
        _ref("recording_id", "recordings.id", primary_key=True),
        sa.Column("frame_index", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("other_frame_index", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("kind", sa.String(16), primary_key=True),
        *_link(),
    )
    _table(
        "pose_covariances",
        _ref("keyframe_id", "keyframes.id", primary_key=True),
        sa.Column("data", Blob, nullable=False),
    )
    _table(
        "loop_closures",
        _ref("keyframe_id", "keyframes.id", primary_key=True),
        _ref("other_keyframe_id", "keyframes.id", primary_key=True, index=True),
        sa.Column("kind", sa.String(16), primary_key=True),
        *_link(),
    )
    _table(
        "pose_operations",
        sa.Column("id", Id, primary_key=True, autoincrement=True),
        sa.Column("kind", sa.String(16), nullable=False),
        _ref("map_id", "maps.id", index=True),
        _ref("recording_id", "recordings.id", nullable=True, index=True),
        sa.Column("from_map_id", sa.BigInteger),
        sa.Column("from_map", sa.String(255)),
        sa.Column("from_name", sa.String(255)),
        sa.Column("parameters", LongText, nullable=False),
        _time("created_at"),
        sa.Column("undone_at", sa.DateTime),
    )
    _table(
        "pose_revisions",
        _ref("keyframe_id", "keyframes.id", primary_key=True),
        _ref("operation_id", "pose_operations.id", primary_key=True, index=True),
        *_pose("before_"),
        *_pose("after_"),
        _time("changed_at"),
    )
    # On a server a view otherwise runs with the rights of whoever made it, and dies with that account.
    security = "" if op.get_bind().dialect.name == "sqlite" else "SQL SECURITY INVOKER"
    op.execute(f"CREATE {security} VIEW keyframe_links AS {KEYFRAME_LINKS}")


def downgrade() -> None:
    op.execute("DROP VIEW keyframe_links")
    for name in (
        "pose_revisions",
        "pose_operations",
        "loop_closures",
        "pose_covariances",
        "planned_links",
        "planned_poses",
        "pose_sources",
    ):
        op.drop_table(name)
