"""What a map predicts from a pose: the place looks like it, one that is the same but for some plates does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.localization.confidence import Evidence
from semdb.localization.predicted_view import PlacedView, best_seen, compare_view, small_view
from semdb.localization.verdict import Judgement, VerdictOptions
from semdb.localization.view_kernels import fill
from semdb.localization.view_step import Seen, Standing, ViewOptions, beats, is_like, is_weak, judge_seen, stand
from semdb.perception.quality import blurred_like
from semdb.types import Camera, Float32Array, FloatArray, ImageArray, Verdict

CAMERA = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)
WALL_M = 2.0
PLATES = ((-0.5, 0.1), (0.4, -0.2), (0.9, 0.3))  # of the one place; another has them elsewhere
OTHER = ((-0.2, 0.1), (0.7, -0.2), (0.9, 0.3))
OPTIONS = replace(ViewOptions(), least_windows=600)


def shifted(x: float, y: float = 0.0, z: float = 0.0) -> FloatArray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def look(pose: FloatArray, plates: tuple[tuple[float, float], ...] = PLATES) -> tuple[ImageArray, Float32Array]:
    """A wall of panels, with dark plates."""
    v, u = np.mgrid[:240, :320].astype(np.float64)
    depth = np.full(u.shape, WALL_M - pose[2, 3])
    x, y = (u - CAMERA.cx) / CAMERA.fx * depth + pose[0, 3], (v - CAMERA.cy) / CAMERA.fy * depth + pose[1, 3]
    grey = np.full(u.shape, 200.0)
    grey[np.abs((x + 0.3) % 0.6 - 0.3) < 0.012] = 120
    for a, b in plates:
        grey[(np.abs(x - a) < 0.09) & (np.abs(y - b) < 0.07)] = 60
    return grey.astype(np.uint8), depth.astype(np.float32)


def placed(number: int, pose: FloatArray, plates: tuple[tuple[float, float], ...] = PLATES) -> PlacedView:
    grey, depth = look(pose, plates)
    return PlacedView(number, pose, small_view(CAMERA, grey, depth))


KEYFRAMES = [placed(1, shifted(0.1, 0.02, -0.2)), placed(2, shifted(-0.4, 0.0, 0.1))]


def seen(pose: FloatArray, plates: tuple[tuple[float, float], ...] = PLATES) -> Seen:
    """A pose where the map has `plates`, and a query at the origin of the one place."""
    keyframes = [placed(1, shifted(0.1, 0.02, -0.2), plates), placed(2, shifted(-0.4, 0.0, 0.1), plates)]
    return Seen(pose, compare_view(small_view(CAMERA, look(shifted(0.0))[0]), pose, keyframes))


def test_a_right_pose_looks_like_what_is_predicted() -> None:
    found = seen(shifted(0.0))
    assert found.alike > 0.98
    assert found.windows.known > 0.95
    assert is_like(found, OPTIONS)


@pytest.mark.parametrize("x", [0.6, -0.6, 0.15])
def test_a_pose_a_panel_aside_does_not(x: float) -> None:
    found = seen(shifted(x))
    assert found.alike < 0.8
    assert not is_like(found, OPTIONS)
    assert beats(seen(shifted(0.0)), found, OPTIONS)
    assert not beats(found, seen(shifted(0.0)), OPTIONS)


def test_a_place_that_is_the_same_but_for_plates_is_beaten() -> None:
    right, other = seen(shifted(0.0)), seen(shifted(0.0), OTHER)
    turned = replace(other, world_from_camera=shifted(5.0))
    assert other.alike > 0.5  # most of it is the same
    standing = stand([turned, right], OPTIONS)
    assert standing.best is right
    assert standing.is_sure(OPTIONS)


def test_two_places_that_are_the_same_are_both_there() -> None:
    right = seen(shifted(0.0))
    twin = replace(right, world_from_camera=shifted(5.0))
    standing = stand([right, twin], OPTIONS)
    assert len(standing.unbeaten) == 1
    assert not standing.is_sure(OPTIONS)


def test_nothing_is_predicted_where_keyframes_show_nothing() -> None:
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    found = seen(behind)
    assert found.windows.known == 0
    assert found.alike == 0


def test_keyframes_that_show_most_come_first() -> None:
    query = small_view(CAMERA, look(shifted(0.0))[0])
    order = best_seen([*KEYFRAMES, placed(3, shifted(4.0)), placed(4, shifted(0.0))], shifted(0.0), query, 3)
    assert [keyframe.keyframe_id for keyframe in order] == [4, 1, 2]


def evidence(**values: float) -> Evidence:
    numbers: dict[str, float] = dict.fromkeys(Evidence.__dataclass_fields__, 0.5)
    numbers |= {"inliers": 120, "first_of_best": 20, "agreement": 0.3, "sigma_m": 0.01, "sigma_deg": 0.2, "rival": 18}
    return Evidence(**(numbers | values))  # type: ignore[arg-type]


DOUBT = Judgement(Verdict.AMBIGUOUS, 0.3, "a pose elsewhere has 18 against 20 inliers")
CONVINCED = Judgement(Verdict.LOCALIZED, 0.9, "120 keypoints agree")


def test_a_sure_pose_is_localized_where_keypoints_agree_and_are_precise() -> None:
    standing = Standing(seen(shifted(0.0)), ())
    found = judge_seen(DOUBT, evidence(), standing, True, OPTIONS, VerdictOptions())
    assert found.verdict is Verdict.LOCALIZED
    assert found.confidence == OPTIONS.confidence
    for lacking in ({"inliers": 12}, {"sigma_m": 0.07}, {"sigma_deg": 2.0}, {"spread": 0.1}):
        assert judge_seen(DOUBT, evidence(**lacking), standing, True, OPTIONS, VerdictOptions()) is DOUBT
    assert judge_seen(DOUBT, evidence(), standing, False, OPTIONS, VerdictOptions()) is DOUBT


def test_weak_keypoints_do_not_stand_against_another_pose_that_looks_as_much_like_it() -> None:
    right = seen(shifted(0.0))
    rival = Standing(right, (replace(right, world_from_camera=shifted(5.0)),))
    found = judge_seen(CONVINCED, evidence(), rival, True, OPTIONS, VerdictOptions())
    assert found.verdict is Verdict.AMBIGUOUS
    assert found.confidence == 0.5
    poor = Standing(seen(shifted(0.6)), ())
    assert judge_seen(CONVINCED, evidence(), poor, True, OPTIONS, VerdictOptions()) is CONVINCED
    assert judge_seen(CONVINCED, evidence(), poor, False, OPTIONS, VerdictOptions()).verdict is Verdict.AMBIGUOUS


def test_weak_keypoints_do_not_stand_where_the_image_does_not_look_as_predicted() -> None:
    right = seen(shifted(0.0))
    unlike = replace(right, windows=replace(right.windows, likeness=np.zeros_like(right.windows.likeness)))
    found = judge_seen(CONVINCED, evidence(), Standing(unlike, ()), True, OPTIONS, VerdictOptions())
    assert found.verdict is Verdict.AMBIGUOUS
    assert found.reason == "only 0% of the image look as the map predicts"


def test_where_edges_were_laid_fewer_keypoints_vouch() -> None:
    standing = Standing(seen(shifted(0.0)), ())
    for inliers, verdict in ((8, Verdict.LOCALIZED), (7, Verdict.AMBIGUOUS)):
        found = judge_seen(DOUBT, evidence(inliers=inliers), standing, True, OPTIONS, VerdictOptions(), laid=True)
        assert found.verdict is verdict


def test_an_image_of_little_contrast_looks_like_one_that_is_brighter() -> None:
    """A query whose contrast was stretched, and one at a quarter of the light."""
    grey, _ = look(shifted(0.0))
    dark = grey * 0.1  # 6 to 20, where keyframes have 60 to 200
    for dim, stretch in (
        (grey * 0.25, None),
        (np.clip((grey - 60.0) / 140 * 255, 0, 255), (60.0, 200.0)),
        ((dark - 6) / 14 * 255, (6.0, 20.0)),
    ):
        query = small_view(CAMERA, np.rint(dim).astype(np.uint8), stretch=stretch)
        right, other = (compare_view(query, shifted(x), KEYFRAMES) for x in (0.0, 0.6))
        assert right.alike > 0.97
        assert other.alike < 0.8
    stretched = small_view(CAMERA, np.full((240, 320), 255, np.uint8), stretch=(60.0, 200.0))
    assert stretched.grey.max() == pytest.approx(200)


def test_holes_between_depths_of_one_surface_are_closed() -> None:
    nearest = np.full((6, 30), np.inf, np.float32)
    nearest[:, :10], nearest[:, 13:18], nearest[:, 28:] = 2.0, 2.2, 5.0
    filled = np.empty_like(nearest)
    fill(nearest, filled)
    assert filled[3, 10:13] == pytest.approx([1 / (0.5 * (1 - k / 4) + k / 4 / 2.2) for k in (1, 2, 3)], rel=1e-5)
    assert np.isinf(filled[:, 18:28]).all()  # a wide one, from a thing to what lies behind
    assert (filled[:, :10] == 2.0).all()


@pytest.mark.parametrize(("away", "known"), [(0.0, True), (1.5, True), (4.0, False)])
def test_what_a_keyframe_shows_too_coarsely_is_not_known(away: float, known: bool) -> None:
    """A keyframe that saw the wall from so much farther away."""
    far = shifted(0.0, 0.0, -away)
    found = compare_view(small_view(CAMERA, look(shifted(0.0))[0]), shifted(0.0), [placed(1, far)])
    assert (found.known > 0.9) is known
    assert found.alike > 0.95 or not known


@pytest.mark.parametrize(
    ("values", "weak"),
    [({}, True), ({"agreement": 0.5}, False), ({"first_of_best": 95}, False), ({"likeness": 1.0}, True)],
)
def test_which_keypoints_are_weak(values: dict[str, float], weak: bool) -> None:
    assert is_weak(evidence(**values), OPTIONS) is weak


def test_an_image_that_motion_has_blurred_looks_like_what_is_predicted_blurred_alike() -> None:
    blur = (22.0, 30.0)
    grey = blurred_like(look(shifted(0.0))[0], blur)
    sharp, alike = (
        compare_view(small_view(CAMERA, grey, blur=known), shifted(0.0), KEYFRAMES).alike for known in (None, blur)
    )
    assert sharp < 0.75
    assert alike > 0.97
    there = small_view(CAMERA, grey, blur=blur)
    assert compare_view(there, shifted(0.15), KEYFRAMES).alike < 0.8  # it still tells another place
