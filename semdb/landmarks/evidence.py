"""What class a thing is: every sighting is evidence, as strong as the detector is sure and is known to be right."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from semdb.types import BoolArray, FloatArray, Int64Array

FLOOR = 0.02  # of the probability of any name, whatever the thing is
LEAST_LIKELY = 0.002  # of a class that a thing may be
SURE = 0.9  # share of right names of a class whose confusions nobody knows


def name_probabilities(classes: int, confusion: FloatArray | None = None) -> FloatArray:
    """``[true class, name]``: how likely the detector gives a thing of a class a name. Rows sum to one.

    `confusion` ``[classes, classes]`` is the share of what is found at the place of a class that goes by another name
    (`semdb refine`, step classes). Where nearly all of what goes by a rare name is of another class, that share is
    large in one direction alone: the smaller of the two directions is what the detector does.
    """
    mixed = np.zeros((classes, classes)) if confusion is None else np.minimum(confusion, confusion.T)
    np.fill_diagonal(mixed, 0.0)
    right = np.where(mixed.sum(axis=1) > 0, np.maximum(1 - mixed.sum(axis=1), 0.5), SURE)
    others = mixed.copy()
    total = others.sum(axis=1, keepdims=True)
    others = np.where(total > 0, others / np.where(total > 0, total, 1) * (1 - right[:, None]), 0.0)
    found = others + np.diag(right)
    found = (1 - FLOOR) * found / found.sum(axis=1, keepdims=True) + FLOOR / max(classes, 1)
    return np.asarray(found / found.sum(axis=1, keepdims=True), np.float64)


def fuse(category: Int64Array, score: FloatArray, names: FloatArray, barred: BoolArray | None = None) -> FloatArray:
    """Probabilities ``[classes]`` of what a thing is, of the names ``[k]`` and scores ``[k]`` that it was seen under.

    A name of score s says with weight s that it was given by `name_probabilities`, and nothing with weight 1 - s.
    Classes that are `barred` ``[classes]`` it cannot be, unless it has no other name. Numbers are rounded, so that the
    same evidence in another order is the same to the last bit.
    """
    classes = names.shape[1]
    certain = np.clip(score, 0.05, 0.99)[:, None]
    likelihood = np.log(certain * names[:, category].T + (1 - certain) / max(classes, 1))
    total = np.rint(likelihood * 1e9).astype(np.int64).sum(axis=0) / 1e9
    if barred is not None and not barred[category].all():
        total = np.where(barred, -np.inf, total)
    found = np.exp(total - total.max())
    return np.asarray(found / found.sum(), np.float64)


def support(keyframe: Int64Array, category: Int64Array, score: FloatArray) -> dict[int, float]:
    """How much is said for each name that a thing was seen under: the sum over keyframes of the highest score in each.

    `keyframe`, `category` and `score` ``[k]``: of each sighting. Three keyframes at a score of one half say as much as
    six at a quarter: what a detector sees weakly in one place again and again is there.
    """
    highest: dict[tuple[int, int], int] = {}
    for number, name, value in zip(keyframe.tolist(), category.tolist(), score.tolist(), strict=True):
        highest[name, number] = max(highest.get((name, number), 0), round(value * 1e6))
    found: dict[int, int] = {}
    for (name, _), value in highest.items():
        found[name] = found.get(name, 0) + value
    return {name: value / 1e6 for name, value in found.items()}


def perhaps(evidence: FloatArray, category: int, named: Iterable[int]) -> dict[int, float]:
    """Other classes that a thing may be, of those that it was `named`, with their probabilities: by number."""
    others = sorted(set(named) - {category})
    return {k: round(float(evidence[k]), 6) for k in others if evidence[k] >= LEAST_LIKELY}
