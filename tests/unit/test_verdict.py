"""When a pose is `localized`, when it is not, and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.localization.alike import Alike
from semdb.localization.confidence import Evidence, confidence_of, sigmas
from semdb.localization.depth_step import DepthVerdictOptions, only_unsure, weigh_unsure
from semdb.localization.pose import Pairs, PoseEstimate
from semdb.localization.verdict import VerdictOptions, convinces, judge
from semdb.types import Verdict

OPTIONS = VerdictOptions()
NOTHING = np.zeros(0, np.int32)
GOOD = PoseEstimate(
    world_from_camera=np.eye(4),
    covariance=np.diag([1e-6] * 3 + [1e-6] * 3),
    pairs=Pairs(NOTHING, NOTHING, NOTHING, np.zeros(0, np.bool_)),
    inliers=120,
    per_keyframe=(120,),
    first_inliers=80,
    first_of_best=80,
    agreement=0.7,
    residual_px=0.8,
    spread=0.6,
)
EVIDENCE = Evidence(
    inliers=120,
    first_inliers=80,
    first_of_best=80,
    agreement=0.7,
    spread=0.6,
    residual_px=0.8,
    sigma_m=0.001,
    sigma_deg=0.06,
    rival=0,
    supporters=2,
    second=40,
    explained=0.4,
    query_share=0.15,
    aligned=0.8,
    likeness=0.8,
    confirmed=0.8,
    coverage=0.9,
    classes=0.8,
    class_points=100,
    cosine=0.95,
    cosine_gap=0.1,
)


def test_a_well_supported_pose_is_localized_and_ends_the_search() -> None:
    found = judge(EVIDENCE, OPTIONS)
    assert found.verdict is Verdict.LOCALIZED
    assert found.confidence > 0.9
    assert convinces(GOOD, OPTIONS)


def test_no_pose_or_next_to_none_is_failed() -> None:
    for evidence in (None, replace(EVIDENCE, inliers=7)):
        found = judge(evidence, OPTIONS)
        assert (found.verdict, found.confidence) == (Verdict.FAILED, 0.0)
    for estimate in (None, replace(GOOD, inliers=7)):
        assert not convinces(estimate, OPTIONS)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"inliers": 19}, "only 19 keypoints"),
        ({"inliers": 80, "first_inliers": 9, "agreement": 0.9}, "without the pose as a guide only 9"),
        ({"inliers": 80, "first_inliers": 24, "agreement": 0.3}, "30%"),
        ({"spread": 0.125}, "small part"),
        ({"sigma_m": 0.1}, "0.10 m"),
        ({"sigma_deg": 3.0}, "3.0 deg"),
        ({"rival": 60}, "elsewhere has 60 against 80"),
        ({"likeness": 0.05, "agreement": 0.36, "confirmed": 0.2}, "all evidence together"),
    ],
)
def test_every_doubt_makes_it_ambiguous_and_is_named(changes: dict[str, float], words: str) -> None:
    found = judge(replace(EVIDENCE, **changes), OPTIONS)
    assert found.verdict is Verdict.AMBIGUOUS
    assert words in found.reason
    confidence = confidence_of(replace(EVIDENCE, **changes))
    assert found.confidence == (min(confidence, 0.5) if "rival" in changes else confidence)


def test_few_pairs_that_agree_well_are_enough() -> None:
    few = replace(EVIDENCE, first_inliers=10, agreement=0.36)
    assert judge(few, replace(OPTIONS, localized_confidence=0.0)).verdict is Verdict.LOCALIZED


def test_very_many_inliers_are_enough_however_few_agreed_at_first() -> None:
    guided = replace(EVIDENCE, inliers=129, first_inliers=14, first_of_best=6, agreement=0.15)
    assert judge(guided, replace(OPTIONS, localized_confidence=0.0)).verdict is Verdict.LOCALIZED
    assert judge(guided, OPTIONS).verdict is Verdict.LOCALIZED  # what lies about them looks alike
    assert judge(replace(guided, likeness=0.6), OPTIONS).verdict is Verdict.AMBIGUOUS
    assert judge(replace(guided, inliers=60), OPTIONS).verdict is Verdict.FAILED


def test_a_wrong_pose_fed_by_guided_matches_is_failed() -> None:
    """30 guided inliers, 12 of 70 before: seen on a real recording, 1.3 m off."""
    wrong = replace(EVIDENCE, inliers=30, first_inliers=12, first_of_best=12, agreement=12 / 70, spread=0.4)
    found = judge(wrong, OPTIONS)
    assert (found.verdict, found.confidence) == (Verdict.FAILED, 0.0)
    for doubtful in ({"agreement": 0.25}, {"first_inliers": 17}):
        assert judge(replace(wrong, **doubtful), OPTIONS).verdict is Verdict.AMBIGUOUS


def test_confidence_grows_with_support_and_falls_with_a_rival() -> None:
    values = [confidence_of(replace(EVIDENCE, inliers=count)) for count in (10, 20, 40, 80)]
    assert values == sorted(values)
    assert confidence_of(replace(EVIDENCE, rival=60)) < confidence_of(EVIDENCE)
    assert 0 <= min(values) <= max(values) <= 1


def test_sigma_is_that_of_the_worst_axis() -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = turn @ np.diag([1e-4, 4e-4, 9e-4]) @ turn.T
    covariance[3:, 3:] = turn @ np.diag([1e-6, 1e-6, 4e-6]) @ turn.T
    metres, degrees = sigmas(covariance)
    assert metres == pytest.approx(0.03)
    assert degrees == pytest.approx(np.degrees(0.002))
    assert sigmas(None) == (float("inf"), float("inf"))


DOUBTFUL = replace(EVIDENCE, agreement=0.42, likeness=0.55, aligned=0.3, query_share=0.1)


def test_what_looks_alike_by_depth_stands_for_a_confidence_that_is_too_low() -> None:
    options, judgement = DepthVerdictOptions(), judge(DOUBTFUL, OPTIONS)
    assert judgement.verdict is Verdict.AMBIGUOUS
    assert options.least_confidence < judgement.confidence < OPTIONS.localized_confidence
    assert only_unsure(DOUBTFUL, OPTIONS, options)
    found = weigh_unsure(Alike(0.91, 0.8), DOUBTFUL, judgement, OPTIONS, options)
    assert (found.verdict, found.confidence) == (Verdict.LOCALIZED, OPTIONS.localized_confidence)
    assert "80% of the keyframe looks alike" in found.reason
    for alike in (Alike(0.8, 0.8), Alike(0.91, 0.6), None):
        assert weigh_unsure(alike, DOUBTFUL, judgement, OPTIONS, options) is judgement


@pytest.mark.parametrize(
    "change", [{"rival": 60}, {"sigma_m": 0.07}, {"spread": 0.1}, {"inliers": 19}, {"agreement": 0.05, "likeness": 0.2}]
)
def test_any_other_doubt_stays_one_whatever_looks_alike(change: dict[str, float]) -> None:
    assert not only_unsure(replace(DOUBTFUL, **change), OPTIONS, DepthVerdictOptions())  # type: ignore[arg-type]
