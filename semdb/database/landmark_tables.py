"""The tables of landmarks, as `semdb.database.tables` has the others."""

from __future__ import annotations

from sqlalchemy import BigInteger, Column, Double, Index, Integer, String

from semdb.database import columns
from semdb.database.columns import (
    Blob,
    Id,
    LongText,
    maybe,
    reference,
    row_id,
    table,
)

metadata = columns.metadata

map_gravity = table(
    "map_gravity",
    reference("map_id", "maps.id", primary_key=True),
    *(Column(f"up_{axis}", Double, nullable=False) for axis in "xyz"),
    Column("up_certainty", Double, nullable=False),
    Column("floor", Double),
    Column("floor_certainty", Double, nullable=False),
    Column("given", Integer, nullable=False),
)

COVARIANCE_COLUMNS = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")

landmarks = table(
    "landmarks",
    row_id(),
    reference("map_id", "maps.id"),
    reference("category_id", "categories.id", cascade=False, index=True),
    Column("probability", Double, nullable=False),
    Column("evidence", LongText, nullable=False),
    *(Column(name, Double, nullable=False) for name in ("x", "y", "z", *COVARIANCE_COLUMNS)),
    *(Column(name, Double, nullable=False) for name in ("size_x", "size_y", "size_z", "yaw")),
    *(Column(name, Integer, nullable=False) for name in ("sightings", "keyframes", "missed", "seen_through")),
    Column("state", String(16), nullable=False),
    maybe("first_keyframe_id", "keyframes.id"),
    maybe("last_keyframe_id", "keyframes.id"),
    Column("first_seen_ns", BigInteger),
    Column("last_seen_ns", BigInteger),
    Column("appearance", Blob),
    Index(None, "map_id", "category_id"),
    Index(None, "category_id", "state", "map_id", "probability", "x", "y", "z"),
)

landmark_sightings = table(
    "landmark_sightings",
    reference("object_id", "objects.id", primary_key=True),
    reference("landmark_id", "landmarks.id", index=True),
    Column("coverage", Double, nullable=False),
    Column("visibility", Double, nullable=False),
)

landmark_views = table(
    "landmark_views",
    reference("landmark_id", "landmarks.id", primary_key=True),
    Column("place", Integer, primary_key=True, autoincrement=False),
    reference("object_id", "objects.id", index=True),
    Column("quality", Double, nullable=False),
    Column("distance", Double, nullable=False),
)

landmark_visits = table(
    "landmark_visits",
    reference("landmark_id", "landmarks.id", primary_key=True),
    reference("recording_id", "recordings.id", primary_key=True, index=True),
    Column("presence", String(16), nullable=False),
    *(
        Column(name, Integer, nullable=False)
        for name in ("keyframes", "points", "seen", "seen_through", "occluded", "missed")
    ),
    *(Column(name, Double) for name in ("x", "y", "z", "size_x", "size_y", "size_z")),
)

landmark_relations = table(
    "landmark_relations",
    reference("landmark_id", "landmarks.id", primary_key=True),
    Column("kind", String(16), primary_key=True),
    reference("other_landmark_id", "landmarks.id", primary_key=True),
    Column("score", Double, nullable=False),
    Column("other_category_id", Id),
    Column("category_id", Id),
    Column("map_id", Id),
    Index("ix_landmark_relations_other", "other_landmark_id", "category_id", "kind", "landmark_id", "score"),
    Index("ix_landmark_relations_pair", "category_id", "other_category_id", "map_id", "kind", "landmark_id", "score"),
    Index(None, "landmark_id", "other_category_id", "kind", "score"),
)

# what a landmark may be instead of what it most likely is
landmark_categories = table(
    "landmark_categories",
    reference("category_id", "categories.id", cascade=False, primary_key=True),
    reference("map_id", "maps.id", primary_key=True, index=True),
    reference("landmark_id", "landmarks.id", primary_key=True, index=True),
    Column("probability", Double, nullable=False),
)

landmark_merges = table(
    "landmark_merges",
    Column("landmark_id", Id, primary_key=True, autoincrement=False),
    reference("map_id", "maps.id", index=True),
    Column("merged_into", Id, nullable=False),
)

landmark_parts = table(  # what refine remembers; it may be deleted at any time
    "landmark_parts",
    reference("map_id", "maps.id", primary_key=True),
    Column("kind", String(16), primary_key=True),
    Column("name", String(40), primary_key=True),
    Column("size", Integer, nullable=False),
    Column("data", Blob, nullable=False),
)
