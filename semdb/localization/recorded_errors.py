"""How far recorded poses are off what images show, and what of it an answer must count with.

The true poses of a recording, and so the frame of its map, have errors of their own: a depth tracker drifts, motion
capture has another clock. How much, its keyframes show: each is localized among its neighbours as a query would be, and
its recorded pose is known (leave-one-out cross-validation). What its images leave open is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.types import FloatArray, PoseErrors

PLACE, TURN = slice(0, 3), slice(3, 6)
LEAST_M, LEAST_RAD = 1e-5, 1e-5  # below, it is nothing
ROUNDS = 60  # of the fit
USUAL = PoseErrors(0.006, 0.006, 3.0, 6.0)  # of a recording of which nothing is known, as good as so many numbers


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """What errors of recorded poses make of an answer; docs/localization.md says what was fitted on what.

    A place is off in proportion to a power of the distance (`pose_distances`) of the nearest keyframe, not less than at
    `place_near`, and to a power of how much one keyframe is `alone`: what several have wrong cancels in part. A turn
    is off likewise, but for that. Besides it is off by the share `clock` of the difference between the turns of query
    and keyframes during the readout, since the clock of the poses is not that of the images.
    """

    place_power: float = 1.1
    place_near: float = 0.2
    alone_power: float = 0.5
    turn_power: float = 1.25
    turn_near: float = 0.3
    clock: float = 0.33
    clock_from_rad: float = 0.002  # of a recording's errors: with less its clock is the images'
    tail: float = 5.0  # degrees of freedom of Student's t that errors of keyframes are taken to have: some are far off
    alike: float = 0.5  # of the numbers of keyframes count: neighbours err alike
    usual: PoseErrors = USUAL
    own: float = 0.25  # of what a query itself shows counts
    exact: float = 0.2  # of what is usual counts where keyframes show that poses are not off at all: rendered ones


MODEL = ErrorModel()


@dataclass(frozen=True, slots=True, eq=False)
class AtQuery:
    """Where errors of recorded poses meet a query: distances of the nearest keyframe (`pose_distances`), for its place
    and its turn, by how much more than its keyframes it turned during the readout, ``[3]`` rad in the world, and the
    sum of squares of the keyframes' shares of the pairs (1: all are of one).
    """

    nearest: tuple[float, float]
    turn: FloatArray
    alone: float


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """A keyframe localized among others: its `error` ``[6]`` (m, rad; world) against its recorded pose, and the
    `covariance` ``[6, 6]`` of what images leave open.
    """

    error: FloatArray
    covariance: FloatArray
    at: AtQuery


def measured(found: Sequence[LeftOut], model: ErrorModel = MODEL) -> PoseErrors:
    """How far the poses of a recording are off at a distance of 1, by its keyframes; nothing known of none."""
    metres, radians = (_spread(found, part, model) for part in (PLACE, TURN))
    numbers = 3.0 * len(found) * model.alike
    return PoseErrors(metres, radians, numbers, numbers, len(found))


def _spread(found: Sequence[LeftOut], part: slice, model: ErrorModel) -> float:
    """Standard deviation along an axis at a distance of 1: maximum likelihood, errors being Student's t.

    Fixed-point iteration on the equation of the likelihood (each error weighs less the farther off it is).
    """
    if not found:
        return 0.0
    errors = np.array([one.error[part] for one in found])
    fixed = np.array([one.covariance[part, part] + _of_clock(one.at, part, model) for one in found])
    grows = np.array([_growth(one.at, part, model) ** 2 for one in found])
    variance = float((errors**2).mean())
    for _ in range(ROUNDS):
        inverse = np.linalg.inv(fixed + variance * grows[:, None, None] * np.eye(3))
        scaled = np.einsum("nij,nj->ni", inverse, errors)
        weight = (model.tail + 3) / (model.tail + (scaled * errors).sum(axis=1))
        seen, expected = (weight * grows * (scaled**2).sum(axis=1)).sum(), (grows * np.trace(inverse, 0, 1, 2)).sum()
        variance = max(variance * float(seen / expected), 1e-14)
    return float(np.sqrt(variance * model.tail / (model.tail - 2)))


def _growth(at: AtQuery, part: slice, model: ErrorModel) -> float:
    """How many times as far as at a distance of 1 it is off."""
    if part == TURN:
        return float(np.hypot(at.nearest[1], model.turn_near) ** model.turn_power)
    return float(np.hypot(at.nearest[0], model.place_near) ** model.place_power * at.alone**model.alone_power)


def _of_clock(at: AtQuery, part: slice, model: ErrorModel) -> FloatArray:
    """Covariance ``[3, 3]`` of what another clock makes of a turning camera."""
    off = model.clock * at.turn if part == TURN else np.zeros(3)
    return np.outer(off, off)


def shrunk(own: PoseErrors | None, known: Sequence[PoseErrors], model: ErrorModel = MODEL) -> PoseErrors:
    """The weighted mean of logarithms of what a query itself shows, of what is known, and of what is usual.

    Of logarithms, since errors of recordings differ by factors.
    """
    less = [] if own is None else [_scaled(own, model.own)]
    of = (_usual(known, model), *less, *known)
    place, turn = np.array([one.position_freedom for one in of]), np.array([one.rotation_freedom for one in of])
    metres = np.log([max(one.position_m, LEAST_M) for one in of])
    radians = np.log([max(one.rotation_rad, LEAST_RAD) for one in of])
    return PoseErrors(
        float(np.exp((place * metres).sum() / place.sum())),
        float(np.exp((turn * radians).sum() / turn.sum())),
        float(place.sum()),
        float(turn.sum()),
    )


def _usual(known: Sequence[PoseErrors], model: ErrorModel) -> PoseErrors:
    """What is usual; it counts the less, the more of what is known says that poses are not off at all."""
    place = _share([(one.position_freedom, one.position_m <= LEAST_M) for one in known])
    turn = _share([(one.rotation_freedom, one.rotation_rad <= LEAST_RAD) for one in known])
    less, usual = 1.0 - model.exact, model.usual
    return replace(
        usual,
        position_freedom=usual.position_freedom * (1.0 - less * place),
        rotation_freedom=usual.rotation_freedom * (1.0 - less * turn),
    )


def _share(freedoms: Sequence[tuple[float, bool]]) -> float:
    """The share of those that are marked; 0 of none."""
    return sum(freedom for freedom, marked in freedoms if marked) / max(sum(freedom for freedom, _ in freedoms), 1e-9)


def weighted(known: Sequence[PoseErrors | None], weights: Sequence[float]) -> list[PoseErrors]:
    """Those that are known with their freedoms in the share that their keyframes have of the `weights`."""
    total = max(float(sum(weights)), 1e-9)
    shares: dict[PoseErrors, float] = {}
    for one, weight in zip(known, weights, strict=True):
        if one is not None:
            shares[one] = shares.get(one, 0.0) + weight / total
    return [_scaled(one, share) for one, share in shares.items()]


def _scaled(one: PoseErrors, share: float) -> PoseErrors:
    return PoseErrors(one.position_m, one.rotation_rad, one.position_freedom * share, one.rotation_freedom * share)


def recorded_errors(errors: PoseErrors, at: AtQuery, model: ErrorModel = MODEL) -> FloatArray:
    """Covariance ``[6, 6]`` of how far a pose recorded where the query is would be off what the images show."""
    found = np.zeros((6, 6))
    believed = min(errors.rotation_rad / model.clock_from_rad, 1.0) ** 4
    for part, of in ((PLACE, errors.position_m), (TURN, errors.rotation_rad)):
        found[part, part] = (of * _growth(at, part, model)) ** 2 * np.eye(3) + believed * _of_clock(at, part, model)
    return found


def at_query(
    nearest: tuple[float, float], turns: FloatArray, pairs: Sequence[int], world_from_camera: FloatArray
) -> AtQuery:
    """Of a pose ``[4, 4]``: `turns` ``[c, 3]`` (rad) are those of the images in their own frames, the query first;
    `pairs` with each of the ``c - 1`` keyframes.
    """
    shares = np.maximum(pairs, 1e-3) / np.maximum(pairs, 1e-3).sum()
    more: FloatArray = world_from_camera[:3, :3] @ (turns[0] - shares @ turns[1:])
    return AtQuery(nearest, more, float(shares @ shares))
