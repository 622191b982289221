"""Two halves of a real recording come into one frame, and different places do not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import semdb
from semdb.api import Database
from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp
from semdb.recordings import open_recordings
from tests.unit.onnx_files import write_constant_model

pytestmark = pytest.mark.shared
MOTION = pose_from(so3_exp([0.7, -1.1, 2.0]), [5.0, -3.0, 2.0])
RECORDINGS = {"kitchen": ("7scenes_redkitchen", 20), "desk": ("tum_rgbd_dataset_freiburg1_rpy", 24)}


@pytest.fixture(scope="module")
def halves(shared_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Database]:
    """The first half of each recording in a map, the second in another one and an arbitrary frame; no objects."""
    folder = tmp_path_factory.mktemp("sessions")
    nothing = {
        "boxes": np.zeros((0, 4), np.float32),
        "labels": np.zeros(0, np.int64),
        "scores": np.zeros(0, np.float32),
        "masks": np.zeros((0, 1, 480, 640), np.float32),
    }
    detector = write_constant_model(folder / "mask_rcnn.onnx", nothing)
    encoder = shared_dir / "models" / "squeezenet_places365.onnx"
    with semdb.open(
        f"sqlite:///{folder / 'semdb.sqlite3'}", detector=f"onnx:{detector}", encoder=f"onnx:{encoder}", threads=2
    ) as db:
        for name, (path, keyframes) in RECORDINGS.items():
            [recording] = open_recordings(shared_dir / "recordings" / path)
            entries, middle = recording.entries, len(recording.entries) // 2
            moved = tuple(replace(one, world_from_camera=MOTION @ one.world_from_camera) for one in entries[middle:])
            for part, chosen in (("first", entries[:middle]), ("second", moved)):
                own = replace(recording, name=f"{name} {part}", entries=chosen)
                db.ingest(own, map=own.name, keyframes=keyframes, check=False)
        yield db


@pytest.mark.parametrize(("recording", "there"), [("desk second", "kitchen first"), ("kitchen second", "desk first")])
def test_another_place_is_refused(halves: Database, recording: str, there: str) -> None:
    report = halves.align(recording, map=there)
    assert not report.convinced
    assert report.operation == 0
    assert [one.name for one in halves.recordings(there)] == [there]


@pytest.mark.parametrize("name", list(RECORDINGS))
def test_the_second_half_comes_back(halves: Database, name: str) -> None:
    second, first = f"{name} second", f"{name} first"
    before = {one.id: one.world_from_camera for one in halves.keyframes(second)}
    report = halves.align(second, map=first)
    assert report.convinced, report.reason
    back = invert_pose(MOTION)
    after = halves.keyframes(first, second)
    errors = np.array([pose_error(one.world_from_camera, back @ before[one.id]) for one in after])
    metres, degrees = np.median(errors, axis=0)
    assert metres < 0.015
    assert degrees < 0.5
    halves.undo_align(second)
    for one in halves.keyframes(second):
        np.testing.assert_allclose(one.world_from_camera, before[one.id], atol=1e-12)
