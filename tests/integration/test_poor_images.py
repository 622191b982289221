"""Dark and blurred images of a room are localized; qualities are stored, shown and said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import semdb
from bench.poor_images import unmended
from semdb.database.store import open_store
from semdb.geometry import pose_error
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.perception.quality import blurred_like
from semdb.recordings import open_recording
from semdb.settings import Settings

QUERIES = (5, 17)


@pytest.fixture(scope="module")
def url(room: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    url = f"sqlite:///{tmp_path_factory.mktemp('poor') / 'a.sqlite3'}"
    settings = Settings(
        database_url=url, detector="recorded", encoder="gist", features="surf", max_keypoints=700, threads=1
    )
    ingest_recordings([room], settings, IngestOptions(keyframes=8, map_name="m"))
    return url


def blurred(image: np.ndarray) -> np.ndarray:
    return np.dstack([blurred_like(np.ascontiguousarray(image[:, :, c]), (19.0, 30.0)) for c in range(3)])


def dark(image: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 1.5, image.shape)
    return np.clip(51 * (image / 255.0) ** 1.5 + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("spoil", [blurred, dark])
def test_poor_images_are_localized(room: Path, url: str, spoil: Callable[[np.ndarray], np.ndarray]) -> None:
    recording = open_recording(room)
    with semdb.open(url, detector="recorded") as db:
        for number in QUERIES:
            frame = recording.read(recording.entries[number])
            poor = spoil(frame.image)
            found = db.localize(replace(frame, image=poor, depth=None))
            assert found.verdict == "localized", found.reason
            metres, degrees = pose_error(found.world_from_camera, frame.world_from_camera)
            assert (metres < 0.05, degrees < 2) == (True, True), (number, metres, degrees)


def test_the_benchmark_compares_with_images_that_nothing_mends(room: Path, url: str) -> None:
    recording = open_recording(room)
    poor = replace(recording.read(recording.entries[QUERIES[0]]), depth=None)
    with semdb.open(url, detector="recorded") as db:
        [entry] = db._here.maps().asked(None, "index")
        spoilt = replace(poor, image=dark(poor.image))
        with unmended(db):
            assert entry.localizer.fine.options.blur is None
            without = db.localize(spoilt).inliers
        assert entry.localizer.fine.options.blur is not None
        assert db.localize(spoilt).inliers > 1.2 * without


def test_the_reason_says_what_is_wrong_with_the_image(url: str, room: Path) -> None:
    frame = open_recording(room).read(open_recording(room).entries[5])
    grey = np.full_like(frame.image, 30)
    grey[::7] = 40
    with semdb.open(url, detector="recorded") as db:
        found = db.localize(replace(frame, image=grey, depth=None))
        assert found.verdict == "failed"
        assert found.reason.endswith("; the image is dark: its grey values span 10 of 255")


def test_each_keyframe_has_its_quality(url: str) -> None:
    with open_store(url) as store, semdb.open(url) as db:
        query = "SELECT frame_index, sharpness, exposure, contrast, blur_px, keypoints FROM keyframe_quality"
        with db.sql(query) as rows:
            found = list(rows)
        assert len(found) == len(store.keyframe_ids(1)) == 8
        for _, sharpness, exposure, contrast, blur_px, keypoints in found:
            assert sharpness > 5
            assert 0.1 < exposure < 0.9
            assert 0.2 < contrast <= 1
            assert blur_px == 0
            assert keypoints > 100
