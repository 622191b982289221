"""Comparing what is stored with what was written."""

from __future__ import annotations

from typing import Any

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
# What a second run of the same ingest may change: when it happened, and ids of rows that were rolled back.
NOT_COMPARED = {"created_at", "finished_at", "changed_at", "measured_at", "lease_until", "worker", "attempts"}
OF_A_KEYFRAME = (
    tables.keyframes,
    tables.keyframe_images,
    tables.cnn_vectors,
    tables.keyframe_categories,
    tables.keypoints,
    tables.descriptors,
    tables.objects,
    tables.object_features,
)


def rows_per_table(store: Store) -> dict[str, int]:
    with store.engine.connect() as connection:
        return {
            table.name: int(connection.execute(select(func.count()).select_from(table)).scalar_one())
            for table in tables.metadata.sorted_tables
        }


def content(store: Store) -> dict[str, list[tuple[Any, ...]]]:
    """Every column of every row of keyframes, blobs whole, and how many rows each table has, free of ids.

    What an ingest has to end with, whatever went wrong on the way. "frames" has one entry a keyframe, its number first.
    """
    with store.engine.connect() as connection:
        rows = {
            table.name: list(connection.execute(select(table)).mappings()) for table in tables.metadata.sorted_tables
        }
    keyframes = {row["id"]: row["frame_index"] for row in rows["keyframes"]}
    objects = {row["id"]: row for row in rows["objects"]}
    names = {
        "camera_id": {row["id"]: row["digest"] for row in rows["cameras"]},
        "model_id": {row["id"]: row["digest"] for row in rows["models"]},
        "category_id": {row["id"]: row["name"] for row in rows["categories"]},
        "object_id": {key: row["ordinal"] for key, row in objects.items()},
        "keyframe_id": keyframes,
    }
    left_out = {"id", "recording_id", "map_id", *NOT_COMPARED}
    found: dict[int, list[tuple[Any, ...]]] = {index: [] for index in keyframes.values()}
    for table in OF_A_KEYFRAME:
        for row in rows[table.name]:
            of = row["id"] if table is tables.keyframes else row.get("keyframe_id")
            of = objects[row["object_id"]]["keyframe_id"] if of is None else of
            values = ((name, names.get(name, {}).get(value, value)) for name, value in row.items())
            found[keyframes[of]].append((table.name, *(pair for pair in values if pair[0] not in left_out)))
    counts = sorted((name, len(of_table)) for name, of_table in rows.items())
    return {"frames": sorted((index, *sorted(kept, key=repr)) for index, kept in found.items()), "counts": counts}


def stored(store: Store) -> int:
    """How many keyframes there are."""
    return rows_per_table(store)["keyframes"]


def is_complete(store: Store) -> bool:
    """Whether there are recordings, and nothing of them is left to do."""
    found = store.status()
    return bool(found) and all(str(recording.state) == "complete" for recording in found)


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
