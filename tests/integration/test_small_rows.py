"""SEMDB_DESCRIPTOR_DTYPE: rows of half and of a quarter of the room, read like all others, beside them in one map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from sqlalchemy import func, select

import semdb
from semdb.byte_descriptors import from_bytes
from semdb.database import tables
from semdb.database.store import Store, open_store
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.settings import Settings


def settings(url: str, dtype: str) -> Settings:
    made = {"detector": "recorded", "encoder": "gist", "features": "surf", "max_keypoints": 300, "threads": 1}
    return Settings(database_url=url, descriptor_dtype=dtype, **made)  # type: ignore[arg-type]


def bytes_of(store: Store, table: str) -> int:
    column = tables.metadata.tables[table].c.data
    with store.engine.connect() as connection:
        return int(connection.execute(select(func.sum(func.length(column)))).scalar_one())


def test_small_rows_hold_the_same_in_half_the_room(room: Path, database_url: str, tmp_path: Path) -> None:
    whole = f"sqlite:///{tmp_path / 'whole.sqlite3'}"
    options = IngestOptions(keyframes=4, map_name="m")
    for url, dtype in ((whole, "float32"), (database_url, "float16")):
        ingest_recordings([room], settings(url, dtype), options)
    with open_store(whole) as large, open_store(database_url) as small:
        keypoints = sum(len(kept.keypoints) for kept in large.load_keyframes(large.keyframe_ids(1)))
        assert keypoints > 200
        assert bytes_of(large, "keypoints") == 4 * 20 + 36 * keypoints
        assert bytes_of(small, "keypoints") == 4 * 68 + 16 * keypoints
        assert bytes_of(small, "descriptors") == 4 * 20 + 2 * 64 * keypoints
        pairs = zip(
            large.load_keyframes(large.keyframe_ids(1)), small.load_keyframes(small.keyframe_ids(1)), strict=True
        )
        for expected, found in pairs:
            np.testing.assert_allclose(found.keypoints.features.xy, expected.keypoints.features.xy, atol=0.005)
            np.testing.assert_allclose(found.keypoints.points, expected.keypoints.points, atol=1e-4)
            before, after = expected.keypoints.features.descriptors, found.keypoints.features.descriptors
            assert after.dtype == np.float32
            assert np.abs(after.astype(np.float64) - before.astype(np.float64)).max() < 3e-4
            np.testing.assert_array_equal(found.keypoints.object_index, expected.keypoints.object_index)


def test_rows_of_bytes_hold_the_same_on_every_server(room: Path, database_url: str, tmp_path: Path) -> None:
    """A map keeps to its own without a setting."""
    here = f"sqlite:///{tmp_path / 'here.sqlite3'}"
    for url in (here, database_url):
        ingest_recordings([room], settings(url, "uint8"), IngestOptions(keyframes=3, map_name="m"))
    whole = f"sqlite:///{tmp_path / 'whole.sqlite3'}"
    ingest_recordings([room], settings(whole, "float32"), IngestOptions(keyframes=3, map_name="m"))
    with open_store(whole) as large, open_store(here) as first, open_store(database_url) as second:
        keypoints = sum(len(kept.keypoints) for kept in large.load_keyframes(large.keyframe_ids(1)))
        for store in (first, second):
            assert bytes_of(store, "descriptors") == 3 * 20 + 64 * keypoints
            assert bytes_of(store, "keypoints") == 3 * 68 + 16 * keypoints
        d = tables.descriptors.c
        blobs = []
        for store in (first, second):
            with store.engine.connect() as connection:
                blobs.append([bytes(row.data) for row in connection.execute(select(d.data).order_by(d.keyframe_id))])
        assert blobs[0] == blobs[1]
        found = second.load_keyframes(second.keyframe_ids(1))
        for kept, exact in zip(found, large.load_keyframes(large.keyframe_ids(1)), strict=True):
            assert kept.keypoints.features.descriptors.dtype == np.int8
            back = from_bytes(kept.keypoints.features.descriptors)
            assert np.abs(back - exact.keypoints.features.descriptors).max() <= 0.5 / 172 + 1e-6
    for url, kind in ((whole, "float32"), (here, "int8")):
        ingest_recordings([room], settings(url, "auto"), IngestOptions(keyframes=4, map_name="m", name="more"))
        ingest_recordings([room], settings(url, "auto"), IngestOptions(keyframes=2, map_name="new"))
        with open_store(url) as store:
            for map_id, expected in ((1, kind), (2, "float32")):
                known = store.load_keyframes(store.keyframe_ids(map_id))
                assert {k.keypoints.features.descriptors.dtype.name for k in known} == {expected}


def test_a_map_of_both_kinds_answers_as_one(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    for name, dtype in (("first", "float32"), ("second", "uint8")):
        ingest_recordings([room], settings(url, dtype), IngestOptions(keyframes=3, map_name="m", name=name))
    with semdb.open(url) as db:
        names = set()
        for found in db.localize_recording(room, every=10):
            assert found.verdict == "localized"
            names |= {one.recording for one in found.candidates if one.inliers}
        assert names == {"first", "second"}


def test_one_map_has_rows_of_both_kinds(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    for name, dtype in (("first", "float32"), ("second", "float16")):
        ingest_recordings([room], settings(url, dtype), IngestOptions(keyframes=2, map_name="m", name=name))
    with open_store(url) as store:
        first, also_first, second, also_second = store.load_keyframes(store.keyframe_ids(1))
        for one, other in ((first, second), (also_first, also_second)):
            assert one.frame_index == other.frame_index
            np.testing.assert_allclose(one.keypoints.points, other.keypoints.points, atol=1e-4)
            assert not np.array_equal(one.keypoints.features.descriptors, other.keypoints.features.descriptors)
