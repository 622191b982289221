"""Maps, recordings, keyframes and everything that describes them.

Revision ID: 0001
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects.mysql import LONGBLOB, LONGTEXT

revision = "0001"
down_revision: str | None = None
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
Blob = sa.LargeBinary().with_variant(LONGBLOB(), "mysql", "mariadb")
LongText = sa.Text().with_variant(LONGTEXT(), "mysql", "mariadb")


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
    _table("maps", _id(), sa.Column("name", sa.String(255), nullable=False, unique=True), _time("created_at"))

    _table(
        "models",
        _id(),
        sa.Column("role", sa.String(32), nullable=False),
        sa.Column("name", sa.String(255), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("config", LongText, nullable=False),
        sa.Column("digest", sa.String(64), nullable=False, unique=True),
    )
    _table(
        "map_models",
        _ref("map_id", "maps.id", primary_key=True),
        sa.Column("role", sa.String(32), primary_key=True),
        _ref("model_id", "models.id", cascade=False, index=True),
    )
    _table(
        "recordings",
        _id(),
        _ref("map_id", "maps.id"),
        sa.Column("name", sa.String(255), nullable=False),
        sa.Column("format", sa.String(32), nullable=False),
        sa.Column("source", sa.Text, nullable=False),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("frame_count", sa.Integer, nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        _time("created_at"),
        sa.Column("finished_at", sa.DateTime),
        sa.UniqueConstraint("map_id", "name"),
    )
    _table(
        "cameras",
        _id(),
        sa.Column("model", sa.String(32), nullable=False),
        sa.Column("width", sa.Integer, nullable=False),
        sa.Column("height", sa.Integer, nullable=False),
        sa.Column("fx", sa.Double, nullable=False),
        sa.Column("fy", sa.Double, nullable=False),
        sa.Column("cx", sa.Double, nullable=False),
        sa.Column("cy", sa.Double, nullable=False),
        sa.Column("distortion", sa.Text, nullable=False),
        sa.Column("digest", sa.String(64), nullable=False, unique=True),
    )
    _table(
        "keyframes",
        _id(),
        _ref("recording_id", "recordings.id"),
        sa.Column("frame_index", sa.Integer, nullable=False),
        sa.Column("timestamp_ns", sa.BigInteger),
        _ref("camera_id", "cameras.id", cascade=False, index=True),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz")),
        sa.UniqueConstraint("recording_id", "frame_index"),
    )
    _table(
        "keyframe_images",
        _ref("keyframe_id", "keyframes.id", primary_key=True),
        sa.Column("rgb_format", sa.String(16), nullable=False),
        sa.Column("depth_format", sa.String(16), nullable=False),
        sa.Column("depth_scale", sa.Double),
        sa.Column("depth_registration", sa.String(32), nullable=False),
        sa.Column("rgb_bytes", sa.Integer, nullable=False),
        sa.Column("depth_bytes", sa.Integer, nullable=False),
        sa.Column("rgb", Blob, nullable=False),
        sa.Column("depth", Blob),
    )
    _table(
        "cnn_vectors",
        _ref("keyframe_id", "keyframes.id", primary_key=True),
        _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
        sa.Column("vector", Blob, nullable=False),
    )
    _table("categories", _id(), sa.Column("name", sa.String(255), nullable=False, unique=True))

    _table(
        "objects",
        _id(),
        _ref("keyframe_id", "keyframes.id"),
        sa.Column("ordinal", sa.Integer, nullable=False),
        _ref("category_id", "categories.id", cascade=False, index=True),
        _ref("model_id", "models.id", cascade=False, index=True),
        sa.Column("score", sa.Double, nullable=False),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("x1", "y1", "x2", "y2")),
        sa.Column("pixel_area", sa.Integer, nullable=False),
        *(sa.Column(f"{name}_{axis}", sa.Double) for name in ("centroid", "extent") for axis in "xyz"),
        sa.Column("mask", Blob, nullable=False),
        sa.UniqueConstraint("keyframe_id", "ordinal"),
    )
    _table(
        "keyframe_categories",
        _ref("category_id", "categories.id", cascade=False, primary_key=True),
        _ref("keyframe_id", "keyframes.id", primary_key=True, index=True),
        _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
        _ref("map_id", "maps.id"),
        sa.Column("count", sa.Integer, nullable=False),
    )
    op.create_index(
        "ix_keyframe_categories_map_id_category_id_keyframe_id_count",
        "keyframe_categories",
        ["map_id", "category_id", "keyframe_id", "count"],
    )
    _table(
        "keypoints",
        _ref("keyframe_id", "keyframes.id", primary_key=True),
        _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("count_3d", sa.Integer, nullable=False),
        sa.Column("data", Blob, nullable=False),
    )
    _table(
        "descriptors",
        _ref("keyframe_id", "keyframes.id", primary_key=True),
        _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
        sa.Column("data", Blob, nullable=False),
    )
    _table(
        "object_features",
        _ref("object_id", "objects.id", primary_key=True),
        _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
        sa.Column("start", sa.Integer, nullable=False),
        sa.Column("count", sa.Integer, nullable=False),
    )
    _table(
        "ingest_items",
        _ref("recording_id", "recordings.id", primary_key=True),
        sa.Column("frame_index", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("error", sa.Text),
        sa.Column("worker", sa.String(255)),
        sa.Column("lease_until", sa.DateTime),
    )
    op.create_index("ix_ingest_items_state_lease_until", "ingest_items", ["state", "lease_until"])


def downgrade() -> None:
    for name in (
        "ingest_items",
        "object_features",
        "descriptors",
        "keypoints",
        "keyframe_categories",
        "objects",
        "categories",
        "cnn_vectors",
        "keyframe_images",
        "keyframes",
        "cameras",
        "recordings",
        "map_models",
        "models",
        "maps",
    ):
        op.drop_table(name)
