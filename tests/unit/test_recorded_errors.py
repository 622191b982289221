"""What keyframes that are left out say of how far recorded poses are off, and what of it an answer counts with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import pose_distances, pose_from, pose_offset, so3_exp
from semdb.localization.cross_validation import localized_among, localized_farther
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.pose import estimate_pose, match_views, recorded_covariance
from semdb.localization.recorded_errors import (
    MODEL,
    USUAL,
    AtQuery,
    LeftOut,
    at_query,
    measured,
    recorded_errors,
    shrunk,
    weighted,
)
from semdb.localization.views import ClassNumbers, KeyframeView, make_keyframe_view
from semdb.types import FloatArray, PoseErrors
from tests.unit.localization_scene import CAMERA, Scene

STILL = np.zeros(3)
LEVEL = np.eye(3)
NOTHING = np.zeros((6, 6))
FRAMES = 40


def times(distance: float) -> np.ndarray:
    """As many times as at a distance of 1 poses are off where two keyframes have the same share."""
    place = np.hypot(distance, MODEL.place_near)
    place = place / np.hypot(1, place / MODEL.place_far) * 0.5**MODEL.alone_power
    return np.repeat([place, np.hypot(distance, MODEL.turn_near) ** MODEL.turn_power], 3)


def left_out(metres: float, degrees: float, count: int, *, image_m: float = 0.004, seed: int = 0) -> list[LeftOut]:
    """Keyframes of a recording whose poses are off by so much at a distance of 1, one in ten by five times as much."""
    random, found = np.random.default_rng(seed), []
    covariance = np.diag(np.repeat([image_m, 0.001], 3) ** 2)
    for number in range(count):
        distance = float(random.uniform(0.5, 2.5))
        off = np.repeat([metres, np.radians(degrees)], 3) * times(distance)
        error = random.normal(size=6) * np.hypot(off * (5 if number % 10 == 9 else 1), np.sqrt(np.diag(covariance)))
        found.append(LeftOut(error, covariance, AtQuery((distance, distance), STILL, 0.5, LEVEL)))
    return found


@pytest.mark.parametrize(("metres", "degrees"), [(0.012, 0.5), (0.003, 0.25)])
def test_errors_at_a_distance_of_1_are_found_beneath_those_of_the_images(metres: float, degrees: float) -> None:
    found = measured(left_out(metres, degrees, 200))
    assert 0.9 * metres < found.position_m < 1.7 * metres  # some of the far ones count
    assert 0.9 * degrees < np.degrees(found.rotation_rad) < 1.7 * degrees
    assert (found.position_freedom, found.rotation_freedom, found.keyframes) == (600.0, 600.0, 200)
    assert measured(left_out(metres, degrees, 200), 50).position_freedom == 150.0  # each four times
    assert measured([]) == PoseErrors(0.0, 0.0, 0.0, 0.0, 0)


def test_exact_poses_have_none() -> None:
    random = np.random.default_rng(4)
    covariance = np.diag(np.repeat([0.002, 0.001], 3) ** 2)
    exact = [
        LeftOut(random.normal(size=6) * 0.0005, covariance, AtQuery((1.0, 1.0), STILL, 1.0, LEVEL)) for _ in range(12)
    ]
    found = measured(exact)
    assert found.position_m < 1e-4
    assert found.rotation_rad < 1e-4


def test_another_clock_is_no_drift() -> None:
    random = np.random.default_rng(5)
    turning = []
    for one in left_out(0.003, 0.1, 40):
        turn = random.normal(size=3) * 0.03
        error = one.error + np.r_[0, 0, 0, MODEL.clock * turn]
        turning.append(LeftOut(error, one.covariance, AtQuery(one.at.nearest, turn, 0.5, LEVEL)))
    drifting = [LeftOut(one.error, one.covariance, AtQuery(one.at.nearest, STILL, 0.5, LEVEL)) for one in turning]
    assert np.degrees(measured(turning).rotation_rad) < 0.2 < np.degrees(measured(drifting).rotation_rad)


def test_what_is_usual_counts_where_little_is_known() -> None:
    assert shrunk(None, []).position_m == pytest.approx(USUAL.position_m)
    little, much = PoseErrors(0.0003, 0.0002, 2.0, 2.0), PoseErrors(0.0003, 0.0002, 200.0, 200.0)
    assert shrunk(None, [little]).position_m == pytest.approx((USUAL.position_m * 0.0003) ** 0.5)
    assert 0.0003 < shrunk(None, [much]).position_m < 0.00035
    assert shrunk(None, [PoseErrors(0.0, 0.0, 200.0, 200.0)]).position_m < 2e-5


def test_recordings_share_by_the_pairs_of_their_keyframes() -> None:
    one, other = PoseErrors(0.008, 0.005, 90.0, 60.0, 12), PoseErrors(0.002, 0.001, 30.0, 30.0, 12)
    found = weighted([one, None, other, one], [60, 20, 10, 10])
    assert [(round(item.position_freedom, 6), item.position_m) for item in found] == [(63.0, 0.008), (3.0, 0.002)]
    assert weighted([None], [5]) == []


def at(distance: float, turn: FloatArray = STILL, alone: float = 0.5, axes: FloatArray = LEVEL) -> AtQuery:
    return AtQuery((distance, distance), turn, alone, axes)


def test_errors_grow_with_the_distance_and_along_the_turn_of_the_query() -> None:
    errors = PoseErrors(0.008, 0.0055, 90.0, 60.0)
    near, far = (recorded_errors(errors, at(distance), NOTHING) for distance in (0.8, 1.6))
    along = np.repeat([0.008, 0.0055], 3) * MODEL.between * np.sqrt([*MODEL.axes, 1, 1, 1])
    np.testing.assert_allclose(np.sqrt(np.diag(near)), along * times(0.8))
    np.testing.assert_allclose(np.sqrt(np.diag(far)), along * times(1.6))
    assert recorded_errors(errors, at(9.0), NOTHING)[0, 0] < 1.2 * recorded_errors(errors, at(6.0), NOTHING)[0, 0]
    one = recorded_errors(errors, at(0.8, alone=1.0), NOTHING)
    assert np.sqrt(one[0, 0] / near[0, 0]) == pytest.approx(2**MODEL.alone_power)  # nothing cancels
    added = recorded_errors(errors, at(0.8, np.array([0.0, 0.05, 0.0])), NOTHING) - near
    assert np.sqrt(added[4, 4]) == pytest.approx(MODEL.clock * 0.05)
    added[4, 4] = 0.0
    np.testing.assert_allclose(added, 0.0, atol=1e-18)  # about no other axis, and nothing of the place
    exact = recorded_errors(PoseErrors(1e-5, 1e-5, 90.0, 60.0), at(0.8, np.array([0.0, 0.05, 0.0])), NOTHING)
    assert np.sqrt(exact).max() < 3e-5  # where poses are exact, so is their clock


def test_a_place_is_least_off_along_the_view() -> None:
    errors, seen = PoseErrors(0.008, 0.0055, 90.0, 60.0), so3_exp([0, np.pi / 2, 0])  # it looks along x of the world
    level, turned = (recorded_errors(errors, at(0.8, axes=axes), NOTHING) for axes in (LEVEL, seen))
    np.testing.assert_allclose(turned[:3, :3], seen @ level[:3, :3] @ seen.T, atol=1e-18)
    assert turned[0, 0] == pytest.approx(turned[2, 2] * MODEL.axes[2] / MODEL.axes[0])
    assert sum(MODEL.axes) == pytest.approx(3.0)  # as much in all as the keyframes told


def test_images_are_believed_less_where_poses_are_off() -> None:
    images = np.diag(np.repeat([0.004, 0.002], 3) ** 2)
    images[0, 4] = images[4, 0] = 0.5 * 0.004 * 0.002
    nowhere = AtQuery((0.0, 0.0), STILL, 0.0, LEVEL)
    off = images + recorded_errors(PoseErrors(0.008, 0.0, 90.0, 60.0), nowhere, images)
    np.testing.assert_allclose(np.diag(off), np.diag(images) * np.repeat([MODEL.place_images, 1.0], 3))
    both = images + recorded_errors(PoseErrors(0.008, 0.0055, 90.0, 60.0), replace(at(0.8)), images)
    assert both[4, 4] > MODEL.turn_images * images[4, 4]
    assert both[0, 4] == pytest.approx(images[0, 4] * np.sqrt(MODEL.place_images * MODEL.turn_images))
    assert np.linalg.eigvalsh(both).min() > 0
    exact = recorded_errors(PoseErrors(1e-5, 1e-5, 90.0, 60.0), at(0.8), images)
    assert np.abs(exact).max() < 1e-9


def test_a_turn_is_that_beyond_those_of_the_keyframes() -> None:
    pose = pose_from(so3_exp([0, 0, np.pi / 2]), [1.0, 2.0, 3.0])
    turns = np.array([[0.05, 0.0, 0.0], [0.01, 0.0, 0.0], [0.03, 0.0, 0.0]])
    found = at_query((0.7, 0.8), turns, [30, 10], pose)
    np.testing.assert_allclose(found.turn, [0.0, 0.035, 0.0], atol=1e-12)
    assert (found.nearest, found.alone) == ((0.7, 0.8), pytest.approx(0.625))
    nobody = at_query((0.7, 0.8), turns, [0, 0], pose)
    np.testing.assert_allclose(nobody.turn, [0.0, 0.03, 0.0], atol=1e-12)
    assert nobody.alone == pytest.approx(0.5)


def bent_recording(
    random: np.random.Generator, metres: float, degrees: float
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Poses of a camera that passes by the scene, true and as a recording has them, which bends them smoothly."""
    true, recorded = [], []
    phase, rates = random.uniform(0, 2 * np.pi, 6), random.uniform(0.1, 0.2, 6)
    size = np.repeat([metres, np.radians(degrees)], 3)
    for number in range(FRAMES):
        off = size * np.sin(phase + rates * number)
        pose = pose_from(so3_exp([0, 0.25 * np.sin(number / 8), 0]), [0.05 * (number - FRAMES / 2), 0.1, 0.0])
        true.append(pose)
        recorded.append(pose_from(so3_exp(off[3:]) @ pose[:3, :3], pose[:3, 3] + off[:3]))
    return true, recorded


def nearest(pose: FloatArray, keyframes: Sequence[KeyframeView], count: int) -> list[KeyframeView]:
    others = [one for one in keyframes if one.world_from_camera is not pose]
    order = np.argsort(pose_distances(pose, np.stack([one.world_from_camera for one in others])), kind="stable")
    return [others[n] for n in order[:count]]


@pytest.mark.parametrize(("metres", "degrees"), [(0.02, 0.6), (0.0, 0.0)])
def test_covariances_of_a_recording_that_drifts_are_true(metres: float, degrees: float) -> None:
    random, errors, sigmas = np.random.default_rng(3), [], []
    options = LocalizerOptions()
    for seed in range(2 if metres else 1):
        scene, numbers = Scene(seed, 200), ClassNumbers()
        true, recorded = bent_recording(random, metres, degrees)
        keyframes = []
        for n in range(0, FRAMES, 4):
            seen = scene.keypoints(true[n], pixel_noise=0.5)
            keyframes.append(make_keyframe_view(n, CAMERA, recorded[n], seen, scene.categories, numbers))
        out = [localized_among(own, nearest(own.world_from_camera, keyframes, 5), options) for own in keyframes]
        known = measured([one for one in out if one is not None])
        assert known.keyframes == len(keyframes)
        for n in range(1, FRAMES - 2, 4):
            query = scene.query(true[n], numbers, pixel_noise=0.5)
            among = [replace(one, pose_errors=known) for one in nearest(recorded[n], keyframes, 3)]
            found = estimate_pose(query, among, match_views(query, among, options.pose), options.pose)
            assert found is not None
            covariance = recorded_covariance(found)
            offset = pose_offset(found.world_from_camera, recorded[n])
            parts = (slice(3), slice(3, 6))
            errors.append([offset[of] @ np.linalg.solve(covariance[of, of], offset[of]) for of in parts])
            sigmas.append(np.sqrt(np.trace(covariance[:3, :3]) / np.trace(found.covariance[:3, :3])))
    place, turn = np.median(errors, axis=0)
    assert 0.4 < place < 4
    assert 0.3 < turn < 4  # what bends so slowly is off by less between keyframes than it is taken to be
    assert (np.array(errors) < 7.815).mean(axis=0).min() > 0.88
    assert np.median(sigmas) > 1.2 if metres else np.median(sigmas) < 1.001  # exact poses add nothing


def test_a_keyframe_is_localized_among_farther_and_farther_ones() -> None:
    scene, numbers, options = Scene(0, 200), ClassNumbers(), LocalizerOptions()
    true, _ = bent_recording(np.random.default_rng(3), 0.0, 0.0)
    keyframes = [
        make_keyframe_view(n, CAMERA, true[n], scene.keypoints(true[n], pixel_noise=0.5), scene.categories, numbers)
        for n in range(0, 24, 3)
    ]
    own = keyframes[3]
    others = nearest(own.world_from_camera, keyframes, 4)
    found = localized_farther(own, others, options, 2, 3)
    assert all(one is not None for one in found)
    first, second, third = (one.at.nearest[0] for one in found)
    distances = pose_distances(own.world_from_camera, np.stack([one.world_from_camera for one in others]))
    np.testing.assert_allclose([first, second, third], distances[:3], rtol=0.05)
    alone = localized_among(own, others[:2], options)
    np.testing.assert_array_equal(found[0].error, alone.error)  # to the bit
    assert len(localized_farther(own, others[:2], options, 2, 3)) == 2
    assert localized_farther(own, [], options, 2, 3) == [None]
