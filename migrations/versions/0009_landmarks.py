"""Things that keyframes of a map show, what stands how to what, and which way is up.

Revision ID: 0009
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGBLOB, LONGTEXT

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
Blob = sa.LargeBinary().with_variant(LONGBLOB(), "mysql", "mariadb")
LongText = sa.Text().with_variant(LONGTEXT(), "mysql", "mariadb")
COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")

VIEWS = {
    "landmark_list": """
        SELECT m.name AS map, l.id AS landmark_id, c.name AS category, l.probability, l.x, l.y, l.z, l.sightings,
            l.keyframes, l.state, l.first_seen_ns, l.last_seen_ns, l.size_x, l.size_y, l.size_z, l.yaw, l.missed,
            l.seen_through, r.name AS last_recording, k.frame_index AS last_frame_index,
            l.last_keyframe_id
        FROM landmarks l
        JOIN maps m ON m.id = l.map_id
        JOIN categories c ON c.id = l.category_id
        LEFT JOIN keyframes k ON k.id = l.last_keyframe_id
        LEFT JOIN recordings r ON r.id = k.recording_id
    """,
    "landmark_relations_named": """
        SELECT m.name AS map, r.landmark_id, c.name AS category, r.kind, r.other_landmark_id,
            d.name AS other_category, r.score
        FROM landmark_relations r
        JOIN landmarks l ON l.id = r.landmark_id
        JOIN landmarks o ON o.id = r.other_landmark_id
        JOIN categories c ON c.id = l.category_id
        JOIN categories d ON d.id = o.category_id
        JOIN maps m ON m.id = l.map_id
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


def _ref(name: str, target: str, ondelete: str | None = "CASCADE", **options: Any) -> sa.Column[int]:
    foreign_key = sa.ForeignKey(target, ondelete=ondelete)
    nullable = ondelete == "SET NULL"
    return sa.Column(name, Id, foreign_key, nullable=nullable, autoincrement=False, **options)


def _real(name: str, *, nullable: bool = False) -> sa.Column[float]:
    return sa.Column(name, sa.Double, nullable=nullable)


def _count(name: str) -> sa.Column[int]:
    return sa.Column(name, sa.Integer, nullable=False)


def upgrade() -> None:
    _table(
        "map_gravity",
        _ref("map_id", "maps.id", primary_key=True),
        *(_real(f"up_{axis}") for axis in "xyz"),
        _real("up_certainty"),
        _real("floor", nullable=True),
        _real("floor_certainty"),
        _count("given"),
    )
    _table(
        "landmarks",
        sa.Column("id", Id, primary_key=True, autoincrement=True),
        _ref("map_id", "maps.id"),
        _ref("category_id", "categories.id", None, index=True),
        _real("probability"),
        sa.Column("evidence", LongText, nullable=False),
        *(_real(axis) for axis in "xyz"),
        *(_real(name) for name in COVARIANCE),
        *(_real(f"size_{axis}") for axis in "xyz"),
        _real("yaw"),
        *(_count(name) for name in ("sightings", "keyframes", "missed", "seen_through")),
        sa.Column("state", sa.String(16), nullable=False),
        _ref("first_keyframe_id", "keyframes.id", "SET NULL", index=True),
        _ref("last_keyframe_id", "keyframes.id", "SET NULL", index=True),
        sa.Column("first_seen_ns", sa.BigInteger),
        sa.Column("last_seen_ns", sa.BigInteger),
        sa.Column("appearance", Blob),
    )
    op.create_index("ix_landmarks_map_id_category_id", "landmarks", ["map_id", "category_id"])
    _table(
        "landmark_sightings",
        _ref("object_id", "objects.id", primary_key=True),
        _ref("landmark_id", "landmarks.id", index=True),
        _real("coverage"),
        _real("visibility"),
    )
    _table(
        "landmark_views",
        _ref("landmark_id", "landmarks.id", primary_key=True),
        sa.Column("place", sa.Integer, primary_key=True, autoincrement=False),
        _ref("object_id", "objects.id", index=True),
        _real("quality"),
        _real("distance"),
    )
    _table(
        "landmark_relations",
        _ref("landmark_id", "landmarks.id", primary_key=True),
        sa.Column("kind", sa.String(16), primary_key=True),
        _ref("other_landmark_id", "landmarks.id", primary_key=True),
        _real("score"),
    )
    op.create_index("ix_landmark_relations_other_landmark_id_kind", "landmark_relations", ["other_landmark_id", "kind"])
    _table(
        "landmark_merges",
        sa.Column("landmark_id", Id, primary_key=True, autoincrement=False),
        _ref("map_id", "maps.id", index=True),
        sa.Column("merged_into", Id, nullable=False),
    )
    security = "" if op.get_bind().dialect.name == "sqlite" else "SQL SECURITY INVOKER"
    for name, statement in VIEWS.items():
        op.execute(f"CREATE {security} VIEW {name} AS {statement}")


def downgrade() -> None:
    for name in reversed(VIEWS):
        op.execute(f"DROP VIEW {name}")
    for name in ("landmark_merges", "landmark_relations", "landmark_views", "landmark_sightings", "landmarks"):
        op.drop_table(name)
    op.drop_table("map_gravity")
    # steps of refine that this revision does not know
    op.execute("DELETE FROM refinements WHERE kind = 'landmarks'")
