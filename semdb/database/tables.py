"""The tables as SQLAlchemy Core sees them, for statements only: the schema itself comes from the migrations.

A test compares this metadata with a migrated database, so the two cannot drift apart. What each column means is
in docs/schema.md.
"""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Double, Index, Integer, String, Text, UniqueConstraint

from semdb.database import landmark_tables
from semdb.database.columns import (
    POSE_COLUMNS,
    STRENGTH_COLUMNS,
    Blob,
    Id,
    LongText,
    Moment,
    Name,
    Words,
    link_columns,
    moment,
    pose_columns,
    reference,
    row_id,
    table,
)
from semdb.storable_names import NAME_LENGTH

metadata = landmark_tables.metadata  # of these and those

maps = table("maps", row_id(), Column("name", Name(NAME_LENGTH), nullable=False, unique=True), moment("created_at"))

models = table(
    "models",
    row_id(),
    Column("role", String(32), nullable=False),
    Column("name", String(NAME_LENGTH), nullable=False),
    Column("sha256", String(64), nullable=False),
    Column("config", LongText, nullable=False),
    Column("digest", String(64), nullable=False, unique=True),
)

map_models = table(
    "map_models",
    reference("map_id", "maps.id", primary_key=True),
    Column("role", String(32), primary_key=True),
    reference("model_id", "models.id", cascade=False, index=True),
)

recordings = table(
    "recordings",
    row_id(),
    reference("map_id", "maps.id"),
    Column("name", Name(NAME_LENGTH), nullable=False),
    Column("format", String(32), nullable=False),
    Column("source", Words, nullable=False),
    Column("fingerprint", String(64), nullable=False),
    Column("frame_count", Integer, nullable=False),
    Column("state", String(16), nullable=False),
    moment("created_at"),
    Column("finished_at", Moment),
    UniqueConstraint("map_id", "name"),
)

recording_findings = table(
    "recording_findings",
    reference("recording_id", "recordings.id", primary_key=True),
    Column("kind", String(32), primary_key=True),
    Column("certain", Integer, nullable=False),
    Column("value", String(NAME_LENGTH), nullable=False),
    Column("fix", String(NAME_LENGTH), nullable=False),
    Column("message", LongText, nullable=False),
)

pose_errors = table(
    "pose_errors",
    reference("recording_id", "recordings.id", primary_key=True),
    *(
        Column(name, Double, nullable=False)
        for name in ("position_m", "position_freedom", "rotation_rad", "rotation_freedom")
    ),
    Column("keyframes", Integer, nullable=False),
    moment("measured_at"),
)

cameras = table(
    "cameras",
    row_id(),
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

keyframes = table(
    "keyframes",
    row_id(),
    reference("recording_id", "recordings.id"),
    Column("frame_index", Integer, nullable=False),
    Column("timestamp_ns", BigInteger),
    reference("camera_id", "cameras.id", cascade=False, index=True),
    *pose_columns(),
    UniqueConstraint("recording_id", "frame_index"),
)

keyframe_images = table(
    "keyframe_images",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    Column("rgb_format", String(16), nullable=False),
    Column("depth_format", String(16), nullable=False),
    Column("depth_scale", Double),
    Column("depth_registration", String(32), nullable=False),
    Column("rgb_bytes", Integer, nullable=False),
    Column("depth_bytes", Integer, nullable=False),
    Column("rgb", Blob, nullable=False),
    Column("depth", Blob),
)

cnn_vectors = table(
    "cnn_vectors",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    reference("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("vector", Blob, nullable=False),
)

categories = table("categories", row_id(), Column("name", String(NAME_LENGTH), nullable=False, unique=True))

objects = table(
    "objects",
    row_id(),
    reference("keyframe_id", "keyframes.id"),
    Column("ordinal", Integer, nullable=False),
    reference("category_id", "categories.id", cascade=False, index=True),
    reference("model_id", "models.id", cascade=False, index=True),
    Column("score", Double, nullable=False),
    *(Column(name, Double, nullable=False) for name in ("x1", "y1", "x2", "y2")),
    Column("pixel_area", Integer, nullable=False),
    *(Column(f"{name}_{axis}", Double) for name in ("centroid", "extent") for axis in "xyz"),
    Column("mask", Blob, nullable=False),
    UniqueConstraint("keyframe_id", "ordinal"),
)

# map_id is repeated here so that the class filter reads this table alone; the index covers it.
keyframe_categories = table(
    "keyframe_categories",
    reference("category_id", "categories.id", cascade=False, primary_key=True),
    reference("keyframe_id", "keyframes.id", primary_key=True, index=True),
    reference("model_id", "models.id", cascade=False, primary_key=True, index=True),
    reference("map_id", "maps.id"),
    Column("count", Integer, nullable=False),
    *(Column(name, Integer, nullable=False, server_default="0") for name in STRENGTH_COLUMNS),
    Index("ix_keyframe_categories_filter", "map_id", "category_id", "keyframe_id", "count", *STRENGTH_COLUMNS),
)

# As keyframe_categories, with what keyframes should have seen by landmarks. A map has rows of all keyframes, or none.
completed_categories = table(
    "completed_categories",
    reference("map_id", "maps.id", primary_key=True),
    reference("category_id", "categories.id", cascade=False, primary_key=True, index=True),
    reference("keyframe_id", "keyframes.id", primary_key=True, index=True),
    *(Column(name, Integer, nullable=False) for name in ("count", *STRENGTH_COLUMNS)),
    Index("ix_completed_categories_filter", "map_id", "category_id", "keyframe_id", "count", *STRENGTH_COLUMNS),
)

map_completions = table(
    "map_completions",
    reference("map_id", "maps.id", primary_key=True),
    Column("map_state", String(NAME_LENGTH), nullable=False),
)

keypoints = table(
    "keypoints",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    reference("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("count", Integer, nullable=False),
    Column("count_3d", Integer, nullable=False),
    Column("data", Blob, nullable=False),
)

descriptors = table(
    "descriptors",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    reference("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("data", Blob, nullable=False),
)

object_features = table(
    "object_features",
    reference("object_id", "objects.id", primary_key=True),
    reference("model_id", "models.id", cascade=False, primary_key=True, index=True),
    Column("start", Integer, nullable=False),
    Column("count", Integer, nullable=False),
)

ingest_items = table(
    "ingest_items",
    reference("recording_id", "recordings.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True, autoincrement=False),
    Column("state", String(16), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("error", Words),
    Column("worker", String(NAME_LENGTH)),
    Column("lease_until", Moment),
    Index(None, "state", "lease_until"),
    Index(None, "state", "recording_id", "frame_index"),
)

keyframe_changes = table(
    "keyframe_changes",
    row_id(),
    reference("map_id", "maps.id"),
    Column("keyframe_id", Id, nullable=False),
    Column("kind", String(16), nullable=False),
    moment("changed_at"),
    Index(None, "map_id", "id"),
)

queries = table(
    "queries",
    row_id(),
    reference("map_id", "maps.id"),
    moment("created_at"),
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

refinements = table(
    "refinements",
    reference("map_id", "maps.id", primary_key=True),
    Column("kind", String(32), primary_key=True),
    Column("map_state", String(NAME_LENGTH), nullable=False),
    moment("computed_at"),
    Column("parameters", LongText, nullable=False),
    Column("row_count", BigInteger, nullable=False),
)

class_confusions = table(
    "class_confusions",
    reference("map_id", "maps.id", primary_key=True),
    reference("category_id", "categories.id", cascade=False, primary_key=True, index=True),
    reference("other_category_id", "categories.id", cascade=False, primary_key=True, index=True),
    Column("pairs", BigInteger, nullable=False),
    Column("weight", Integer, nullable=False),
)

refined_points = table(
    "refined_points",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    Column("count", Integer, nullable=False),
    Column("fused", Integer, nullable=False),
    Column("triangulated", Integer, nullable=False),
    Column("data", Blob, nullable=False),
)

frame_views = table(
    "frame_views",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True, autoincrement=False),
    *pose_columns(),
    Column("count", Integer, nullable=False),
    *(Column(name, Blob, nullable=False) for name in ("keypoints", "descriptors", "grey")),
)

pose_sources = table(
    "pose_sources",
    reference("recording_id", "recordings.id", primary_key=True),
    Column("pose_source", String(16), nullable=False),
    Column("world", String(32), nullable=False),
    Column("upright", Integer),
    *pose_columns(),
)

planned_poses = table(
    "planned_poses",
    reference("recording_id", "recordings.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True, autoincrement=False),
    *pose_columns(),
    Column("covariance", Blob),
)

planned_links = table(
    "planned_links",
    reference("recording_id", "recordings.id", primary_key=True),
    Column("frame_index", Integer, primary_key=True, autoincrement=False),
    Column("other_frame_index", Integer, primary_key=True, autoincrement=False),
    Column("kind", String(16), primary_key=True),
    *link_columns(),
)

pose_covariances = table(
    "pose_covariances",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    Column("data", Blob, nullable=False),
)

keyframe_qualities = table(
    "keyframe_qualities",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    *(Column(name, Double, nullable=False) for name in ("sharpness", "exposure", "contrast", "blur_px", "blur_deg")),
)

loop_closures = table(
    "loop_closures",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    reference("other_keyframe_id", "keyframes.id", primary_key=True, index=True),
    Column("kind", String(16), primary_key=True),
    *link_columns(),
)

pose_operations = table(
    "pose_operations",
    row_id(),
    Column("kind", String(16), nullable=False),
    reference("map_id", "maps.id", index=True),
    reference("recording_id", "recordings.id", nullable=True, index=True),
    Column("from_map_id", BigInteger),
    Column("from_map", Name(NAME_LENGTH)),
    Column("from_name", Name(NAME_LENGTH)),
    Column("parameters", LongText, nullable=False),
    moment("created_at"),
    Column("undone_at", Moment),
)

pose_revisions = table(
    "pose_revisions",
    reference("keyframe_id", "keyframes.id", primary_key=True),
    reference("operation_id", "pose_operations.id", primary_key=True, index=True),
    *pose_columns("before_"),
    *pose_columns("after_"),
    moment("changed_at"),
)

access_tokens = table(  # never shown to those who ask with SQL
    "access_tokens",
    row_id(),
    Column("name", Name(NAME_LENGTH), nullable=False),
    Column("role", String(16), nullable=False),
    reference("map_id", "maps.id", nullable=True, index=True),
    Column("hash", String(64), nullable=False, unique=True),
    moment("created_at"),
    Column("expires_at", Moment),
    Column("revoked_at", Moment),
)

service_jobs = table(  # nor is this
    "service_jobs",
    row_id(),
    Column("map", Name(NAME_LENGTH), nullable=False),
    Column("who", String(64), nullable=False),
    Column("state", String(16), nullable=False),
    Column("request", LongText, nullable=False),
    Column("result", LongText, nullable=False),
    Column("error", Words),
    Column("attempts", Integer, nullable=False),
    moment("created_at"),
    Column("finished_at", Moment),
    Column("lease_until", Moment),
    Index(None, "state", "id"),
)
