"""`--accept`: how far poses may differ that are one for the caller."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.geometry import pose_from
from semdb.localization.acceptance import as_tolerance, parse_tolerance
from semdb.localization.laid_pose import LaidOptions, LaidPose, is_one, judge_with
from semdb.localization.pairs import join_pairs
from semdb.localization.pose import PoseEstimate
from semdb.localization.verdict import Judgement, VerdictOptions
from semdb.types import FloatArray, Tolerance, Verdict


@pytest.mark.parametrize("text", ["0.1m,5deg", " 0.1 m , 5 deg ", "1e-1m,5.0deg"])
def test_text_is_read(text: str) -> None:
    assert parse_tolerance(text) == Tolerance(0.1, 5.0)


@pytest.mark.parametrize("text", ["", "0.1", "0.1m", "5deg,0.1m", "0.1m,5", "-m,-deg", "0.1cm,5deg", "nanm,5deg"])
def test_other_text_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match=r"as 0\.1m,5deg"):
        parse_tolerance(text)


@pytest.mark.parametrize("given", [(0.0, 5.0), (-1.0, 5.0), (0.1, 0.0), (0.1, 181.0), (float("inf"), 5.0)])
def test_what_is_no_tolerance_is_refused(given: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="above 0"):
        as_tolerance(given)


def test_not_two_numbers_are_refused() -> None:
    for given in ((0.1,), (0.1, 5.0, 2.0), ("a", "b")):
        with pytest.raises(UsageError):
            as_tolerance(given)  # type: ignore[arg-type]


def at(x: float) -> FloatArray:
    return pose_from(np.eye(3), np.array([x, 0.0, 0.0]))


def test_two_standard_deviations_are_within_what_is_accepted() -> None:
    bounds = VerdictOptions().accepting(Tolerance(0.2, 8.0))
    assert (bounds.maximum_translation_sigma_m, bounds.maximum_rotation_sigma_deg) == (0.1, 4.0)
    assert VerdictOptions().accepting(None) == VerdictOptions()


def test_poses_within_what_is_accepted_do_not_contradict() -> None:
    options = LaidOptions()
    laid = LaidPose(at(0.0), np.eye(6) * 1e-4, 12, (), ("few",), True, "90 %", "better elsewhere", {})
    keypoints = PoseEstimate(at(0.08), None, join_pairs([]), 60, (60,), 30, 30, 0.6, 1.0, 0.5)
    found = Judgement(Verdict.LOCALIZED, 0.9, "")
    assert judge_with(found, keypoints, laid, options, False).verdict is Verdict.AMBIGUOUS
    assert judge_with(found, keypoints, laid, options, False, Tolerance(0.1, 5.0)).verdict is Verdict.LOCALIZED
    assert judge_with(found, keypoints, laid, options, False, Tolerance(0.01, 1.0)).verdict is Verdict.AMBIGUOUS
    assert is_one(at(0.0), at(0.04), options.tolerance(Tolerance(0.01, 1.0)))  # what is one without a caller stays one
