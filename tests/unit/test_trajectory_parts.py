"""Parts of trajectories: motion, errors, depth that fits, pairs of edges measured both ways, files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semdb.cli.trajectory import named, shown_closures
from semdb.evaluation.pose_comparison import compare_poses
from semdb.evaluation.trajectory_errors import rigid_alignment, trajectory_errors
from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp, transform_points
from semdb.geometry.stacks import adjoints
from semdb.geometry.volumes import Volume, common_view, common_views
from semdb.pictures.trajectory import ShownClosure
from semdb.recordings.base import FrameEntry
from semdb.recordings.synthetic import SyntheticOptions
from semdb.recordings.synthetic.writer import SyntheticSequence
from semdb.trajectory.depth_views import depth_agreement, depth_view
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.files import trajectory_text
from semdb.trajectory.measuring import joined
from semdb.trajectory.motion import Motion, turn_rates
from semdb.trajectory.odometry import FrameState
from semdb.trajectory.recording import RecordedTrajectory, times_of
from semdb.trajectory.result import Drift, FramePose, PieceSummary, Trajectory
from semdb.types import Camera, FloatArray


def turning(times_s: FloatArray, rate: FloatArray, speed: FloatArray) -> FloatArray:
    """Poses ``[n, 4, 4]`` of a camera that turns and moves evenly in its own frame, for small steps."""
    poses = [np.eye(4)]
    for passed in np.diff(times_s):
        poses.append(poses[-1] @ pose_from(so3_exp(rate * passed), speed * passed))
    return np.stack(poses)


# motion


def test_an_even_motion_goes_on() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.35])
    rate, speed = np.array([0.1, 0.5, -0.2]), np.array([0.3, 0.0, 0.1])
    poses = turning(times, rate, speed)
    motion = Motion(1.0)
    motion.seen(times[1], poses[1])
    assert motion.predict(times[2]) is poses[1] or np.array_equal(motion.predict(times[2]), poses[1])
    motion.seen(times[2], poses[2])
    predicted = motion.predict(times[3])
    assert predicted is not None
    metres, degrees = pose_error(predicted, poses[3])
    assert metres < 1e-3
    assert degrees < 0.01


def test_a_motion_is_not_believed_for_long() -> None:
    motion = Motion(1.0)
    assert motion.predict(0.0) is None
    motion.seen(0.0, np.eye(4))
    assert motion.predict(0.9) is not None
    assert motion.predict(1.1) is None
    motion.forget()
    assert motion.predict(0.1) is None


def test_a_motion_that_went_elsewhere_is_not_steady() -> None:
    motion = Motion(1.0)
    for time_s in (0.0, 0.1, 0.2):
        motion.seen(time_s, np.eye(4))
    assert motion.steady
    motion.seen(0.3, pose_from(so3_exp([0, 0.1, 0]), [0, 0, 0]))
    assert not motion.steady


def test_turn_rates_are_those_of_the_camera() -> None:
    times = np.array([0.0, 0.05, 0.1, 0.2, 1.5, 1.6])
    rate = np.array([0.2, -0.6, 0.1])
    poses = turning(times, rate, np.zeros(3))
    found = turn_rates(poses[:, :3, :3], times, np.zeros(6, np.int32))
    np.testing.assert_allclose(found, np.tile(rate, (6, 1)), atol=1e-9)
    apart = turn_rates(poses[:, :3, :3], times, np.array([0, 0, 0, 0, 0, 1], np.int32))
    np.testing.assert_array_equal(apart[[4, 5]], 0.0)  # 1.3 s before it, and another world after it
    assert turn_rates(poses[:1, :3, :3], times[:1], np.zeros(1, np.int32)).tolist() == [[0.0, 0.0, 0.0]]


# errors


def test_errors_do_not_depend_on_the_world() -> None:
    times = np.arange(30) / 10
    true = turning(times, np.array([0.1, 0.4, 0.0]), np.array([0.2, 0.1, 0.3]))
    world = pose_from(so3_exp([1.0, -0.5, 0.3]), [5, -3, 2])
    errors = trajectory_errors(world @ true, true, times)
    assert errors.rmse_m < 1e-9
    assert errors.relative_rmse_m is not None
    assert errors.relative_rmse_m < 1e-9
    assert errors.relative_rmse_deg is not None
    assert errors.relative_rmse_deg < 1e-6


def test_errors_are_what_was_added() -> None:
    times = np.arange(40) / 10
    true = turning(times, np.zeros(3), np.array([0.5, 0.0, 0.0]))
    off = true.copy()
    off[::2, 1, 3] += 0.02  # to and fro, across the way
    errors = trajectory_errors(off, true, times)
    assert errors.rmse_m == pytest.approx(0.01, rel=0.02)
    assert errors.median_m == pytest.approx(0.01, rel=0.05)
    assert errors.relative_median_m == pytest.approx(0.0, abs=1e-9)  # a second is ten frames
    assert errors.frames == 40


def test_no_second_no_relative_errors() -> None:
    true = turning(np.arange(5) / 10, np.zeros(3), np.ones(3))
    errors = trajectory_errors(true, true, np.arange(5) / 10)
    assert errors.relative_rmse_m is None
    with pytest.raises(ValueError, match="three frames"):
        trajectory_errors(true[:2], true[:2], np.arange(2) / 10)


def test_alignment_is_rigid_even_of_a_mirrored_path() -> None:
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(20, 3))
    pose = rigid_alignment(positions, positions * [1, 1, -1])
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


# depth


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return SyntheticSequence(SyntheticOptions(frames=12, width=320, height=240, lap_frames=80))


def test_depth_fits_the_true_pose_and_no_other(sequence: SyntheticSequence) -> None:
    first, second = sequence.render(0), sequence.render(4)
    views = [
        depth_view(sequence.camera, np.where(f.depth > 0, f.depth, np.nan).astype(np.float32)) for f in (first, second)
    ]
    relative = invert_pose(first.world_from_camera) @ second.world_from_camera
    right = depth_agreement(views[0], views[1], relative)
    wrong = depth_agreement(views[0], views[1], relative @ pose_from(so3_exp([0, 0.2, 0]), [0.2, 0, 0.1]))
    assert right is not None
    assert wrong is not None
    assert right > 0.7
    assert wrong < 0.4


def test_depth_that_is_not_there_says_nothing(sequence: SyntheticSequence) -> None:
    frame = sequence.render(0)
    view = depth_view(sequence.camera, np.where(frame.depth > 0, frame.depth, np.nan).astype(np.float32))
    assert depth_view(sequence.camera, None) is None
    assert depth_agreement(view, None, np.eye(4)) is None
    empty = depth_view(sequence.camera, np.full((240, 320), np.nan, np.float32))
    assert depth_agreement(view, empty, np.eye(4)) is None
    behind = pose_from(so3_exp([0, np.pi, 0]), [0, 0, 0])
    assert depth_agreement(view, view, behind) is None


# common view


@pytest.mark.parametrize("distortion", [(), (0.1, -0.2, 0.001, 0.002, 0.05)])
def test_common_views_are_those_of_pairs(distortion: tuple[float, ...]) -> None:
    rng = np.random.default_rng(4)
    camera = Camera(640, 480, 525, 525, 319.5, 239.5, distortion)
    volumes = []
    for _ in range(30):
        pose = pose_from(so3_exp(0.4 * rng.normal(size=3)), 0.5 * rng.normal(size=3))
        local = np.column_stack([rng.uniform(-1, 1, (64, 2)), np.ones(64)]) * rng.uniform(0.5, 4, (64, 1))
        volumes.append(Volume(camera, pose, transform_points(pose, local)))
    expected = [common_view(volumes[0], other) for other in volumes]
    np.testing.assert_array_equal(common_views(volumes[0], volumes), expected)
    assert np.std(expected) > 0.05
    empty = Volume(camera, np.eye(4), np.zeros((0, 3)))
    np.testing.assert_array_equal(common_views(volumes[0], [volumes[1], empty]), [expected[1], 0.0])
    assert len(common_views(volumes[0], [])) == 0


# edges


def test_two_ways_that_agree_are_no_surer_than_one() -> None:
    rng = np.random.default_rng(2)
    forth = pose_from(so3_exp([0.1, 0.7, -0.2]), [0.5, 0.1, -0.3])
    spread = np.diag([1e-4] * 3 + [4e-5] * 3)
    move = adjoints(invert_pose(forth)[None])[0]
    back_spread = np.linalg.inv(adjoints(invert_pose(forth)[None])[0]) @ spread @ np.linalg.inv(move).T
    pose, together = joined(forth, spread, invert_pose(forth), back_spread)
    np.testing.assert_allclose(pose, forth, atol=1e-12)
    np.testing.assert_allclose(together, spread, rtol=1e-6, atol=1e-12)
    off = forth @ pose_from(so3_exp(0.01 * rng.normal(size=3)), [0.04, 0, 0])
    pose, together = joined(forth, spread, invert_pose(off), back_spread)
    metres, _ = pose_error(pose, forth)
    assert metres == pytest.approx(0.02, rel=0.05)
    assert together[0, 0] > spread[0, 0] + 0.0003  # a quarter of the square of what they differ by


# files


def test_files_have_the_times_of_the_recording() -> None:
    pose = pose_from(so3_exp([0, 0, np.pi / 2]), [1.0, 2.0, 3.0])
    frame = FramePose(0, FrameState.TRACKED, piece=0, world_from_camera=pose)
    trajectory = Trajectory((frame,), (), (), (), (), 0.0, {})
    entry = FrameEntry(7, "7.png", 1305031229528748000, Path("7.png"), None, None, None)
    text = trajectory_text(RecordedTrajectory(trajectory, (entry,), True))
    assert text.splitlines() == [
        "# estimated poses, world from camera, metres",
        "# timestamp tx ty tz qx qy qz qw",
        "1305031229.528748000 1.000000000 2.000000000 3.000000000 0.000000000 0.000000000 0.707106781 0.707106781",
    ]
    untimed = trajectory_text(RecordedTrajectory(trajectory, (entry,), False))
    assert "frame index" in untimed.splitlines()[1]
    assert untimed.splitlines()[3].startswith("7.000000000 ")


def test_times_that_go_back_are_none() -> None:
    def entries(*stamps: int | None) -> tuple[FrameEntry, ...]:
        return tuple(
            FrameEntry(3 * n, f"{n}.png", at, Path(f"{n}.png"), None, None, None) for n, at in enumerate(stamps)
        )

    times_s, timed = times_of(entries(5_000_000_000, 6_000_000_000, 6_500_000_000))
    assert (times_s.tolist(), timed) == ([0.0, 1.0, 1.5], True)
    for stamps in ((2, 1, 0), (0, 5, 5), (0, None, 7)):
        times_s, timed = times_of(entries(*stamps))
        assert (times_s.tolist(), timed) == ([0.0, 0.1, 0.2], False)


def test_closures_are_shown_by_their_frames() -> None:
    """Of every second frame, the first of which is lost: drawn are frames with a pose."""
    frames = (
        FramePose(0, FrameState.LOST),
        *(FramePose(n, FrameState.TRACKED, piece=0, world_from_camera=np.eye(4)) for n in (1, 2, 3)),
    )
    made = [
        Edge(0, 2, EdgeKind.LOOP, np.eye(4), np.eye(6), 50),
        Edge(1, 2, EdgeKind.LOOP, np.eye(4), np.eye(6), 30, EdgeState.CONTRADICTED, "contradicts 1 of 1"),
    ]
    trajectory = Trajectory(frames, (1, 2, 3), tuple(made), (), (Drift(0, 2, 0.03, 1.5, 2.0),), 0.0, {})
    entries = tuple(FrameEntry(2 * n, f"{n}.png", None, Path(f"{n}.png"), None, None, None) for n in range(4))
    assert shown_closures(RecordedTrajectory(trajectory, entries, False)) == [
        ShownClosure(0, 2, 0.03, 1.5, True, "2-6"),
        ShownClosure(1, 2, 0.0, 0.0, False, "4-6"),
    ]


# recorded poses beside estimated ones


def test_comparison_of_poses_finds_scale_and_the_worst_frame() -> None:
    rng = np.random.default_rng(6)
    true = [pose_from(so3_exp(0.3 * rng.normal(size=3)), [0.1 * n, np.sin(0.3 * n), 0.02 * n]) for n in range(40)]
    world = pose_from(so3_exp([0.3, -1.0, 2.0]), [4.0, 5.0, 6.0])
    recorded = []
    for pose in true:
        moved = world @ pose
        moved[:3, 3] = world[:3, 3] + 1.02 * (moved[:3, 3] - world[:3, 3])
        recorded.append(moved)
    recorded[17] = pose_from(np.eye(3), [0.0, 0.3, 0.0]) @ recorded[17]
    spread = np.diag([4e-6] * 3 + [1e-6] * 3)
    frames = tuple(
        FramePose(n, FrameState.TRACKED, piece=0, world_from_camera=pose, covariance=spread)
        for n, pose in enumerate(true)
    )
    entries = tuple(
        FrameEntry(n, f"{n}.png", n * 33_000_000, Path(f"{n}.png"), None, None, pose) for n, pose in enumerate(recorded)
    )
    pieces = (PieceSummary(0, 40, 5, 0, 39),)
    trajectory = Trajectory(frames, (), (), pieces, (), 0.0, {})
    found = compare_poses(RecordedTrajectory(trajectory, entries, True))
    assert found.errors is not None
    assert (found.frames, found.estimated, found.worst_frame) == (40, 40, 17)
    assert found.scale == pytest.approx(1.02, abs=0.005)
    assert found.errors.max_m == pytest.approx(0.3, abs=0.03)
    assert found.rotation_deg < 0.01
    assert found.sigma_m == pytest.approx(np.sqrt(12e-6))
    few = compare_poses(RecordedTrajectory(Trajectory(frames[:2], (), (), pieces, (), 0.0, {}), entries, True))
    assert few.errors is None
    assert few.frames == 2


def test_a_file_that_cannot_be_written_is_named() -> None:
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"), named(Path("/dev/full")):
        Path("/dev/full").write_text("0 0 0 0 0 0 0 1\n")
