"""Evidence on a pose, and the confidence that is made of it."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from semdb.localization.confidence import (
    FEATURES,
    WEIGHTS,
    Evidence,
    confidence_features,
    confidence_of,
    gather_evidence,
)
from semdb.localization.pose import PoseEstimate, estimate_pose, match_view
from semdb.localization.pose_options import PoseOptions
from semdb.localization.views import ClassNumbers, KeyframeView, View
from tests.unit.localization_scene import Scene
from tests.unit.test_verdict import EVIDENCE


def localized(scene: Scene) -> tuple[View, list[KeyframeView], PoseEstimate]:
    """A query, two keyframes that see the same things, and its pose."""
    numbers = ClassNumbers()
    query = scene.query(scene.pose(0.2, 5.0), numbers)
    keyframes = [scene.keyframe(n, scene.pose(0.1, 3.0), numbers) for n in (1, 2)]
    options = PoseOptions()
    matches = [match_view(query, keyframe, options.matching) for keyframe in keyframes]
    estimate = estimate_pose(query, keyframes, matches, options)
    assert estimate is not None
    return query, keyframes, estimate


def test_evidence_of_a_right_pose() -> None:
    query, keyframes, estimate = localized(Scene())
    found = gather_evidence(query, keyframes, estimate, 3, [0.9, 0.8])
    assert (found.inliers, found.rival, found.supporters) == (estimate.inliers, 3, 2)
    assert found.explained > 0.9  # the keyframes show nothing that is not there
    assert found.query_share > 0.8
    assert found.confirmed > 0.9
    assert found.coverage == pytest.approx(1.0)
    assert found.classes > 0.9
    assert found.cosine == pytest.approx(0.9)
    assert np.isnan(found.cosine_gap)  # no keyframe was matched in vain
    assert confidence_of(found) > 0.9


def test_a_keyframe_that_does_not_support_the_pose_is_the_gap() -> None:
    query, keyframes, estimate = localized(Scene())
    other = Scene(seed=5).keyframe(3, np.eye(4), ClassNumbers())  # matched later, to look for a twin
    found = gather_evidence(query, [*keyframes, other], estimate, 0, [0.9, 0.8, 0.95])
    assert found.cosine_gap == pytest.approx(-0.05)


def test_a_pose_beside_the_right_one_explains_less() -> None:
    query, keyframes, estimate = localized(Scene())
    right = gather_evidence(query, keyframes, estimate, 0, [0.9, 0.8])
    moved = estimate.world_from_camera.copy()
    moved[:3, 3] += [0.4, 0.2, 0.0]
    few = estimate.pairs.take(np.arange(20))
    wrong = replace(estimate, world_from_camera=moved, pairs=few, inliers=20, per_keyframe=(20, 0))
    found = gather_evidence(query, keyframes, wrong, 0, [0.9, 0.8])
    assert found.explained < 0.2 * right.explained
    assert found.classes < right.classes
    assert found.supporters == 1


@pytest.mark.parametrize(
    "name", ["inliers", "first_inliers", "agreement", "spread", "explained", "likeness", "classes"]
)
def test_more_support_never_lowers_the_confidence(name: str) -> None:
    value = getattr(EVIDENCE, name)
    steps = [confidence_of(replace(EVIDENCE, **{name: value * share})) for share in (0.1, 0.4, 0.7, 1.0)]
    assert steps == sorted(steps)


def test_a_rival_lowers_the_confidence() -> None:
    steps = [confidence_of(replace(EVIDENCE, rival=count)) for count in (0, 20, 60)]
    assert steps == sorted(steps, reverse=True)
    assert steps[2] < steps[0]


def test_confidence_is_a_probability_whatever_the_evidence() -> None:
    zeros = Evidence(**{field.name: 0 for field in fields(Evidence)})  # type: ignore[arg-type]
    nothing = replace(zeros, sigma_m=float("inf"), sigma_deg=float("inf"))
    endless = replace(EVIDENCE, sigma_m=float("inf"), sigma_deg=float("inf"), cosine=float("nan"))
    for evidence in (zeros, nothing, endless, EVIDENCE):
        assert np.isfinite(confidence_features(evidence)).all()
        assert 0 <= confidence_of(evidence) <= 1
    assert confidence_of(nothing) < 0.1
    assert len(FEATURES) == len(WEIGHTS) == len(confidence_features(EVIDENCE))
    assert min(WEIGHTS) >= 0
