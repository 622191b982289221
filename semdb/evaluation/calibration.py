"""Can a confidence be trusted? Ranking (precision, recall, AUROC) and calibration, on plain arrays.

`confidence` ``[n]`` is 0..1, `correct` ``[n]`` says which answers were right. An answer that gives no pose at all has
confidence 0 and is not right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semdb.types import BoolArray, FloatArray

BINS = 10


@dataclass(frozen=True, slots=True, eq=False)
class PrecisionRecall:
    """One point per distinct confidence, the highest first: what holds of all answers at least that confident.

    `precision` is the share of them that are right, `recall` their share of all queries that could be right.
    """

    threshold: FloatArray  # [k]
    precision: FloatArray  # [k]
    recall: FloatArray  # [k]
    average_precision: float  # area under the steps: sum of precision times gain in recall


@dataclass(frozen=True, slots=True, eq=False)
class ReliabilityBins:
    """Answers in bins of equal width over 0..1; means are NaN where a bin is empty."""

    lower: FloatArray  # [bins]
    upper: FloatArray  # [bins]
    count: npt.NDArray[np.int64]  # [bins]
    confidence: FloatArray  # [bins] mean
    accuracy: FloatArray  # [bins] share that is right


def check(confidence: npt.ArrayLike, correct: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
    """The two as arrays ``[n]``. Raises ValueError for other shapes, or a confidence that is not 0..1."""
    values = np.asarray(confidence, dtype=np.float64)
    right = np.asarray(correct, dtype=np.bool_)
    if values.ndim != 1 or values.shape != right.shape:
        raise ValueError(f"confidence {values.shape} and correct {right.shape} must be two lists of one length")
    if not ((values >= 0) & (values <= 1)).all():  # also NaN
        raise ValueError("a confidence must be a number from 0 to 1")
    return values, right


def auroc(confidence: npt.ArrayLike, correct: npt.ArrayLike) -> float | None:
    """The chance that a right answer is more confident than a wrong one, ties counting half; None without both.

    Equal to the area under the ROC curve (Hanley and McNeil, Radiology 143, 1982): Mann-Whitney's U by mean ranks.
    """
    values, right = check(confidence, correct)
    positives, negatives = int(right.sum()), int((~right).sum())
    if positives == 0 or negatives == 0:
        return None
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    ranks = (last - (counts - 1) / 2.0)[inverse]
    return float((ranks[right].sum() - positives * (positives + 1) / 2.0) / (positives * negatives))


def precision_recall(
    confidence: npt.ArrayLike, correct: npt.ArrayLike, positives: int | None = None
) -> PrecisionRecall | None:
    """The curve over falling confidence; None where nothing can be right.

    `positives` is how many queries could be answered rightly, where that is more than were: recall is of these.
    """
    values, right = check(confidence, correct)
    possible = int(right.sum()) if positives is None else positives
    if possible == 0 or len(values) == 0:
        return None
    order = np.argsort(-values, kind="stable")
    sorted_values = values[order]
    ends = np.append(np.flatnonzero(np.diff(sorted_values)), len(values) - 1)
    hits = np.cumsum(right[order])[ends]
    precision = hits / (ends + 1)
    recall = hits / possible
    gain = np.diff(np.concatenate([[0.0], recall]))
    return PrecisionRecall(sorted_values[ends], precision, recall, float((precision * gain).sum()))


def reliability_bins(confidence: npt.ArrayLike, correct: npt.ArrayLike, bins: int = BINS) -> ReliabilityBins:
    """How often answers of about one confidence are right. The last bin includes 1."""
    values, right = check(confidence, correct)
    edges = np.linspace(0.0, 1.0, bins + 1)
    which = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, bins - 1)
    count = np.bincount(which, minlength=bins)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(which, weights=values, minlength=bins) / count
        accuracy = np.bincount(which, weights=right.astype(np.float64), minlength=bins) / count
    return ReliabilityBins(edges[:-1], edges[1:], count.astype(np.int64), mean, accuracy)


def expected_calibration_error(confidence: npt.ArrayLike, correct: npt.ArrayLike, bins: int = BINS) -> float | None:
    """Mean distance of confidence and accuracy over the bins, weighted by their counts; None without answers.

    Naeini, Cooper and Hauskrecht, AAAI 2015; bins of equal width.
    """
    found = reliability_bins(confidence, correct, bins)
    total = int(found.count.sum())
    if total == 0:
        return None
    filled = found.count > 0
    gaps = np.abs(found.confidence[filled] - found.accuracy[filled])
    return float((gaps * found.count[filled]).sum() / total)


def brier_score(confidence: npt.ArrayLike, correct: npt.ArrayLike) -> float | None:
    """Mean squared distance of confidence from 1 where right, from 0 where wrong (Brier, 1950); None without any."""
    values, right = check(confidence, correct)
    return float(((values - right) ** 2).mean()) if len(values) else None
