"""`semdb refine --step poses`: recorded poses that are off by centimetres become consistent, and come back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semdb.database.links import load_covariances
from semdb.errors import UsageError
from semdb.evaluation.trajectory_errors import trajectory_errors
from semdb.geometry import pose_from, so3_exp
from semdb.recordings import open_recordings
from semdb.trajectory.refining import laid_on
from semdb.types import FloatArray
from tests.integration.opened import Opening
from tests.rooms import SMALL, render

WALK = replace(SMALL, frames=24, lap_frames=60)


def rmse(poses: FloatArray, truth: FloatArray) -> float:
    return trajectory_errors(poses, truth, np.arange(len(poses), dtype=float)).rmse_m


def test_poses_that_are_off_are_mended(open_file: Opening, tmp_path: Path) -> None:
    [recording] = open_recordings(render(tmp_path / "walk", WALK))
    truth = np.array([entry.world_from_camera for entry in recording.entries[::2]])
    random = np.random.default_rng(2)
    noise = [pose_from(so3_exp(random.normal(0, 0.01, 3)), random.normal(0, 0.015, 3)) for _ in recording.entries]
    entries = [
        replace(entry, world_from_camera=entry.world_from_camera @ off)
        for entry, off in zip(recording.entries, noise, strict=True)
    ]
    db = open_file()
    db.ingest(replace(recording, name="walk", entries=tuple(entries)), map="walk", stride=2, check=False)
    before = {one.id: one.world_from_camera for one in db.keyframes("walk")}
    assert rmse(np.array(list(before.values())), truth) > 0.015
    assert "poses" not in [result.kind for result in db.refine("walk")]  # off unless it is asked for
    [done] = db.refine("walk", steps=["poses"])
    assert (done.kind, done.rows, done.computed, done.current) == ("poses", 12, True, True)
    after = {one.id: one.world_from_camera for one in db.keyframes("walk")}
    assert rmse(np.array(list(after.values())), truth) < 0.008
    spread = load_covariances(db._store().engine, list(after))
    assert sorted(spread) == sorted(after)[1:]  # against the first
    [again] = db.refine("walk", steps=["poses"])
    assert not again.computed
    assert [item.current for item in db.status().refinements if item.kind == "points"] == [False]
    undone = db.undo_align(map="walk")
    assert undone.kind == "refine"
    back = {one.id: one.world_from_camera for one in db.keyframes("walk")}
    for key, pose in before.items():
        np.testing.assert_allclose(back[key], pose, atol=1e-12)
    with pytest.raises(UsageError, match="--step loops: known are poses, classes, points"):
        db.refine("walk", steps=["loops"])


def test_the_world_stays_where_it_was() -> None:
    random = np.random.default_rng(0)
    given = np.array([pose_from(so3_exp(random.normal(size=3)), random.normal(size=3)) for _ in range(6)])
    motion = pose_from(so3_exp([0.1, 0.2, -0.3]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(laid_on(motion @ given, given), given, atol=1e-9)
