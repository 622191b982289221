"""The tables as SQLAlchemy Core sees them, for statements only: the schema itself comes from the migrations.

A test compares this metadata with a migrated database, so the two cannot drift apart. What each column means is
in docs/schema.md.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    DateTime,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    TypeDecorator,
    UniqueConstraint,
    func,
)
from sqlalchemy.dialects.mysql import LONGBLOB, LONGTEXT
from sqlalchemy.engine import Dialect

from semdb.names import storable
from semdb.storable_names import NAME_LENGTH

NAMING = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s",
    "pk": "pk_%(table_name)s",
}
metadata = MetaData(naming_convention=NAMING)


class _Bytes(LargeBinary):
    """Blobs as the driver gives them: what SQLite may have in their columns is looked at where it is used."""

    def result_processor(self, dialect: Any, coltype: Any) -> None:
        return None


class _Moment(TypeDecorator[Any]):
    """Times; what is none comes as it is, and is looked at where it is used."""

    impl = DateTime
    cache_ok = True

    def result_processor(self, dialect: Any, coltype: Any) -> Any:
        return _as_moment if dialect.name == "sqlite" else None


def _as_moment(value: Any) -> Any:
    try:
        return datetime.fromisoformat(value)
    except (TypeError, ValueError):
        return value


# SQLite counts rows up only in a column of type INTEGER; MySQL's BLOB ends at 64 KiB, its TEXT too.
Id = BigInteger().with_variant(Integer(), "sqlite")
Blob = _Bytes().with_variant(LONGBLOB(), "mysql", "mariadb")


class Name(TypeDecorator[str]):
    """Text from outside, of at most so many characters where it has a length.

    File names on Linux are bytes, and Python reads those that are no UTF-8 as lone surrogates, which no server takes.
    """

    impl = String
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """What is sent to the server."""
        return value if value is None else storable(value)


class Words(Name):
    """As `Name`, of any length."""

    impl = Text
    cache_ok = True


LongText = Text().with_variant(LONGTEXT(), "mysql", "mariadb")
POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
STRENGTH_COLUMNS = ("upper_strength", "lower_strength", "keyframe_strength")


def _table(name: str, *columns: Any) -> Table:
    """A table with the options of both servers: InnoDB, binary collation, row ids that are never used twice."""
    return Table(
        name,
        metadata,
        *columns,
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
        sqlite_autoincrement=any(isinstance(c, Column) and c.primary_key and c.name == "id" for c in columns),
    )


def _id() -> Column[int]:
    return Column("id", Id, primary_key=True, autoincrement=True)


def _ref(name: str, target: str, *, cascade: bool = True, nullable: bool = False, **options: Any) -> Column[int]:
    foreign_key = ForeignKey(target, ondelete="CASCADE" if cascade else None)
    return Column(name, Id, foreign_key, nullable=nullable, autoincrement=False, **options)


def _maybe(name: str, target: str) -> Column[int]:
    """What a row refers to while it is there."""
    return Column(name, Id, ForeignKey(target, ondelete="SET NULL"), autoincrement=False, index=True)


def _time(name: str) -> Column[Any]:
    return Column(name, _Moment, nullable=False, server_default=func.current_timestamp())


def _pose(prefix: str = "") -> list[Column[Any]]:
    return [Column(f"{prefix}{name}", Double, nullable=False) for name in POSE_COLUMNS]


def _link() -> list[Column[Any]]:
    """The pose of another keyframe in the frame of one, and why it is believed."""
    return [
        *_pose(),
        Column("information", Blob, nullable=False),
        Column("inliers", Integer, nullable=False),
        Column("state", String(16), nullable=False),
        Column("reason", Words, nullable=False),
        Column("provenance", String(NAME_LENGTH), nullable=False),
    ]


maps = _table("maps", _id(), Column("name", Name(NAME_LENGTH), nullable=False, unique=True), _time("created_at"))

models = _table(
    "models",
    _id(),
    Column("role", String(32), nullable=False),
    Column("name", String(NAME_LENGTH), nullable=False),
    Column("sha256", String(64), nullable=False),
    Column("config", LongText, nullable=False),
    Column("digest", String(64), nullable=False, unique=True),
)

map_models = _table(
    "map_models",
    _ref("map_id", "maps.id", primary_key=True),
    Column("role", String(32), primary_key=True),
    _ref("model_id", "models.id", cascade=False, index=True),
)

recordings = _table(
    "recordings",
    _id(),
    _ref("map_id", "maps.id"),
    Column("name", Name(NAME_LENGTH), nullable=False),
    Column("format", String(32), nullable=False),
    Column("source", Words, nullable=False),
    Column("fingerprint", String(64), nullable=False),
    Column("frame_count", Integer, nullable=False),
    Column("state", String(16), nullable=False),
    _time("created_at"),
    Column("finished_at", _Moment),
    UniqueConstraint("map_id", "name"),
)

recording_findings = _table(
    "recording_findings",
    _ref("recording_id", "recordings.id", primary_key=True),
    Column("kind", String(32), primary_key=True),
    Column("certain", Integer, nullable=False),
    Column("value", String(NAME_LENGTH), nullable=False),
    Column("fix", String(NAME_LENGTH), nullable=False),
    Column("message", LongText, nullable=False),
)

pose_errors = _table(
    "pose_errors",
    _ref("recording_id", "recordings.id", primary_key=True),
    *(
        Column(name, Double, nullable=False)
        for name in ("position_m", "position_freedom", "rotation_rad", "rotation_freedom")
    ),
    Column("keyframes", Integer, nullable=False),
    _time("measured_at"),
)

cameras = _table(
    "cameras",
    _id(),
    Column("model", String(32), nullable=False),
    Column("width", Integer, nullable=False),
    Column("height", Integer, nullable=False),
    Column("fx", Double, nullable=False),
    Column("fy", Double, nullable=False),
    Column("cx", Double, nullable=False),
    Column("cy", Double, nullable=False),
    Column("distortion", Text, nullable=False),
    Column("digest", String(64), nullable=False, unique=True),
)

keyframes = _table(
    "keyframes",
    _id(),
    _ref("recording_id", "recordings.id"),
    Column("frame_index", Integer, nullable=False),
    Column("timestamp_ns", BigInteger),
    _ref("camera_id", "cameras.id", cascade=False, index=True),
    *_pose(),
    UniqueConstraint("recording_id", "frame_index"),
)

keyframe_images = _table(
    "keyframe_images",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    Column("rgb_format", String(16), nullable=False),
    Column("depth_format", String(16), nullable=False),
    Column("depth_scale", Double),
    Column("depth_registration", String(32), nullable=False),
    Column("rgb_bytes", Integer, nullable=False),
    Column("depth_bytes", Integer, nullable=False),
    Column("rgb", Blob, nullable=False),
    Column("depth", Blob),
)

cnn_vectors = _table(
    "cnn_vectors",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("vector", Blob, nullable=False),
)

categories = _table("categories", _id(), Column("name", String(NAME_LENGTH), nullable=False, unique=True))

objects = _table(
    "objects",
    _id(),
    _ref("keyframe_id", "keyframes.id"),
    Column("ordinal", Integer, nullable=False),
    _ref("category_id", "categories.id", cascade=False, index=True),
    _ref("model_id", "models.id", cascade=False, index=True),
    Column("score", Double, nullable=False),
    *(Column(name, Double, nullable=False) for name in ("x1", "y1", "x2", "y2")),
    Column("pixel_area", Integer, nullable=False),
    *(Column(f"{name}_{axis}", Double) for name in ("centroid", "extent") for axis in "xyz"),
    Column("mask", Blob, nullable=False),
    UniqueConstraint("keyframe_id", "ordinal"),
)

# map_id is repeated here so that the class filter reads this table alone; the index covers it.
keyframe_categories = _table(
    "keyframe_categories",
    _ref("category_id", "categories.id", cascade=False, primary_key=True),
    _ref("keyframe_id", "keyframes.id", primary_key=True, index=True),
    _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
    _ref("map_id", "maps.id"),
    Column("count", Integer, nullable=False),
    *(Column(name, Integer, nullable=False, server_default="0") for name in STRENGTH_COLUMNS),
    Index("ix_keyframe_categories_filter", "map_id", "category_id", "keyframe_id", "count", *STRENGTH_COLUMNS),
)

keypoints = _table(
    "keypoints",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("count", Integer, nullable=False),
    Column("count_3d", Integer, nullable=False),
    Column("data", Blob, nullable=False),
)

descriptors = _table(
    "descriptors",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("data", Blob, nullable=False),
)

object_features = _table(
    "object_features",
    _ref("object_id", "objects.id", primary_key=True),
    _ref("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("start", Integer, nullable=False),
    Column("count", Integer, nullable=False),
)

ingest_items = _table(
    "ingest_items",
    _ref("recording_id", "recordings.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True, autoincrement=False),
    Column("state", String(16), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("error", Words),
    Column("worker", String(NAME_LENGTH)),
    Column("lease_until", _Moment),
    Index(None, "state", "lease_until"),
    Index(None, "state", "recording_id", "frame_index"),
)

keyframe_changes = _table(
    "keyframe_changes",
    _id(),
    _ref("map_id", "maps.id"),
    Column("keyframe_id", Id, nullable=False),
    Column("kind", String(16), nullable=False),
    _time("changed_at"),
    Index(None, "map_id", "id"),
)

queries = _table(
    "queries",
    _id(),
    _ref("map_id", "maps.id"),
    _time("created_at"),
    Column("image", Words, nullable=False),
    Column("verdict", String(16), nullable=False),
    *(Column(name, Double) for name in POSE_COLUMNS),
    Column("confidence", Double, nullable=False),
    Column("inliers", Integer, nullable=False),
    Column("stage", String(16), nullable=False),
    Column("reason", Words, nullable=False),
    Column("candidates", LongText, nullable=False),
    Column("timing_ms", LongText, nullable=False),
    Index(None, "map_id", "created_at"),
)

refinements = _table(
    "refinements",
    _ref("map_id", "maps.id", primary_key=True),
    Column("kind", String(32), primary_key=True),
    Column("map_state", String(NAME_LENGTH), nullable=False),
    _time("computed_at"),
    Column("parameters", LongText, nullable=False),
    Column("row_count", BigInteger, nullable=False),
)

class_confusions = _table(
    "class_confusions",
    _ref("map_id", "maps.id", primary_key=True),
    _ref("category_id", "categories.id", cascade=False, primary_key=True, index=True),
    _ref("other_category_id", "categories.id", cascade=False, primary_key=True, index=True),
    Column("pairs", BigInteger, nullable=False),
    Column("weight", Integer, nullable=False),
)

refined_points = _table(
    "refined_points",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    Column("count", Integer, nullable=False),
    Column("fused", Integer, nullable=False),
    Column("triangulated", Integer, nullable=False),
    Column("data", Blob, nullable=False),
)

pose_sources = _table(
    "pose_sources",
    _ref("recording_id", "recordings.id", primary_key=True),
    Column("pose_source", String(16), nullable=False),
    Column("world", String(32), nullable=False),
    Column("upright", Integer),
    *_pose(),
)

planned_poses = _table(
    "planned_poses",
    _ref("recording_id", "recordings.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True, autoincrement=False),
    *_pose(),
    Column("covariance", Blob),
)

planned_links = _table(
    "planned_links",
    _ref("recording_id", "recordings.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True, autoincrement=False),
    Column("other_frame_index", Integer, primary_key=True, autoincrement=False),
    Column("kind", String(16), primary_key=True),
    *_link(),
)

pose_covariances = _table(
    "pose_covariances",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    Column("data", Blob, nullable=False),
)

keyframe_qualities = _table(
    "keyframe_qualities",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    *(Column(name, Double, nullable=False) for name in ("sharpness", "exposure", "contrast", "blur_px", "blur_deg")),
)

loop_closures = _table(
    "loop_closures",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    _ref("other_keyframe_id", "keyframes.id", primary_key=True, index=True),
    Column("kind", String(16), primary_key=True),
    *_link(),
)

pose_operations = _table(
    "pose_operations",
    _id(),
    Column("kind", String(16), nullable=False),
    _ref("map_id", "maps.id", index=True),
    _ref("recording_id", "recordings.id", nullable=True, index=True),
    Column("from_map_id", BigInteger),
    Column("from_map", Name(NAME_LENGTH)),
    Column("from_name", Name(NAME_LENGTH)),
    Column("parameters", LongText, nullable=False),
    _time("created_at"),
    Column("undone_at", _Moment),
)

pose_revisions = _table(
    "pose_revisions",
    _ref("keyframe_id", "keyframes.id", primary_key=True),
    _ref("operation_id", "pose_operations.id", primary_key=True, index=True),
    *_pose("before_"),
    *_pose("after_"),
    _time("changed_at"),
)

map_gravity = _table(
    "map_gravity",
    _ref("map_id", "maps.id", primary_key=True),
    *(Column(f"up_{axis}", Double, nullable=False) for axis in "xyz"),
    Column("up_certainty", Double, nullable=False),
    Column("floor", Double),
    Column("floor_certainty", Double, nullable=False),
    Column("given", Integer, nullable=False),
)

COVARIANCE_COLUMNS = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")

landmarks = _table(
    "landmarks",
    _id(),
    _ref("map_id", "maps.id"),
    _ref("category_id", "categories.id", cascade=False, index=True),
    Column("probability", Double, nullable=False),
    Column("evidence", LongText, nullable=False),
    *(Column(name, Double, nullable=False) for name in ("x", "y", "z", *COVARIANCE_COLUMNS)),
    *(Column(name, Double, nullable=False) for name in ("size_x", "size_y", "size_z", "yaw")),
    *(Column(name, Integer, nullable=False) for name in ("sightings", "keyframes", "missed", "seen_through")),
    Column("state", String(16), nullable=False),
    _maybe("first_keyframe_id", "keyframes.id"),
    _maybe("last_keyframe_id", "keyframes.id"),
    Column("first_seen_ns", BigInteger),
    Column("last_seen_ns", BigInteger),
    Column("appearance", Blob),
    Index(None, "map_id", "category_id"),
    Index(None, "category_id", "state", "map_id", "probability", "x", "y", "z"),
)

landmark_sightings = _table(
    "landmark_sightings",
    _ref("object_id", "objects.id", primary_key=True),
    _ref("landmark_id", "landmarks.id", index=True),
    Column("coverage", Double, nullable=False),
    Column("visibility", Double, nullable=False),
)

landmark_views = _table(
    "landmark_views",
    _ref("landmark_id", "landmarks.id", primary_key=True),
    Column("place", Integer, primary_key=True, autoincrement=False),
    _ref("object_id", "objects.id", index=True),
    Column("quality", Double, nullable=False),
    Column("distance", Double, nullable=False),
)

landmark_visits = _table(
    "landmark_visits",
    _ref("landmark_id", "landmarks.id", primary_key=True),
    _ref("recording_id", "recordings.id", primary_key=True, index=True),
    Column("presence", String(16), nullable=False),
    *(
        Column(name, Integer, nullable=False)
        for name in ("keyframes", "points", "seen", "seen_through", "occluded", "missed")
    ),
    *(Column(name, Double) for name in ("x", "y", "z", "size_x", "size_y", "size_z")),
)

landmark_relations = _table(
    "landmark_relations",
    _ref("landmark_id", "landmarks.id", primary_key=True),
    Column("kind", String(16), primary_key=True),
    _ref("other_landmark_id", "landmarks.id", primary_key=True),
    Column("score", Double, nullable=False),
    Column("other_category_id", Id),
    Index(None, "other_landmark_id", "kind"),
    Index(None, "landmark_id", "other_category_id", "kind", "score"),
)

landmark_merges = _table(
    "landmark_merges",
    Column("landmark_id", Id, primary_key=True, autoincrement=False),
    _ref("map_id", "maps.id", index=True),
    Column("merged_into", Id, nullable=False),
)

access_tokens = _table(  # never shown to those who ask with SQL
    "access_tokens",
    _id(),
    Column("name", Name(NAME_LENGTH), nullable=False),
    Column("role", String(16), nullable=False),
    _ref("map_id", "maps.id", nullable=True, index=True),
    Column("hash", String(64), nullable=False, unique=True),
    _time("created_at"),
    Column("expires_at", _Moment),
    Column("revoked_at", _Moment),
)

service_jobs = _table(  # nor is this
    "service_jobs",
    _id(),
    Column("map", Name(NAME_LENGTH), nullable=False),
    Column("who", String(64), nullable=False),
    Column("state", String(16), nullable=False),
    Column("request", LongText, nullable=False),
    Column("result", LongText, nullable=False),
    Column("error", Words),
    Column("attempts", Integer, nullable=False),
    _time("created_at"),
    Column("finished_at", _Moment),
    Column("lease_until", _Moment),
    Index(None, "state", "id"),
)
