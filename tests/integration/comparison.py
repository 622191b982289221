"""Comparing what is stored with what was written."""

from __future__ import annotations

import numpy as np
from sqlalchemy import func, select

from semdb.database import tables
from semdb.database.records import StoredKeyframe
from semdb.database.store import Store
from semdb.types import Description
from tests.database_samples import pose

FRAMES = (0, 3, 7, 12, 20)
# Rows that may stay when everything that was ingested is deleted, and the revision of the schema.
REMAINING = {"maps", "models", "categories", "keyframe_changes", "alembic_version"}


def rows_per_table(store: Store) -> dict[str, int]:
    with store.engine.connect() as connection:
        return {
            table.name: int(connection.execute(select(func.count()).select_from(table)).scalar_one())
            for table in tables.metadata.sorted_tables
        }


def assert_same(stored: StoredKeyframe, described: Description, frame_index: int) -> None:
    assert stored.frame_index == frame_index
    assert stored.camera == described.camera
    np.testing.assert_allclose(stored.world_from_camera, pose(frame_index), atol=1e-12)
    assert [item.category for item in stored.objects] == [item.category for item in described.detections]
    for item, detection, geometry in zip(stored.objects, described.detections, described.geometry, strict=True):
        assert item.score == detection.score
        np.testing.assert_array_equal(item.box, detection.box)
        assert item.geometry.pixel_area == geometry.pixel_area
        np.testing.assert_array_equal(item.geometry.centroid, geometry.centroid)
        np.testing.assert_array_equal(item.geometry.extent, geometry.extent)
    np.testing.assert_array_equal(stored.keypoints.object_index, described.keypoints.object_index)
    np.testing.assert_array_equal(stored.keypoints.points, described.keypoints.points)
    for name in ("xy", "size", "angle", "response", "laplacian", "descriptors"):
        before, after = getattr(described.keypoints.features, name), getattr(stored.keypoints.features, name)
        np.testing.assert_array_equal(after, before)
        assert after.dtype == before.dtype
