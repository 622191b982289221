"""Robust PnP, guided matching, bundle adjustment: poses against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.geometry import pose_error
from semdb.geometry.sensor import depth_noise
from semdb.localization.bundle_kernels import depth_sigma
from semdb.localization.matching import Evidence, MatchingOptions
from semdb.localization.pose import (
    _excess_variance,
    estimate_pose,
    first_pose,
    match_view,
    recorded_covariance,
)
from semdb.localization.pose_options import PoseOptions
from semdb.localization.recorded_errors import MODEL
from semdb.localization.rivals import _iterations_for, rival_pose
from semdb.localization.views import ClassNumbers, make_keyframe_view
from semdb.types import PoseErrors
from tests.unit.localization_scene import CAMERA, DISTORTED, Scene

NO_DEPTH = PoseOptions(use_query_depth=False)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), metres=st.floats(0, 0.5), degrees=st.floats(0, 20))
def test_exact_views_give_the_exact_pose(seed: int, metres: float, degrees: float) -> None:
    scene, numbers = Scene(seed), ClassNumbers()
    keyframe = scene.keyframe(1, np.eye(4), numbers)
    truth = scene.pose(metres, degrees)
    query = scene.query(truth, numbers)
    matches = [match_view(query, keyframe, NO_DEPTH.matching)]
    estimate = estimate_pose(query, [keyframe], matches, NO_DEPTH)
    assert estimate is not None
    distance, angle = pose_error(estimate.world_from_camera, truth)
    assert distance < 1e-4
    assert angle < 1e-3
    assert estimate.inliers >= 60


def test_a_first_pose_is_refined_with_a_keyframe_that_joins() -> None:
    first_errors, errors = [], []
    for seed in range(8):
        scene, numbers = Scene(seed, count=300), ClassNumbers()
        keyframes = [
            scene.keyframe(i, scene.pose(0.2, 6), numbers, pixel_noise=0.5, depth_noise=0.01) for i in range(2)
        ]
        truth = scene.pose(0.2, 8)
        query = scene.query(truth, numbers, pixel_noise=0.5)
        matches = [match_view(query, keyframe, NO_DEPTH.matching) for keyframe in keyframes]
        first = first_pose(query, keyframes[:1], matches[:1], NO_DEPTH)
        assert first is not None
        assert first.keyframes == 1
        assert first.first.of_best == first.first_inliers  # of one keyframe
        alone = estimate_pose(query, keyframes[:1], matches[:1], NO_DEPTH, first)
        joined = estimate_pose(query, keyframes, matches, NO_DEPTH, first)
        again = estimate_pose(query, keyframes, matches, NO_DEPTH)
        assert alone is not None
        assert joined is not None
        assert again is not None
        assert alone.first_inliers == first.first_inliers
        assert joined.first_inliers >= first.first_inliers
        assert abs(joined.first_inliers - again.first_inliers) <= 0.05 * again.first_inliers
        assert abs(joined.inliers - again.inliers) <= 0.03 * again.inliers
        assert len(joined.pairs) > 1.5 * len(alone.pairs)  # those of both keyframes
        assert pose_error(joined.world_from_camera, again.world_from_camera)[0] < 5e-4
        first_errors.append(pose_error(first.world_from_camera, truth)[0])
        errors.append(pose_error(joined.world_from_camera, truth)[0])
    assert np.mean(errors) < np.mean(first_errors)
    assert np.median(errors) < 0.003


def test_a_rival_is_looked_for_as_long_as_it_takes() -> None:
    assert _iterations_for(1.0) == 50
    assert _iterations_for(0.3) == 253  # 1 - (1 - 0.027)^253 > 0.999
    assert _iterations_for(0.05) == 1000
    assert _iterations_for(0.0) == 1000


def test_distortion_is_in_the_keypoints() -> None:
    scene, numbers = Scene(3), ClassNumbers()
    keyframe = scene.keyframe(1, np.eye(4), numbers, DISTORTED)
    truth = scene.pose(0.3, 10)
    query = scene.query(truth, numbers, DISTORTED)
    estimate = estimate_pose(query, [keyframe], [match_view(query, keyframe, NO_DEPTH.matching)], NO_DEPTH)
    assert estimate is not None
    distance, angle = pose_error(estimate.world_from_camera, truth)
    assert distance < 1e-4
    assert angle < 1e-3


def test_bundle_adjustment_beats_pnp_when_depth_is_noisy() -> None:
    errors: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(12):
        scene, numbers = Scene(seed, count=200), ClassNumbers()
        keyframes = [
            scene.keyframe(i, scene.pose(0.3, 8), numbers, pixel_noise=0.5, depth_noise=0.01) for i in range(3)
        ]
        truth = scene.pose(0.3, 10)
        query = scene.query(truth, numbers, pixel_noise=0.5)
        for bundle in (True, False):
            options = PoseOptions(bundle=bundle, use_query_depth=False)
            matches = [match_view(query, keyframe, options.matching) for keyframe in keyframes]
            estimate = estimate_pose(query, keyframes, matches, options)
            assert estimate is not None
            errors[bundle].append(pose_error(estimate.world_from_camera, truth)[0])
    assert np.median(errors[True]) < 0.005
    assert np.mean(errors[True]) < np.mean(errors[False])


def test_a_pose_is_the_same_where_nothing_is_asked_of_recorded_poses() -> None:
    scene, numbers = Scene(4, count=200), ClassNumbers()
    keyframes = [scene.keyframe(i, scene.pose(0.3, 8), numbers, pixel_noise=0.5, depth_noise=0.01) for i in range(3)]
    query = scene.query(scene.pose(0.3, 10), numbers, pixel_noise=0.5)
    matches = [match_view(query, keyframe, NO_DEPTH.matching) for keyframe in keyframes]
    usual = estimate_pose(query, keyframes, matches, NO_DEPTH)
    less = estimate_pose(query, keyframes, matches, replace(NO_DEPTH, evident=False))
    assert usual is not None
    assert less is not None
    np.testing.assert_array_equal(less.world_from_camera, usual.world_from_camera)
    assert usual.covariance is not None
    assert less.covariance is not None
    np.testing.assert_array_equal(less.covariance, usual.covariance)
    assert usual.recorded is not None
    assert less.recorded is None
    np.testing.assert_array_equal(recorded_covariance(less), usual.covariance)


def test_what_counts_with_recorded_poses_is_what_the_residuals_make_of_the_images() -> None:
    scene, numbers = Scene(4, count=200), ClassNumbers()
    keyframes = [
        replace(
            scene.keyframe(i, scene.pose(0.3, 8), numbers, pixel_noise=2.5, depth_noise=0.01),
            pose_errors=PoseErrors(0.01, 0.01, 300.0, 300.0, 100),
        )
        for i in range(3)
    ]
    query = scene.query(scene.pose(0.3, 10), numbers, pixel_noise=2.5)
    matches = [match_view(query, keyframe, NO_DEPTH.matching) for keyframe in keyframes]
    found = estimate_pose(query, keyframes, matches, NO_DEPTH)
    assert found is not None
    assert found.covariance is not None
    assert _excess_variance(found.residual_px, NO_DEPTH) > 1.3
    whole = recorded_covariance(found)
    assert whole is not None
    times = np.diag(whole) / np.diag(found.covariance)
    assert (times[:3] > MODEL.place_images).all()
    assert (times[3:] > MODEL.turn_images).all()
    np.testing.assert_allclose(
        whole[3:, :3], found.covariance[3:, :3] * np.sqrt(MODEL.turn_images * MODEL.place_images), rtol=1e-6
    )


def test_query_depth_improves_the_position() -> None:
    errors: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(12):
        scene, numbers = Scene(seed, count=60), ClassNumbers()
        keyframe = scene.keyframe(1, np.eye(4), numbers, pixel_noise=1.0)
        truth = scene.pose(0.3, 10)
        query = scene.query(truth, numbers, pixel_noise=1.0)
        for use_depth in (True, False):
            options = PoseOptions(use_query_depth=use_depth)
            estimate = estimate_pose(query, [keyframe], [match_view(query, keyframe, options.matching)], options)
            assert estimate is not None
            errors[use_depth].append(pose_error(estimate.world_from_camera, truth)[0])
    assert np.mean(errors[True]) < 0.9 * np.mean(errors[False])


def test_covariance_is_honest() -> None:
    """Normalised estimation errors squared of 6 degrees of freedom have a mean of 6."""
    squared = []
    for seed in range(60):
        scene, numbers = Scene(seed, count=150), ClassNumbers()
        keyframe = scene.keyframe(1, np.eye(4), numbers, pixel_noise=1.0)
        truth = scene.pose(0.3, 10)
        query = scene.query(truth, numbers, pixel_noise=1.0)
        options = PoseOptions(use_query_depth=False, inlier_px=12, max_reprojection_px=12)
        estimate = estimate_pose(query, [keyframe], [match_view(query, keyframe, options.matching)], options)
        assert estimate is not None
        assert estimate.covariance is not None
        turn = estimate.world_from_camera[:3, :3] @ truth[:3, :3].T
        vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        error = np.concatenate([estimate.world_from_camera[:3, 3] - truth[:3, 3], vector])
        squared.append(error @ np.linalg.solve(estimate.covariance, error))
    assert 4.0 < np.mean(squared) < 9.0


def test_wrong_pairs_are_outvoted_and_a_rival_place_is_seen() -> None:
    scene, numbers = Scene(5, count=300), ClassNumbers()
    keyframe = scene.keyframe(1, np.eye(4), numbers)
    elsewhere = np.eye(4)
    elsewhere[0, 3] = 50.0  # the same look again, fifty metres away
    keypoints = scene.keypoints(np.eye(4))
    twin = make_keyframe_view(2, CAMERA, elsewhere, keypoints, scene.categories, numbers)
    truth = scene.pose(0.2, 5)
    query = scene.query(truth, numbers)
    matches = [match_view(query, k, NO_DEPTH.matching) for k in (keyframe, twin)]
    estimate = estimate_pose(query, [keyframe, twin], matches, NO_DEPTH)
    assert estimate is not None
    rival = rival_pose(query, [keyframe, twin], matches, estimate, NO_DEPTH)
    assert rival > 0.8 * estimate.inliers
    alone = estimate_pose(query, [keyframe], matches[:1], NO_DEPTH)
    assert alone is not None
    assert rival_pose(query, [keyframe], matches[:1], alone, NO_DEPTH) == 0


def test_nothing_in_common_gives_no_pose() -> None:
    numbers = ClassNumbers()
    keyframe = Scene(1).keyframe(1, np.eye(4), numbers)
    query = Scene(2).query(np.eye(4), numbers)
    estimate = estimate_pose(query, [keyframe], [match_view(query, keyframe, NO_DEPTH.matching)], NO_DEPTH)
    assert estimate is None or estimate.inliers < 14


def test_objects_only_uses_no_background() -> None:
    scene, numbers = Scene(7), ClassNumbers()
    keyframe = scene.keyframe(1, np.eye(4), numbers)
    query = scene.query(scene.pose(0.1, 5), numbers)
    options = PoseOptions(matching=MatchingOptions(evidence=Evidence.OBJECTS), use_query_depth=False)
    estimate = estimate_pose(query, [keyframe], [match_view(query, keyframe, options.matching)], options)
    assert estimate is not None
    assert (query.classes[estimate.pairs.query] >= 0).all()
    assert estimate.pairs.same_class.all()


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    assert depth_sigma(np.array([0.4]))[0] == pytest.approx(0.0012)
    z = np.linspace(0.2, 9.0, 200)
    np.testing.assert_array_equal(depth_noise(z), depth_sigma(z))
    assert depth_sigma(np.array([2.4]))[0] == pytest.approx(0.0012 + 0.0019 * 4)


def test_camera_of_the_scene_sees_it() -> None:
    assert len(Scene(0).keypoints(np.eye(4), CAMERA)) > 200
