"""What a pose found by laying a query on the map makes of the verdict of keypoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import pose_error, so3_exp
from semdb.localization.alike import Alike
from semdb.localization.coarse import Proposal
from semdb.localization.confidence import Evidence, sigmas
from semdb.localization.edge_alignment import EdgeFit
from semdb.localization.edge_step import EdgeVerdictOptions
from semdb.localization.laid_pose import (
    LaidOptions,
    LaidPose,
    Standing,
    covariance_from,
    fused,
    judge_with,
    laid_recorded,
    may_overrule,
    shared_doubts,
    with_view,
)
from semdb.localization.laying import with_laid
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.pairs import join_pairs
from semdb.localization.pose import PoseEstimate, estimate_pose, match_views
from semdb.localization.predicted_view import Windows
from semdb.localization.search import Search, numbers_of
from semdb.localization.surface_step import SurfaceVerdictOptions, with_edges
from semdb.localization.verdict import Judgement
from semdb.localization.views import ClassNumbers
from semdb.types import FloatArray, Verdict
from tests.unit.localization_scene import Scene


def pose(shift: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> FloatArray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = so3_exp(np.radians(turn_deg)), shift
    return made


def laid(doubts: tuple[str, ...], fits_well: bool = True) -> LaidPose:
    return LaidPose(np.eye(4), np.eye(6) * 1e-4, 12, (), doubts, fits_well, "90 % of it", "better elsewhere", {})


def estimate_at(shift: float) -> PoseEstimate:
    pairs = join_pairs([])
    return PoseEstimate(pose((shift, 0, 0), (0, 0, 0)), None, pairs, 60, (60,), 30, 30, 0.6, 1.0, 0.5)


@pytest.mark.parametrize(
    ("doubts", "fits_well", "shift", "before", "after"),
    [
        ((), True, 0.0, Verdict.AMBIGUOUS, Verdict.LOCALIZED),
        ((), True, 0.3, Verdict.LOCALIZED, Verdict.LOCALIZED),
        (("few",), True, 0.0, Verdict.LOCALIZED, Verdict.LOCALIZED),  # they say the same
        (("few",), True, 0.3, Verdict.LOCALIZED, Verdict.AMBIGUOUS),  # what is laid contradicts
        (("few",), False, 0.3, Verdict.LOCALIZED, Verdict.LOCALIZED),  # it fits nowhere
        (("few",), True, 0.0, Verdict.FAILED, Verdict.FAILED),
    ],
)
def test_what_becomes_of_a_verdict(
    doubts: tuple[str, ...], fits_well: bool, shift: float, before: Verdict, after: Verdict
) -> None:
    judgement = judge_with(Judgement(before, 0.9, ""), estimate_at(shift), laid(doubts, fits_well), LaidOptions(), True)
    assert judgement.verdict is after
    assert (judgement.confidence <= 0.5) == (after is Verdict.AMBIGUOUS)


def test_doubts_say_what_is_free_and_what_fits_elsewhere() -> None:
    covariance = np.diag([0.16, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
    found = shared_doubts(covariance, Standing(0, 5, 4), LaidOptions(), (0.06, 1.5), "edges")
    assert found == [
        "only 5 keypoints vouch for where the edges fit",
        "a pose elsewhere fits too, with 4 against 5 keypoints",
        "the edges leave the pose free by 0.40 m and 0.1 deg",
    ]
    assert shared_doubts(np.eye(6) * 1e-6, Standing(0, 6, 0), LaidOptions(), (0.06, 1.5), "edges") == []


def test_many_measurements_are_not_believed_to_be_independent() -> None:
    information = np.eye(6) * 1e8
    sigma_m, sigma_deg = sigmas(covariance_from(information, np.zeros((6, 6)), 60.0))
    assert sigma_m == pytest.approx(0.006, rel=0.01)  # what keyframes share is left
    assert sigma_deg == pytest.approx(np.degrees(0.007), rel=0.01)
    apart = np.diag([0.02**2, 0, 0, 0, 0, 0])
    assert sigmas(covariance_from(information, apart, 60.0))[0] == pytest.approx(0.0404, rel=0.01)


def test_the_covariance_of_an_answer_counts_recorded_poses_that_the_verdict_does_not_look_at() -> None:
    information = np.diag([1e9, 1e6, 1e6, 1e8, 1e8, 1e8])
    covariance = covariance_from(information, np.eye(6) * 1e-4, 60.0)
    answer = covariance + laid_recorded(covariance)
    seen = np.diag(covariance) - np.repeat([0.006, 0.007], 3) ** 2
    np.testing.assert_allclose(np.diag(answer), 1.5 * seen + np.repeat([0.005, 0.005], 3) ** 2)
    exact = covariance_from(np.eye(6) * 1e12, np.zeros((6, 6)), 60.0)
    assert sigmas(exact + laid_recorded(exact))[0] == pytest.approx(0.005, rel=1e-3)


def test_two_estimates_in_one_lie_between_them() -> None:
    one, two = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), pose((0.04, 0.0, 0.0), (0.0, 2.0, 0.0))
    found, covariance = fused(one, np.eye(6) * 3e-4, two, np.eye(6) * 1e-4)
    np.testing.assert_allclose(found[:3, 3], [0.03, 0, 0], atol=1e-9)
    assert pose_error(found, pose((0.03, 0, 0), (0, 1.5, 0)))[1] < 1e-6
    np.testing.assert_allclose(covariance, np.eye(6) * 0.75e-4, atol=1e-12)


def evidence(rival: int, likeness: float = 0.9) -> Evidence:
    return Evidence(
        120, 60, 40, 0.6, 0.7, 1.0, 0.01, 0.3, rival, 2, 20, 0.3, 0.4, 0.5, likeness, 0.6, 0.8, 0.5, 0, 0.9, 0.1
    )


@pytest.mark.parametrize(
    ("convinced", "rival", "likeness", "stands"),
    [
        (True, 0, 0.9, True),
        (True, 0, 0.4, False),  # many keypoints, and yet it looks otherwise: a room of the same shapes
        (False, 0, 0.4, True),
        (True, 29, 0.9, False),  # of 40 with the best keyframe: the place is there twice
        (False, 8, 0.9, True),
        (False, 9, 0.9, False),  # of 12 that vouch
    ],
)
def test_when_a_laid_pose_stands_against_keypoints(convinced: bool, rival: int, likeness: float, stands: bool) -> None:
    assert may_overrule(convinced, evidence(rival, likeness), laid(()), LaidOptions()) is stands


def test_surfaces_are_in_doubt_where_the_image_has_edges_that_the_map_has_not() -> None:
    options, sure = SurfaceVerdictOptions(), laid(())

    def measured(explained: float, seen: int = 1000) -> EdgeFit:
        return EdgeFit(np.eye(4), np.eye(6), np.eye(6), seen, 0.3, explained)

    assert with_edges(sure, None, options) is sure
    assert with_edges(sure, measured(0.74), options).is_sure
    assert with_edges(sure, measured(0.74), options).numbers == {"surface_explained": 0.74}
    assert with_edges(sure, measured(0.5, seen=100), options).is_sure  # too few tell nothing
    [doubt] = with_edges(sure, measured(0.5), options).doubts
    assert doubt == "only 50% of the image's edges are in the map where the surfaces fit"


@pytest.mark.parametrize(("alike", "count", "is_sure"), [(0.7, 9000, True), (0.5, 9000, False), (0.5, 1000, True)])
def test_a_laid_pose_is_in_doubt_where_the_map_predicts_another_view(alike: float, count: int, is_sure: bool) -> None:
    likeness = np.zeros((60, 200), np.float32)
    compared = np.zeros((60, 200), np.bool_)
    compared.flat[:count] = True
    likeness.flat[: round(alike * count)] = 1.0
    found = with_view(laid(()), Windows(likeness, compared, 0.9), EdgeVerdictOptions(), "edges")
    assert found.is_sure is is_sure
    assert found.numbers["laid_view"] == pytest.approx(alike, abs=1e-3)
    if not is_sure:
        assert found.doubts == ("where the edges fit only 50% of the image look as the map predicts",)
        assert not found.fits_well  # nor does it stand against keypoints elsewhere


@pytest.mark.parametrize(("aside", "kept"), [(0.01, True), (5.0, False)])
def test_what_looked_alike_at_another_pose_is_no_evidence_of_a_laid_one(aside: float, kept: bool) -> None:
    scene, numbers, options = Scene(3, 300), ClassNumbers(), LocalizerOptions()
    query, keyframes = scene.query(np.eye(4), numbers), [scene.keyframe(1, scene.pose(0.1, 2), numbers)]
    search = Search(query, 1, options.pose, keyframes=list(keyframes), proposals=[Proposal(1, 1.0, 1.0)])
    search.matches = match_views(query, keyframes, options.pose)
    found = estimate_pose(query, keyframes, search.matches, options.pose)
    assert found is not None
    search.estimate = replace(found, world_from_camera=pose((aside, 0, 0), (0, 0, 0)))
    search.alike = Alike(0.4, 0.3)
    sure = replace(laid(()), covariance=np.eye(6) * 1e-6)
    doubt = Judgement(Verdict.AMBIGUOUS, 0.3, "")
    judgement, anew = with_laid(search, sure, EdgeVerdictOptions(), False, doubt, None)
    assert judgement.verdict is Verdict.LOCALIZED
    assert search.estimate.world_from_camera[0, 3] < 0.01
    assert ("alike" in numbers_of(search, anew)) is kept
