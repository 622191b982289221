"""The log of changes, the log of queries, and the views for ad-hoc SQL.

Revision ID: 0002
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGTEXT

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
LongText = sa.Text().with_variant(LONGTEXT(), "mysql", "mariadb")

# Standard SQL only: no functions beyond COUNT, SUM, MIN, MAX, AVG and COALESCE, so both servers give the same.
# A point of the keyframe's camera frame is turned into the map's by its quaternion and moved by its translation.
VIEWS = {
    "keyframe_objects": """
        SELECT o.id AS object_id, m.name AS map, r.name AS recording, k.id AS keyframe_id, k.frame_index,
            k.timestamp_ns, o.ordinal, c.name AS category, o.score, o.x1, o.y1, o.x2, o.y2, o.pixel_area,
            COALESCE(f.count, 0) AS keypoints,
            (1 - 2 * (k.qy * k.qy + k.qz * k.qz)) * o.centroid_x + 2 * (k.qx * k.qy - k.qw * k.qz) * o.centroid_y
                + 2 * (k.qx * k.qz + k.qw * k.qy) * o.centroid_z + k.tx AS x,
            2 * (k.qx * k.qy + k.qw * k.qz) * o.centroid_x + (1 - 2 * (k.qx * k.qx + k.qz * k.qz)) * o.centroid_y
                + 2 * (k.qy * k.qz - k.qw * k.qx) * o.centroid_z + k.ty AS y,
            2 * (k.qx * k.qz - k.qw * k.qy) * o.centroid_x + 2 * (k.qy * k.qz + k.qw * k.qx) * o.centroid_y
                + (1 - 2 * (k.qx * k.qx + k.qy * k.qy)) * o.centroid_z + k.tz AS z,
            o.centroid_z AS distance
        FROM objects o
        JOIN keyframes k ON k.id = o.keyframe_id
        JOIN recordings r ON r.id = k.recording_id
        JOIN maps m ON m.id = r.map_id
        JOIN categories c ON c.id = o.category_id
        LEFT JOIN map_models mm ON mm.map_id = r.map_id AND mm.role = 'features'
        LEFT JOIN object_features f ON f.object_id = o.id AND f.model_id = mm.model_id
    """,
    "category_counts": """
        SELECT m.name AS map, c.name AS category, COUNT(*) AS objects, COUNT(DISTINCT o.keyframe_id) AS keyframes,
            COUNT(DISTINCT k.recording_id) AS recordings, AVG(o.score) AS mean_score
        FROM objects o
        JOIN keyframes k ON k.id = o.keyframe_id
        JOIN recordings r ON r.id = k.recording_id
        JOIN maps m ON m.id = r.map_id
        JOIN categories c ON c.id = o.category_id
        GROUP BY m.id, m.name, c.id, c.name
    """,
    "recording_summary": """
        SELECT r.id AS recording_id, m.name AS map, r.name AS recording, r.format, r.state, r.frame_count,
            (SELECT COUNT(*) FROM keyframes k WHERE k.recording_id = r.id) AS keyframes,
            (SELECT COUNT(*) FROM keyframes k JOIN objects o ON o.keyframe_id = k.id
                WHERE k.recording_id = r.id) AS objects,
            (SELECT COUNT(DISTINCT o.category_id) FROM keyframes k JOIN objects o ON o.keyframe_id = k.id
                WHERE k.recording_id = r.id) AS categories,
            (SELECT COALESCE(SUM(p.count), 0) FROM keyframes k JOIN keypoints p ON p.keyframe_id = k.id
                WHERE k.recording_id = r.id) AS keypoints,
            (SELECT COALESCE(SUM(i.rgb_bytes + i.depth_bytes), 0) FROM keyframes k
                JOIN keyframe_images i ON i.keyframe_id = k.id WHERE k.recording_id = r.id) AS image_bytes,
            (SELECT MIN(k.timestamp_ns) FROM keyframes k WHERE k.recording_id = r.id) AS first_timestamp_ns,
            (SELECT MAX(k.timestamp_ns) FROM keyframes k WHERE k.recording_id = r.id) AS last_timestamp_ns
        FROM recordings r
        JOIN maps m ON m.id = r.map_id
    """,
    "covisible_objects": """
        SELECT a.map, a.recording, a.keyframe_id, a.frame_index, a.object_id, a.category,
            b.object_id AS other_object_id, b.category AS other_category,
            (a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y) + (a.z - b.z) * (a.z - b.z) AS distance_squared
        FROM keyframe_objects a
        JOIN keyframe_objects b ON b.keyframe_id = a.keyframe_id AND b.object_id <> a.object_id
    """,
    "keypoint_counts": """
        SELECT k.id AS keyframe_id, m.name AS map, r.name AS recording, k.frame_index, k.timestamp_ns,
            p.count AS keypoints, p.count_3d AS keypoints_3d,
            (SELECT COALESCE(SUM(f.count), 0) FROM objects o
                JOIN object_features f ON f.object_id = o.id AND f.model_id = p.model_id
                WHERE o.keyframe_id = k.id) AS on_objects,
            (SELECT COUNT(*) FROM objects o WHERE o.keyframe_id = k.id) AS objects
        FROM keypoints p
        JOIN keyframes k ON k.id = p.keyframe_id
        JOIN recordings r ON r.id = k.recording_id
        JOIN maps m ON m.id = r.map_id
    """,
}


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


def _id() -> sa.Column[int]:
    return sa.Column("id", Id, primary_key=True, autoincrement=True)


def _ref(name: str, target: str, *, cascade: bool = True, **options: Any) -> sa.Column[int]:
    foreign_key = sa.ForeignKey(target, ondelete="CASCADE" if cascade else None)
    return sa.Column(name, Id, foreign_key, nullable=False, autoincrement=False, **options)


def _time(name: str) -> sa.Column[Any]:
    return sa.Column(name, sa.DateTime, nullable=False, server_default=sa.func.current_timestamp())


def upgrade() -> None:
    _table(
        "keyframe_changes",
        _id(),
        _ref("map_id", "maps.id"),
        sa.Column("keyframe_id", Id, nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        _time("changed_at"),
    )
    op.create_index("ix_keyframe_changes_map_id_id", "keyframe_changes", ["map_id", "id"])
    _table(
        "queries",
        _id(),
        _ref("map_id", "maps.id"),
        _time("created_at"),
        sa.Column("image", sa.Text, nullable=False),
        sa.Column("verdict", sa.String(16), nullable=False),
        *(sa.Column(name, sa.Double) for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz")),
        sa.Column("confidence", sa.Double, nullable=False),
        sa.Column("inliers", sa.Integer, nullable=False),
        sa.Column("stage", sa.String(16), nullable=False),
        sa.Column("reason", sa.Text, nullable=False),
        sa.Column("candidates", LongText, nullable=False),
        sa.Column("timing_ms", LongText, nullable=False),
    )
    op.create_index("ix_queries_map_id_created_at", "queries", ["map_id", "created_at"])
    # Keyframes that were stored before there was a log count as added now.
    op.execute(
        "INSERT INTO keyframe_changes (map_id, keyframe_id, kind) "
        "SELECT r.map_id, k.id, 'added' FROM keyframes k JOIN recordings r ON r.id = k.recording_id ORDER BY k.id"
    )
    # On a server a view otherwise runs with the rights of whoever made it, and dies with that account.
    security = "" if op.get_bind().dialect.name == "sqlite" else "SQL SECURITY INVOKER"
    for name, statement in VIEWS.items():
        op.execute(f"CREATE {security} VIEW {name} AS {statement}")


def downgrade() -> None:
    for name in reversed(VIEWS):
        op.execute(f"DROP VIEW {name}")
    op.drop_table("queries")
    op.drop_table("keyframe_changes")
