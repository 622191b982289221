"""Common view of rendered frames, and the choice of keyframes from it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.errors import RecordingError, UsageError
from semdb.geometry import pose_distances, pose_error, pose_from, so3_exp
from semdb.ingestion.keyframes import _Sharpest, farthest_views, overlap_from_pose_distance, select_keyframes
from semdb.ingestion.view_overlap import ViewStack, view_grid, view_overlap
from semdb.recordings import open_recording
from semdb.types import Camera, Float32Array, FloatArray, ImageArray
from tests.unit.recording_miniatures import write_tum

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)


def wall(z: float = 2.0) -> Float32Array:
    return np.full((240, 320), z, np.float32)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn_deg: float = 0.0) -> FloatArray:
    return pose_from(so3_exp([0, np.radians(turn_deg), 0]), [x, y, z])


def overlap(first: Float32Array, first_pose: FloatArray, second: Float32Array, second_pose: FloatArray) -> float:
    return view_overlap(view_grid(CAMERA, first), first_pose, view_grid(CAMERA, second), second_pose)


def test_a_view_has_everything_in_common_with_itself() -> None:
    assert overlap(wall(), at(), wall(), at()) == 1.0


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_overlap_of_a_shifted_view_of_a_wall(share: float) -> None:
    width = 320 / 200 * 2.0  # metres of the wall in the image
    assert overlap(wall(), at(), wall(), at(x=share * width)) == pytest.approx(1 - share, abs=0.04)


def test_overlap_is_the_lesser_of_both_ways() -> None:
    # from twice as far all of the near view is seen, but the near view shows a quarter of the far one
    near, far = overlap(wall(2), at(), wall(4), at(z=-2)), overlap(wall(4), at(z=-2), wall(2), at())
    assert near == far == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize(("times", "share"), [(2.4, 1 / 2.4**2), (2.6, 0.0)])
def test_what_is_seen_from_much_farther_away_is_not_in_common(times: float, share: float) -> None:
    assert overlap(wall(1), at(), wall(times), at(z=1 - times)) == pytest.approx(share, abs=0.03)


def test_what_is_hidden_does_not_count() -> None:
    behind = wall(4.0)
    behind[:, :160] = 1.0  # the other view has an obstacle before its left half
    assert overlap(wall(4.0), at(), behind, at()) == pytest.approx(0.5, abs=0.04)
    assert overlap(wall(4.0), at(), wall(1.0), at()) == 0.0


def test_opposite_views_have_nothing_in_common() -> None:
    assert overlap(wall(), at(), wall(), at(turn_deg=180)) == 0.0


def test_invalid_depth_is_left_out() -> None:
    holes = wall()
    holes[60:180, 80:240] = np.nan
    assert overlap(wall(), at(), holes, at()) == 1.0
    assert overlap(wall(), at(), np.full_like(holes, np.nan), at()) == 0.0


def test_distortion_is_part_of_the_projection() -> None:
    camera = Camera(320, 240, 200.0, 200.0, 159.5, 119.5, (0.25, -0.9, -0.005, 0.003, 1.1))
    grid = view_grid(camera, wall())
    assert view_overlap(grid, at(), grid, at()) == 1.0
    assert view_overlap(grid, at(), grid, at(turn_deg=120)) == 0.0


@settings(max_examples=30, deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-40, 40), st.floats(1, 5))
def test_overlap_is_symmetric_and_between_0_and_1(x: float, z: float, turn: float, depth: float) -> None:
    forth = overlap(wall(depth), at(), wall(2), at(x, 0, z, turn))
    assert forth == overlap(wall(2), at(x, 0, z, turn), wall(depth), at())
    assert 0 <= forth <= 1


def test_pose_distances_match_pose_error() -> None:
    poses = np.stack([at(0.3 * i, 0, -0.1 * i, 40.0 * i) for i in range(5)])
    expected = []
    for pose in poses:
        metres, degrees = pose_error(pose, poses[1])
        expected.append(metres / 0.3 + degrees / 15)
    np.testing.assert_allclose(pose_distances(poses[1], poses), expected, atol=1e-9)
    assert overlap_from_pose_distance(np.array([0.0, 1.0, 2.0]), 0.5).tolist() == [1.0, 0.5, 0.25]


def test_farthest_views_of_a_line() -> None:
    poses = np.stack([at(x=0.1 * i) for i in range(11)])
    stack = ViewStack([view_grid(CAMERA, wall())] * 11, list(poses))
    assert farthest_views(stack.overlap_with, poses, count=3).tolist() == [0, 10, 5]
    assert sorted(farthest_views(stack.overlap_with, poses, count=11).tolist()) == list(range(11))


def test_farthest_views_beside_those_that_are_there() -> None:
    poses = np.stack([at(x=0.1 * i) for i in range(11)])
    stack = ViewStack([view_grid(CAMERA, wall())] * 11, list(poses))
    assert farthest_views(stack.overlap_with, poses, count=4, first=[3, 5]).tolist() == [3, 5, 10, 0]
    assert farthest_views(stack.overlap_with, poses, count=2, first=[9, 1]).tolist() == [9, 1]


def test_without_a_count_every_view_shares_enough_with_a_keyframe() -> None:
    poses = np.stack([at(x=0.1 * i, turn_deg=3 * i) for i in range(40)])
    stack = ViewStack([view_grid(CAMERA, wall())] * 40, list(poses))
    for threshold in (0.4, 0.7):
        chosen = farthest_views(stack.overlap_with, poses, count=None, min_overlap=threshold)
        greatest = np.max([stack.overlap_with(int(i)) for i in chosen], axis=0)
        assert greatest.min() >= threshold
        fewer = np.max([stack.overlap_with(int(i)) for i in chosen[:-1]], axis=0)
        assert fewer.min() < threshold


def test_values_below_the_floor_are_skipped_but_never_change_the_maximum() -> None:
    rng = np.random.default_rng(3)
    poses = np.stack([at(*rng.uniform(-0.5, 0.5, 3), rng.uniform(-30, 30)) for _ in range(30)])
    stack = ViewStack([view_grid(CAMERA, wall(rng.uniform(1, 4))) for _ in range(30)], list(poses))
    floor = stack.overlap_with(0)
    np.testing.assert_array_equal(
        np.maximum(floor, stack.overlap_with(7, floor)), np.maximum(floor, stack.overlap_with(7))
    )


def test_count_is_exact_ascending_and_deterministic(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=12)
    for n in (1, 5, 12):
        chosen = [entry.index for entry in select_keyframes(open_recording(folder), count=n)]
        assert len(set(chosen)) == n
        assert chosen == sorted(chosen)
        assert chosen == [entry.index for entry in select_keyframes(open_recording(folder), count=n)]
    calls: list[tuple[int, int]] = []
    select_keyframes(open_recording(folder), count=2, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i, 12) for i in range(1, 13)]


def test_stride(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path / "walk", n=7))
    assert [entry.index for entry in select_keyframes(recording, stride=3)] == [0, 3, 6]


def test_without_depth_poses_decide(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=12)
    (folder / "depth.txt").unlink()
    recording = open_recording(folder)
    assert [entry.index for entry in select_keyframes(recording, count=3)] in ([0, 5, 11], [0, 6, 11])
    chosen = select_keyframes(recording)  # neighbours are 0.62 apart (0.06 m and 5.9 degrees)
    poses = np.stack([entry.world_from_camera for entry in recording.entries if entry.world_from_camera is not None])
    nearest = np.min([pose_distances(poses[entry.index], poses) for entry in chosen], axis=0)
    assert nearest.max() <= 1.0
    assert 4 <= len(chosen) < 12


def test_frames_without_pose_or_with_broken_depth_are_no_keyframes(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=4)
    broken = folder / "depth/100.204000.png"
    data = bytearray(broken.read_bytes())
    data[len(data) // 2] ^= 0xFF
    broken.write_bytes(bytes(data))
    recording = open_recording(folder)
    assert [entry.index for entry in select_keyframes(recording, count=3)] == [0, 1, 3]
    assert [failure.name for failure in recording.decode_failures] == ["rgb/100.200000.png"]
    with pytest.raises(UsageError, match="4 keyframes were asked for, but only 3 frames can be used"):
        select_keyframes(recording, count=4)
    kept = [entry for entry in recording.entries if entry.index in (1, 2)]  # also one whose file broke meanwhile
    again = open_recording(folder)
    assert [entry.index for entry in select_keyframes(again, count=3, keep=kept)] == [1, 2, 3]
    assert [entry.index for entry in select_keyframes(again, count=4, keep=kept)] == [0, 1, 2, 3]
    with pytest.raises(UsageError, match="5 keyframes were asked for, but only 4 frames can be used"):
        select_keyframes(again, count=5, keep=kept)
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(RecordingError, match="no frame has a pose"):
        select_keyframes(open_recording(folder), count=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "must be at least 1"),
        ({"stride": 0}, "must be at least 1"),
        ({"count": 2, "stride": 2}, "not both"),
        ({"count": 7}, "7 keyframes were asked for, but only 3"),
    ],
)
def test_wishes_that_make_no_sense_are_usage_errors(tmp_path: Path, options: dict[str, int], message: str) -> None:
    recording = open_recording(write_tum(tmp_path / "walk", n=3))
    with pytest.raises(UsageError, match=message):
        select_keyframes(recording, count=options.get("count"), stride=options.get("stride"))


def test_of_frames_that_see_nearly_the_same_the_sharp_one_is_taken() -> None:
    """Each place is there three times: softened, as it is, and turned away too far to count as the same view."""
    pattern = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8).repeat(4, 0).repeat(4, 1)
    sharp = np.dstack([pattern] * 3)
    soft = np.asarray(cv2.GaussianBlur(sharp, (0, 0), 3), np.uint8)
    images = [soft, sharp, soft, soft, sharp, soft]
    poses = np.stack([at(), at(x=0.01), at(turn_deg=40), at(x=2.01), at(x=2), at(x=2, turn_deg=40)])

    def chosen(of: list[ImageArray], *, sharpest: bool = True) -> list[int]:
        entries: Any = [SimpleNamespace(index=n, image=image) for n, image in enumerate(of)]
        recording: Any = SimpleNamespace(read_image=lambda entry: entry.image)
        prefer = _Sharpest(recording, entries, poses, ()) if sharpest else None
        overlap_with = lambda i, _: overlap_from_pose_distance(pose_distances(poses[i], poses))  # noqa: E731
        return sorted(farthest_views(overlap_with, poses, count=None, prefer=prefer).tolist())

    assert chosen(images, sharpest=False) == [0, 2, 3, 5]
    assert chosen(images) == [1, 2, 4, 5]
    assert chosen([sharp] * 6) == [0, 2, 3, 5]
