"""An image whose keypoints fail has a coarse pose by the landmarks of its map, and nothing counts it as localized."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semdb.database.store import open_store
from semdb.geometry import pose_error
from semdb.localization.images import make_localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.perception.objects import take_features
from semdb.refinement.run import refine_map
from semdb.types import Description, Keypoints, Verdict
from tests.integration.test_landmarks import FRAMES, ingest, records


def in_the_dark(described: Description) -> Description:
    """What is seen, without a keypoint."""
    none = np.empty(0, np.intp)
    features = take_features(described.keypoints.features, none)
    return replace(
        described, keypoints=Keypoints(features, np.empty(0, np.int32), np.empty((0, 3), np.float32)), grey=None
    )


@pytest.mark.parametrize("coarse", ["sql", "index"])
def test_a_dark_image_is_placed_by_what_it_shows(tmp_path: Path, coarse: str) -> None:
    with open_store(f"sqlite:///{tmp_path}/semdb.sqlite3", create=True) as store:
        info = ingest(store, range(FRAMES))
        described, true = in_the_dark(records()[2].description), records()[2].world_from_camera
        before = make_localizer(store, info, coarse).localize(described)
        assert before.verdict is Verdict.FAILED
        assert "landmark" not in before.reason
        refine_map(store, info)
        found = make_localizer(store, info, coarse).localize(described)
        assert found.verdict is Verdict.COARSE, found.reason
        assert found.confidence == 0
        assert "landmarks agree" in found.reason
        assert found.evidence["landmarks"] >= 3
        assert found.world_from_camera is not None
        assert found.covariance is not None
        metres, degrees = pose_error(found.world_from_camera, true)
        assert metres < 0.5
        assert degrees < 10
        off = found.world_from_camera[:3, 3] - true[:3, 3]
        assert off @ np.linalg.solve(found.covariance[:3, :3], off) < 12
        without = make_localizer(store, info, coarse, LocalizerOptions(landmarks=None)).localize(described)
        assert without.verdict is Verdict.FAILED
        assert without.reason == before.reason
