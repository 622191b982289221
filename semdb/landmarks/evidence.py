"""What class a thing is: every sighting is evidence, as strong as the detector is sure and is known to be right.

What all things of a map were called says more than the names of one: how often names stand for one thing, and how many
things of each class there are (`settled`, by expectation and maximization as Dawid and Skene do with the votes of
observers, 1979; but what a thing of a class is called stays as it was measured).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from semdb.types import BoolArray, FloatArray, Int64Array

FLOOR = 0.02  # of the probability of any name, whatever the thing is
LEAST_LIKELY = 0.002  # of a class that a thing may be
SURE = 0.9  # share of right names of a class whose confusions nobody knows
SEVERAL = 8.0  # names that are added to those of a class, so that a few do not make a large share
FEW = 2.0  # things that are added to those of each class
ROUNDS = 10
WHOLE = 1e9  # scores and probabilities are summed as whole multiples of its inverse: in any order
Named = tuple[Int64Array, FloatArray]  # names [k] and scores [k] that a thing was seen under


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


def fuse(category: Int64Array, score: FloatArray, names: FloatArray) -> FloatArray:
    """Probabilities ``[classes]`` of what a thing is, of the names ``[k]`` and scores ``[k]`` it was seen under."""
    total = of_names(category, score, names)
    found = np.exp(total - total.max())
    return np.asarray(found / found.sum(), np.float64)


def of_names(category: Int64Array, score: FloatArray, names: FloatArray) -> FloatArray:
    """Logarithms ``[classes]`` of how likely a thing of each class is seen under names ``[k]`` and scores ``[k]``.

    A name of score s says with weight s that it was given by `name_probabilities`, and nothing with weight 1 - s.
    Numbers are rounded, so that the same evidence in another order is the same to the last bit.
    """
    certain = np.clip(score, 0.05, 0.99)[:, None]
    likelihood = np.log(certain * names[:, category].T + (1 - certain) / max(names.shape[1], 1))
    return np.asarray(np.rint(likelihood * WHOLE).astype(np.int64).sum(axis=0) / WHOLE, np.float64)


def named_as_one(things: Sequence[Named], classes: int) -> FloatArray:
    """Shares ``[classes, classes]``, the same both ways, of the names of a class that stand beside those of another.

    A thing that was called one twice and another three times is two names that are mistakes, whichever it is. Each
    name counts as much as its score.
    """
    number, both = np.zeros(classes, np.int64), np.zeros((classes, classes), np.int64)
    for category, score in things:
        name, place = np.unique(category, return_inverse=True)
        times = np.zeros(len(name), np.int64)
        np.add.at(times, place, np.rint(score * WHOLE).astype(np.int64))
        number[name] += times
        if len(name) > 1:
            both[np.ix_(name, name)] += np.minimum(times[:, None], times[None, :])
    np.fill_diagonal(both, 0)
    return np.asarray(both / (np.maximum(number[:, None], number[None, :]) + SEVERAL * WHOLE), np.float64)


def settled(
    things: Sequence[Named],
    fits: FloatArray,
    confusion: FloatArray | None = None,
    barred: BoolArray | None = None,
) -> FloatArray:
    """Probabilities ``[things, classes]`` of what the things of a map are, of all that they were called.

    `fits` ``[things, classes]``: logarithms of how well each fits a class otherwise (`sizes`); NaN, where nobody knows,
    counts as the least of the others. That, and how many things of a class there are, weighs between the names of a
    thing and what these are taken for; no other class gains by it. `barred` ``[things, classes]``: what each cannot be,
    unless it has no other name.
    """
    classes = fits.shape[1]
    if not things:
        return np.zeros((0, classes))
    shares = named_as_one(things, classes)
    if confusion is not None:
        shares = np.maximum(shares, np.minimum(confusion, confusion.T))
    names = name_probabilities(classes, shares)
    known = (np.maximum(names, names.T) > 2 * float(names.min())) | np.eye(classes, dtype=np.bool_)
    called = np.array([of_names(category, score, names) for category, score in things]).reshape(fits.shape)
    may = np.array([known[category].any(axis=0) for category, _ in things]).reshape(fits.shape)
    if barred is not None:
        barred = (
            barred
            & ~np.array([row[category].all() for row, (category, _) in zip(barred, things, strict=True)])[:, None]
        )
        may &= ~barred
    least = np.where(may & ~np.isnan(fits), fits, np.inf).min(axis=1, keepdims=True)
    fits = np.where(np.isnan(fits), np.where(np.isinf(least), 0.0, least), fits)
    count = np.zeros(classes)
    for _ in range(ROUNDS):
        weight = fits + np.log(count + FEW)
        weight = np.where(may, weight, np.where(may, weight, np.inf).min(axis=1, keepdims=True))
        total = called + weight if barred is None else np.where(barred, -np.inf, called + weight)
        found = np.exp(total - total.max(axis=1, keepdims=True))
        found /= found.sum(axis=1, keepdims=True)
        count = np.rint(found * WHOLE).astype(np.int64).sum(axis=0) / WHOLE
    return np.asarray(found, np.float64)


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
