"""Fits the weights of the confidence to the answers of `bench.trust` (its option `--fit`).

A logistic regression (maximum likelihood with a small penalty) whose weights may not be negative, so that more
support never lowers the confidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from bench.trust.rows import Row, evidence_of
from bench.trust.suites import FIT, POSITIVE, TEST
from semdb.evaluation.calibration import auroc, expected_calibration_error
from semdb.localization.confidence import FEATURES, confidence_features
from semdb.localization.verdict import VerdictOptions, judge
from semdb.types import BoolArray, FloatArray, Verdict

MOST_FALSE = 0.003  # of the negative and hard queries
PENALTY = 0.02  # of a squared weight per feature of unit variance, over the mean log loss


def design(rows: Sequence[Row]) -> tuple[FloatArray, BoolArray]:
    """Features ``[n, k]`` and which answers are right, of the rows with a plausible pose.

    A confidence is asked of no other, and the many hopeless ones would have the greatest say.
    """
    known = [(evidence_of(row), row.is_right) for row in rows if row.verdict != Verdict.FAILED]
    pairs = [(confidence_features(evidence), right) for evidence, right in known if evidence is not None]
    return np.array([features for features, _ in pairs]), np.array([right for _, right in pairs], np.bool_)


def fit(features: FloatArray, right: BoolArray, penalty: float = PENALTY) -> tuple[FloatArray, float]:
    """Weights ``[k]``, none negative, and the intercept."""
    scale = features.std(axis=0) + 1e-9
    x, y = (features - features.mean(axis=0)) / scale, right.astype(float)

    def loss(parameters: FloatArray) -> tuple[float, FloatArray]:
        weights, intercept = parameters[:-1], parameters[-1]
        score = x @ weights + intercept
        value = np.mean(np.logaddexp(0, score) - y * score) + penalty * float(weights @ weights) / len(weights)
        residual = (1 / (1 + np.exp(-score)) - y) / len(y)
        return float(value), np.append(x.T @ residual + 2 * penalty * weights / len(weights), residual.sum())

    bounds = [(0.0, None)] * x.shape[1] + [(None, None)]
    found = minimize(loss, np.zeros(x.shape[1] + 1), jac=True, bounds=bounds, method="L-BFGS-B").x
    weights = found[:-1] / scale
    return weights, float(found[-1] - weights @ features.mean(axis=0))


def measure(features: FloatArray, right: BoolArray, weights: FloatArray, intercept: float) -> str:
    confidence = 1 / (1 + np.exp(-np.clip(features @ weights + intercept, -30, 30)))
    error, area = expected_calibration_error(confidence, right), auroc(confidence, right)
    separated = "none are wrong" if area is None else f"AUROC {area:.4f}"
    return f"{len(right)} poses, {right.mean():.0%} right: calibration error {error:.3f}, {separated}"


def _least_bound(rows: Sequence[Row], weights: FloatArray, intercept: float) -> float:
    """The least bound, in steps of 0.05, with which at most `MOST_FALSE` of the hard and negative rows are false.

    The other bounds of the verdict hold as they are.
    """
    doubtless = replace(VerdictOptions(), localized_confidence=0.0)
    rest = [row for row in rows if judge(evidence_of(row), doubtless).verdict is Verdict.LOCALIZED]
    evidence = [found for row in rest if (found := evidence_of(row)) is not None]
    score = np.array([confidence_features(found) @ weights + intercept for found in evidence])
    wrong = np.array([not row.is_right for row in rest], np.bool_)
    asked = sum(row.kind != POSITIVE for row in rows)
    bounds = np.arange(0.5, 1.0, 0.05)
    for bound in bounds:
        if np.count_nonzero(wrong & (score >= np.log(bound / (1 - bound)))) <= MOST_FALSE * asked:
            return float(bound)
    return float(bounds[-1])


def fitted(rows: Sequence[Row], half: str) -> str:
    """The constants `WEIGHTS` and `INTERCEPT` of semdb/localization/confidence.py, fitted on one half of the scenes.

    And the calibration that they give on both halves, and the bound on the confidence that this half gives.
    """
    chosen = [row for row in rows if row.half == half]
    weights, intercept = fit(*design(chosen))
    lines = [f"{name:15} {weight:8.3f}" for name, weight in zip(FEATURES, weights, strict=True)]
    lines.append(f"WEIGHTS = ({', '.join(f'{w:.3f}' for w in weights)})\nINTERCEPT = {intercept:.3f}")
    lines.append(f"localized_confidence = {_least_bound(chosen, weights, intercept):.2f}")
    for part in (FIT, TEST):
        for world in ("", *dict.fromkeys(row.world for row in rows)):
            chosen = [row for row in rows if row.half == part and world in ("", row.world)]
            if chosen:
                lines.append(f"{part} {world or 'all'}: {measure(*design(chosen), weights, intercept)}")
    return "\n".join(lines)
