"""Figures about confidence by hand-computed cases, and against scipy's rank test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from semdb.evaluation.calibration import (
    auroc,
    brier_score,
    expected_calibration_error,
    precision_recall,
    reliability_bins,
)
from semdb.evaluation.confidence_plots import answers, confidence_figures, confidence_plot, has_confidence
from semdb.evaluation.metrics import QueryResult, summarise
from semdb.types import Verdict

CONFIDENCE = [0.95, 0.9, 0.9, 0.6, 0.2, 0.0]
CORRECT = [True, True, False, True, False, False]


def test_auroc_by_hand() -> None:
    # nine pairs: 0.95 beats all three wrong, 0.9 ties with 0.9 and beats two, 0.6 loses to 0.9 and beats two
    assert auroc(CONFIDENCE, CORRECT) == pytest.approx((3 + 2.5 + 2) / 9)
    assert auroc([0.5, 0.7], [True, True]) is None
    assert auroc([], []) is None


@given(st.lists(st.tuples(st.integers(0, 10), st.booleans()), min_size=2, max_size=60))
def test_auroc_is_the_rank_test_of_scipy(pairs: list[tuple[int, bool]]) -> None:
    confidence = np.array([value / 10 for value, _ in pairs])
    correct = np.array([right for _, right in pairs])
    if correct.all() or not correct.any():
        assert auroc(confidence, correct) is None
        return
    statistic = mannwhitneyu(confidence[correct], confidence[~correct]).statistic
    assert auroc(confidence, correct) == pytest.approx(statistic / (correct.sum() * (~correct).sum()))


def test_precision_and_recall_by_hand() -> None:
    curve = precision_recall(CONFIDENCE, CORRECT)
    assert curve is not None
    assert curve.threshold.tolist() == [0.95, 0.9, 0.6, 0.2, 0.0]
    assert curve.precision == pytest.approx([1, 2 / 3, 3 / 4, 3 / 5, 3 / 6])
    assert curve.recall == pytest.approx([1 / 3, 2 / 3, 1, 1, 1])
    assert curve.average_precision == pytest.approx(1 / 3 + 2 / 9 + 3 / 12)
    asked = precision_recall(CONFIDENCE, CORRECT, positives=6)
    assert asked is not None
    assert asked.recall[-1] == pytest.approx(0.5)
    assert precision_recall([0.3], [False]) is None


def test_reliability_and_calibration_error_by_hand() -> None:
    bins = reliability_bins([0.05, 0.95, 1.0, 0.92, 0.5], [False, True, True, False, True])
    assert bins.count.tolist() == [1, 0, 0, 0, 0, 1, 0, 0, 0, 3]
    assert bins.confidence[9] == pytest.approx((0.95 + 1.0 + 0.92) / 3)
    assert bins.accuracy[[0, 5, 9]] == pytest.approx([0, 1, 2 / 3])
    assert np.isnan(bins.accuracy[1])
    error = (0.05 * 1 + 0.5 * 1 + (2.87 / 3 - 2 / 3) * 3) / 5
    assert expected_calibration_error([0.05, 0.95, 1.0, 0.92, 0.5], [False, True, True, False, True]) == pytest.approx(
        error
    )
    assert expected_calibration_error([], []) is None
    assert brier_score([1.0, 0.5], [True, False]) == pytest.approx(0.125)
    assert brier_score([], []) is None


def test_honest_confidences_have_a_small_calibration_error() -> None:
    rng = np.random.default_rng(3)
    confidence = rng.uniform(size=20000)
    correct = rng.uniform(size=20000) < confidence
    error = expected_calibration_error(confidence, correct)
    bold = expected_calibration_error(np.sqrt(confidence), correct)
    assert error is not None
    assert error < 0.015
    assert bold == pytest.approx(2 / 3 - 1 / 2, abs=0.02)  # the mean of sqrt(u) is 2/3, that of u 1/2


@pytest.mark.parametrize(
    ("confidence", "correct"), [([0.5], [True, False]), ([1.2], [True]), ([float("nan")], [True]), ([[0.5]], [[True]])]
)
def test_what_is_no_confidence_is_refused(confidence: list[float], correct: list[bool]) -> None:
    with pytest.raises(ValueError, match="confidence"):
        auroc(confidence, correct)


def query(confidence: float | None, metres: float | None, verdict: Verdict) -> QueryResult:
    degrees = None if metres is None else 1.0
    return QueryResult("a", 1, verdict, metres, degrees, 3, 10, confidence, "all", 1.0, 3)


def test_answers_of_a_result_and_their_plot() -> None:
    queries = [
        query(0.9, 0.01, Verdict.LOCALIZED),
        query(0.8, 0.4, Verdict.LOCALIZED),  # wrong
        query(0.4, 0.02, Verdict.AMBIGUOUS),  # right, whatever the verdict
        query(0.0, None, Verdict.FAILED),
        query(None, 0.01, Verdict.LOCALIZED),  # a method without confidence
    ]
    result = summarise(queries, recording="room", protocol="paper", method="semdb", models=(), frames=9, keyframes=3)
    confidence, correct = answers(result)
    assert confidence.tolist() == [0.9, 0.8, 0.4, 0.0]
    assert correct.tolist() == [True, False, True, False]
    assert has_confidence(result) is True
    assert has_confidence(replace(result, per_query=(queries[-1],))) is False
    assert confidence_figures(confidence, correct)["auroc"] == pytest.approx(3 / 4)
    left, right = confidence_plot([("semdb", confidence, correct)]).axes
    assert np.asarray(left.get_lines()[0].get_xydata(), float)[-1] == pytest.approx([1.0, 0.5])
    dots = np.asarray(right.collections[0].get_offsets())
    assert dots.tolist() == [[0.0, 0.0], [0.4, 1.0], [0.8, 0.0], [0.9, 1.0]]
