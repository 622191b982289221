"""Trajectories of real recordings from their images and depth alone, against motion capture and a depth tracker."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semdb.evaluation.trajectory_errors import trajectory_errors
from semdb.geometry import invert_pose, pose_error
from semdb.recordings import open_recording
from semdb.trajectory.odometry import FrameState
from semdb.trajectory.recording import RecordedTrajectory, find_recorded, times_of
from semdb.types import FloatArray

pytestmark = pytest.mark.shared


def true_poses(found: RecordedTrajectory) -> FloatArray:
    return np.stack([entry.world_from_camera for entry in found.entries if entry.world_from_camera is not None])


@pytest.fixture(scope="module")
def desk(shared_dir: Path) -> RecordedTrajectory:
    """freiburg1_rpy, every 6th frame: fast turns, motion blur, a rolling shutter, a distorted lens."""
    return find_recorded(open_recording(shared_dir / "recordings" / "tum_rgbd_dataset_freiburg1_rpy"))


def test_the_desk_is_tracked_to_a_centimetre(desk: RecordedTrajectory) -> None:
    trajectory = desk.trajectory
    assert len(trajectory.used) == 121
    estimated = np.stack([frame.world_from_camera for frame in trajectory.used if frame.world_from_camera is not None])
    errors = trajectory_errors(estimated, true_poses(desk), times_of(desk.entries)[0])
    assert errors.rmse_m < 0.013
    assert errors.median_m < 0.008
    before = np.stack([frame.before_closing for frame in trajectory.used if frame.before_closing is not None])
    assert trajectory_errors(before, true_poses(desk), times_of(desk.entries)[0]).rmse_m < 0.03


def test_each_closure_at_the_desk_is_right(desk: RecordedTrajectory) -> None:
    true, positions = true_poses(desk), desk.trajectory.keyframes
    closures = desk.trajectory.closures()
    assert len(closures) > 50
    for edge in closures:
        relative = invert_pose(true[positions[edge.first]]) @ true[positions[edge.second]]
        metres, degrees = pose_error(relative, edge.first_from_second)
        assert metres < 0.1, (edge.first, edge.second)
        assert degrees < 3.0, (edge.first, edge.second)


def test_the_readout_of_the_camera_is_seen(desk: RecordedTrajectory) -> None:
    assert 0.018 < desk.trajectory.readout_s < 0.032


def test_a_kitchen_agrees_with_its_depth_tracker(shared_dir: Path) -> None:
    """Its recorded poses are 5 cm off from any that agree with the images; over 50 frames of 125, the bound is wide."""
    recording = open_recording(shared_dir / "recordings" / "7scenes_redkitchen")
    recording.entries = recording.entries[:100:2]
    found = find_recorded(recording)
    assert len(found.trajectory.used) == 50
    assert not found.timed
    poses = np.stack(
        [frame.world_from_camera for frame in found.trajectory.used if frame.world_from_camera is not None]
    )
    errors = trajectory_errors(poses, true_poses(found), times_of(found.entries)[0])
    assert errors.rmse_m < 0.06
    assert errors.relative_median_deg is not None
    assert errors.relative_median_deg < 1.5


def test_a_plain_cabinet_is_tracked_by_its_surfaces(shared_dir: Path) -> None:
    """Next to no texture, and steps of 0.2 m and 10 degrees: keypoints alone carry half of the frames."""
    recording = open_recording(shared_dir / "recordings" / "tum_freiburg3_cabinet")
    recording.entries = recording.entries[:24]
    found = find_recorded(recording)
    used = found.trajectory.used
    assert len(used) >= 22
    assert found.trajectory.count(FrameState.LAID) >= 4
    true = true_poses(found)[[frame.position for frame in used]]
    estimated = np.stack([frame.world_from_camera for frame in used if frame.world_from_camera is not None])
    assert trajectory_errors(estimated, true, np.arange(len(used)) * 0.67).rmse_m < 0.05
