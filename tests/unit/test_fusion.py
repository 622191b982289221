"""Points of keyframes from several: tracks, the pose between two, depths along a ray, all of it on a small scene."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp, transform_points
from semdb.geometry.volumes import neighbour_pairs, volume_of
from semdb.localization.tracks import join_tracks, pairs_of_tracks
from semdb.localization.views import ClassNumbers, View, make_view
from semdb.refinement.points.depths import Observations, solve_depths
from semdb.refinement.points.matching import match_known_poses
from semdb.refinement.points.options import DepthOptions, FusionOptions, GateOptions, RegistrationOptions
from semdb.refinement.points.refined import RefinedPoints, refine_points
from semdb.refinement.points.registration import Sightings, register
from semdb.types import FloatArray, Keypoints
from tests.unit.localization_scene import CAMERA, Scene


def tracks_of(matches: list[tuple[int, int, float]], frame_of: list[int]) -> list[list[int]]:
    first, second, distance = (np.array(column) for column in zip(*matches, strict=True))
    nodes, starts = join_tracks(first, second, distance.astype(np.float32), np.array(frame_of, np.int32))
    return [nodes[a:b].tolist() for a, b in pairwise(starts)]


def test_matches_chain_to_tracks_and_conflicts_are_cut() -> None:
    frames = [0, 0, 1, 1, 2, 3]
    assert tracks_of([(2, 0, 0.1), (4, 2, 0.2), (5, 1, 0.3)], frames) == [[0, 2, 4], [1, 5]]
    # the last match would bring both keypoints of frame 0 into one track; the least alike match gives way
    assert tracks_of([(0, 2, 0.1), (1, 4, 0.2), (2, 4, 0.3)], frames) == [[0, 2], [1, 4]]
    assert tracks_of([(0, 2, 0.3), (1, 4, 0.2), (2, 4, 0.1)], frames) == [[1, 2, 4]]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_tracks_hold_one_keypoint_of_a_frame_whatever_the_order(seed: int) -> None:
    random = np.random.default_rng(seed)
    frame_of = np.sort(random.integers(0, 6, 40))
    ends = random.integers(0, 40, (60, 2))
    matches = [(int(a), int(b), float(random.random())) for a, b in ends]
    matches = [match for match in matches if frame_of[match[0]] != frame_of[match[1]]]
    tracks = tracks_of(matches, frame_of.tolist())
    for track in tracks:
        assert len({int(frame_of[node]) for node in track}) == len(track) >= 2
        assert track == sorted(track)
    assert [track[0] for track in tracks] == sorted(track[0] for track in tracks)
    assert sum(map(len, tracks)) == len({node for track in tracks for node in track})
    shuffled = [matches[i] if i % 2 else (matches[i][1], matches[i][0], matches[i][2]) for i in
                random.permutation(len(matches))]  # fmt: skip
    assert tracks_of(shuffled, frame_of.tolist()) == tracks


def test_pairs_of_tracks() -> None:
    one, two = pairs_of_tracks(np.array([3, 5, 9, 1, 2]), np.array([0, 3, 5]))
    assert list(zip(one.tolist(), two.tolist(), strict=True)) == [
        (3, 5), (3, 9), (5, 3), (5, 9), (9, 3), (9, 5), (1, 2), (2, 1),
    ]  # fmt: skip


def seen_by(poses: list[FloatArray], point: FloatArray, noise: float = 1 / 500) -> Observations:
    """One keypoint at the origin's camera without depth, seen from `poses` without depth."""
    moved = np.stack([transform_points(invert_pose(pose), point[None])[0] for pose in poses])
    inverse = np.stack([invert_pose(pose) for pose in poses])
    count = len(poses)
    return Observations(
        ray=(point[:2] / point[2])[None],
        depth=np.array([np.nan]),
        start=np.array([0, count]),
        which=np.arange(count, dtype=np.int32),
        rotation=np.ascontiguousarray(inverse[:, :3, :3]),
        translation=np.ascontiguousarray(inverse[:, :3, 3]),
        noise=np.full(count, noise),
        seen=moved[:, :2] / moved[:, 2:],
        seen_depth=np.full(count, np.nan),
    )


coordinate = st.floats(-0.4, 0.4)


@given(
    st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate, coordinate), min_size=1, max_size=5),
    st.tuples(coordinate, coordinate, st.floats(1.0, 5.0)),
)
@settings(max_examples=60, deadline=None)
def test_a_point_is_triangulated_exactly_or_not_at_all(
    cameras: list[tuple[float, ...]], place: tuple[float, float, float]
) -> None:
    point = np.array([place[0] * place[2], place[1] * place[2], place[2]])
    poses = [pose_from(so3_exp([a * 0.5, b * 0.5, 0]), [x, y, 0.3 * z]) for x, y, z, a, b in cameras]
    observations = seen_by(poses, point)
    found = solve_depths(observations, DepthOptions())
    rays = [point - pose[:3, 3] for pose in poses]
    apart = max(float(np.degrees(np.arccos(np.clip(
        ray @ point / np.linalg.norm(ray) / np.linalg.norm(point), -1, 1)))) for ray in rays)  # fmt: skip
    if np.isfinite(found.depth[0]):
        assert found.depth[0] == pytest.approx(point[2], rel=1e-4)
        assert found.sigma[0] <= 0.05 * point[2]
        assert found.agreeing[0] == len(poses)
        assert apart > 1.49
        # a second look from the same places halves the variance
        twice = replace(
            observations, start=np.array([0, 2 * len(poses)]), which=np.tile(observations.which, 2),
            seen=np.tile(observations.seen, (2, 1)), seen_depth=np.tile(observations.seen_depth, 2),
        )  # fmt: skip
        assert solve_depths(twice, DepthOptions()).sigma[0] == pytest.approx(found.sigma[0] / np.sqrt(2), rel=1e-3)
    else:
        # sigma is at least depth * noise / parallax: with little of it no depth is worth having
        assert apart < 6


def test_cameras_that_only_turn_triangulate_nothing() -> None:
    turned = [pose_from(so3_exp([0, angle, 0]), [0, 0, 0]) for angle in (-0.2, 0.1, 0.2)]
    assert np.isnan(solve_depths(seen_by(turned, np.array([0.1, 0.2, 2.0])), DepthOptions()).depth[0])


def test_depths_are_fused_and_what_disagrees_is_left_out() -> None:
    poses = [pose_from(np.eye(3), [x, 0, 0]) for x in (-0.3, 0.2, 0.4)]
    observations = replace(seen_by(poses, np.array([0.1, 0.2, 3.0]), 1 / 3000), depth=np.array([3.02]))
    found = solve_depths(observations, DepthOptions())
    assert abs(found.depth[0] - 3.0) < 0.012
    own_sigma = 0.0012 + 0.0019 * 2.62**2
    assert found.sigma[0] < own_sigma
    measured = replace(observations, seen_depth=np.full(3, 3.0))
    assert solve_depths(measured, DepthOptions()).sigma[0] < found.sigma[0]
    assert np.isnan(solve_depths(observations, DepthOptions(fuse=False)).depth[0])
    elsewhere = replace(observations, depth=np.array([2.5]))  # a branch in front of the wall that the others see
    assert np.isnan(solve_depths(elsewhere, DepthOptions()).depth[0])
    seen = observations.seen.copy()
    seen[1] += 0.05  # a wrong match among right ones
    wrong = solve_depths(replace(observations, depth=np.array([np.nan]), seen=seen), DepthOptions())
    assert wrong.depth[0] == pytest.approx(3.0, abs=0.03)
    assert wrong.agreeing[0] == 2


def test_two_keyframes_are_laid_on_each_other() -> None:
    random = np.random.default_rng(3)
    points = random.uniform([-1, -1, 1.5], [1, 1, 4], (60, 3))
    truth = pose_from(so3_exp([0.05, 0.3, -0.1]), [0.4, 0.1, -0.2])
    moved = transform_points(truth, points)
    first = Sightings(points[:, :2] / points[:, 2:], points[:, 2])
    depth = np.where(random.random(60) < 0.5, np.nan, moved[:, 2])
    xy = moved[:, :2] / moved[:, 2:] + random.normal(size=(60, 2)) / 520
    xy[:6] += 0.04  # wrong matches
    recorded = pose_from(so3_exp([0.01, -0.008, 0.006]), [0.015, -0.01, 0.02]) @ truth
    options = RegistrationOptions()
    found = register(first, Sightings(xy, depth), recorded, 520.0, options)
    before, after = pose_error(recorded, truth), pose_error(found.second_from_first, truth)
    assert before[1] > 0.8
    assert after[0] < 0.004
    assert after[1] < 0.1
    assert found.noise * 520 < 2
    few = register(Sightings(first.xy[:8], first.depth[:8]), Sightings(xy[:8], depth[:8]), recorded, 520.0, options)
    assert (few.second_from_first == recorded).all()
    assert few.noise > 0.01  # what the recorded pose may be off by


def test_rays_alone_turn_a_keyframe_but_do_not_stretch_the_step_to_it() -> None:
    random = np.random.default_rng(4)
    points = random.uniform([-1, -1, 1.5], [1, 1, 4], (200, 3))
    truth = pose_from(so3_exp([0.05, 0.2, -0.1]), [0.4, 0.1, -0.2])
    moved = transform_points(truth, points)
    nothing = np.full(200, np.nan)
    first = Sightings(points[:, :2] / points[:, 2:], nothing)
    second = Sightings(moved[:, :2] / moved[:, 2:] + random.normal(size=(200, 2)) / 520, nothing)
    options = RegistrationOptions()
    assert pose_error(register(first, second, truth, 520.0, options).second_from_first, truth)[0] < 0.005
    turned = pose_from(so3_exp([0.01, -0.008, 0.006]), [0, 0, 0]) @ truth
    found = register(first, second, turned, 520.0, options)
    assert pose_error(found.second_from_first, truth)[1] < 0.4 * pose_error(turned, truth)[1]
    length = np.linalg.norm(found.second_from_first[:3, 3]) / np.linalg.norm(truth[:3, 3])
    assert length == pytest.approx(1, abs=0.03)


def walk(scene: Scene, count: int) -> list[FloatArray]:
    return [pose_from(so3_exp([0, 0.06 * (i - count / 2), 0]), [0.25 * (i - count / 2), 0.1 * (i % 2), 0.0])
            for i in range(count)]  # fmt: skip


def without_depth(keypoints: Keypoints, hidden: np.ndarray) -> Keypoints:
    points = keypoints.points.copy()
    points[hidden] = np.nan
    return replace(keypoints, points=points)


def test_keypoints_without_depth_are_matched_along_their_line() -> None:
    scene = Scene(1)
    numbers = ClassNumbers()
    one, two = walk(scene, 2)
    views, points = [], []
    for pose in (one, two):
        keypoints = scene.keypoints(pose)
        points.append(keypoints.points)
        views.append(make_view(CAMERA, without_depth(keypoints, np.ones(len(keypoints), bool)), scene.categories,
                               numbers))  # fmt: skip
    options = GateOptions()
    i, j, distance = match_known_poses(views[0], views[1], invert_pose(two) @ one, 4 / views[1].focal, options)
    moved = transform_points(invert_pose(two) @ one, points[0][i])
    right = np.linalg.norm(moved - points[1][j], axis=1) < 1e-3
    assert len(i) > 150
    assert right.mean() > 0.98
    assert (distance < options.ceiling).all()
    # a pose that is off by 20 degrees leaves next to nothing on its line
    turned = pose_from(so3_exp([0.35, 0, 0]), [0, 0, 0]) @ invert_pose(two) @ one
    assert len(match_known_poses(views[0], views[1], turned, 4 / views[1].focal, options)[0]) < 0.1 * len(i)


def refine_scene(block: int = 128) -> tuple[list[View], list[FloatArray], dict[int, RefinedPoints]]:
    """Seven keyframes of a scene; depth is noisy and missing for a third of the keypoints. Also the true points."""
    scene, numbers = Scene(5), ClassNumbers()
    poses = walk(scene, 7)
    views, truths = [], []
    for pose in poses:
        keypoints = scene.keypoints(pose)
        truths.append(keypoints.points.astype(np.float64))
        depth = keypoints.points[:, 2:]
        noise = scene.random.normal(size=depth.shape) * (0.0012 + 0.0019 * (depth - 0.4) ** 2)
        noisy = replace(keypoints, points=(keypoints.points * (1 + noise / depth)).astype(np.float32))
        hidden = without_depth(noisy, scene.random.random(len(noisy)) < 0.3)
        views.append(make_view(CAMERA, hidden, scene.categories, numbers))
    volumes = [volume_of(CAMERA, pose, view.seen_xy, view.points) for pose, view in zip(poses, views, strict=True)]
    told: list[tuple[int, int]] = []
    found = dict(refine_points(volumes, views.__getitem__, FusionOptions(block=block), lambda *at: told.append(at)))
    assert told[-1] == (7, 7)
    assert told == sorted(told)
    return views, truths, found


@pytest.mark.parametrize("block", [128, 3])
def test_a_scene_gets_missing_points_and_better_ones(block: int) -> None:
    views, truths, found = refine_scene(block)
    assert sorted(found) == list(range(7))
    before, after, missing = [], [], []
    for number, refined in found.items():
        view, own = views[number], refined.keypoints
        error = np.linalg.norm(refined.points[:, :3] - truths[number][own], axis=1)
        measured = np.isfinite(view.points[own, 2])
        assert (measured.sum(), (~measured).sum()) == (refined.fused, refined.triangulated)
        after += error[measured].tolist()
        missing += error[~measured].tolist()
        before += np.linalg.norm(view.points[own] - truths[number][own], axis=1)[measured].tolist()
        assert np.isfinite(refined.points).all()
    # of 30 % of 7 times about 250 keypoints nearly all
    assert len(missing) > 400
    assert np.median(missing) < 0.01
    assert np.percentile(missing, 95) < 0.06
    assert np.sqrt(np.mean(np.square(after))) < 0.8 * np.sqrt(np.mean(np.square(before)))


def test_without_any_depth_a_point_needs_three_keyframes() -> None:
    """Wrong matches along a line between two keyframes are told by nothing else: they moved poses by 18 cm."""
    scene, numbers = Scene(5), ClassNumbers()
    poses = walk(scene, 4)
    keypoints = [scene.keypoints(pose) for pose in poses]
    hidden = [without_depth(found, np.ones(len(found), np.bool_)) for found in keypoints]
    views = [make_view(CAMERA, found, scene.categories, numbers) for found in hidden]
    volumes = [
        volume_of(CAMERA, pose, view.seen_xy, found.points)
        for pose, view, found in zip(poses, views, keypoints, strict=True)
    ]
    two, three = (FusionOptions(), FusionOptions().without_depth(4))
    assert (three.depths.least_agreeing, three.registration.pose_m, three.registration.pose_rad) == (2, 0.01, 0.003)
    assert FusionOptions().without_depth(2).depths.least_agreeing == 1
    with_two, with_three = (dict(refine_points(volumes, views.__getitem__, options)) for options in (two, three))
    assert sum(len(found.keypoints) for found in with_three.values()) > 200
    for number, found in with_three.items():
        assert set(found.keypoints) <= set(with_two[number].keypoints)
        truth = keypoints[number].points[found.keypoints]
        off = np.linalg.norm(found.points[:, :3] - truth, axis=1) / truth[:, 2]
        assert np.median(off) < 0.02
        assert np.percentile(off, 95) < 0.1
    pair = dict(refine_points(volumes[:2], views[:2].__getitem__, three))
    assert pair == {}


def test_neighbours_are_those_that_see_the_same() -> None:
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 3], (100, 3)).astype(np.float32)
    pixels = np.full((100, 2), 300, np.float32)
    poses = [pose_from(np.eye(3), [x, 0, 0]) for x in (0.0, 0.3, 0.6, 9.0, 9.2)]
    poses.append(pose_from(so3_exp([0, np.pi, 0]), [0.0, 0, 0]))  # looks the other way
    volumes = [volume_of(CAMERA, pose, pixels, points) for pose in poses]
    assert neighbour_pairs(volumes, 3, 0.2, 10) == [(0, 1), (0, 2), (1, 2), (3, 4)]
    assert neighbour_pairs(volumes, 1, 0.2, 10) == [(0, 1), (1, 2), (3, 4)]
    alone = volume_of(CAMERA, poses[0], np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32))
    assert np.isfinite(alone.points).all()
    assert neighbour_pairs([alone], 3, 0.2, 10) == []
    assert list(refine_points([], lambda number: pytest.fail("nothing to load"))) == []
