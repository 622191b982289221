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
USUAL = PoseErrors(0.008, 0.007, 2.0, 2.0)  # of a recording of which nothing is known, as good as so many numbers


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """What errors of recorded poses make of an answer; docs/verdict.md says what was fitted on what.

    A place is off in proportion to the distance (`pose_distances`) of the nearest keyframe, not less than at
    `place_near`, hardly more than at `place_far`, and to a power of how much one keyframe is `alone`: what several
    have wrong cancels in part. Trackers hold a camera best along its view: `axes` are shares of the variance of a place
    (right, down, forward). A turn is off likewise, to a power of the distance. Besides it is off by the share `clock`
    of the difference between the turns of query and keyframes during the readout, since the clock of the poses is not
    that of the images.

    Where poses are off, so is more of a camera than images show by themselves: their covariance counts `place_images`
    and `turn_images` times. Keyframes left out stand in holes that they make themselves: what lies between keyframes is
    off by the share `between` of that.
    """

    place_near: float = 0.1
    place_far: float = 3.0
    alone_power: float = 0.3
    axes: tuple[float, float, float] = (1.3, 1.0, 0.7)
    turn_power: float = 0.8
    turn_near: float = 0.1
    clock: float = 0.33
    off_from_m: float = 0.001  # of a recording's errors: with less its images are believed as they are
    off_from_rad: float = 0.002  # likewise, and its clock is the images'
    place_images: float = 1.2
    turn_images: float = 2.0
    between: float = 0.74
    tail: float = 5.0  # degrees of freedom of Student's t that errors of keyframes are taken to have: some are far off
    usual: PoseErrors = USUAL
    own: float = 0.1  # of what a query itself shows counts
    exact: float = 0.2  # of what is usual counts where keyframes show that poses are not off at all: rendered ones


MODEL = ErrorModel()


@dataclass(frozen=True, slots=True, eq=False)
class AtQuery:
    """Where errors of recorded poses meet a query: distances of the nearest keyframe (`pose_distances`), for its place
    and its turn, by how much more than its keyframes it turned during the readout, ``[3]`` rad in the world, the
    sum of squares of the keyframes' shares of the pairs (1: all are of one), and its `axes` ``[3, 3]`` in the world.
    """

    nearest: tuple[float, float]
    turn: FloatArray
    alone: float
    axes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """A keyframe localized among others: its `error` ``[6]`` (m, rad; world) against its recorded pose, and the
    `covariance` ``[6, 6]`` of what images leave open.
    """

    error: FloatArray
    covariance: FloatArray
    at: AtQuery


def measured(found: Sequence[LeftOut], keyframes: int | None = None, model: ErrorModel = MODEL) -> PoseErrors:
    """How far the poses of a recording are off at a distance of 1; nothing known of none.

    `found` may have each of its `keyframes` more than once, among others that are farther and farther.
    """
    count = len(found) if keyframes is None else keyframes
    metres, radians = (_spread(found, part, model) for part in (PLACE, TURN))
    return PoseErrors(metres, radians, 3.0 * count, 3.0 * count, count)


def _spread(found: Sequence[LeftOut], part: slice, model: ErrorModel) -> float:
    """Standard deviation along an axis at a distance of 1: maximum likelihood, errors being Student's t.

    Fixed-point iteration on the equation of the likelihood (each error weighs less the farther off it is).
    """
    if not found:
        return 0.0
    errors = np.array([one.error[part] for one in found])
    times = model.turn_images if part == TURN else model.place_images
    narrower = (model.tail - 2) / model.tail  # than its covariance is the scale of Student's t
    fixed = narrower * np.array([times * one.covariance[part, part] + _of_clock(one.at, part, model) for one in found])
    grows = np.array([_growth(one.at, part, model) ** 2 for one in found])
    variance = float((errors**2).mean())
    for _ in range(ROUNDS):
        inverse = np.linalg.inv(fixed + variance * grows[:, None, None] * np.eye(3))
        scaled = np.einsum("nij,nj->ni", inverse, errors)
        weight = (model.tail + 3) / (model.tail + (scaled * errors).sum(axis=1))
        seen, expected = (weight * grows * (scaled**2).sum(axis=1)).sum(), (grows * np.trace(inverse, 0, 1, 2)).sum()
        variance = max(variance * float(seen / expected), 1e-14)
    return float(np.sqrt(variance / narrower))


def _growth(at: AtQuery, part: slice, model: ErrorModel) -> float:
    """How many times as far as at a distance of 1 it is off."""
    if part == TURN:
        return float(np.hypot(at.nearest[1], model.turn_near) ** model.turn_power)
    distance = np.hypot(at.nearest[0], model.place_near)
    return float(distance / np.hypot(1.0, distance / model.place_far) * at.alone**model.alone_power)


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


def recorded_errors(errors: PoseErrors, at: AtQuery, images: FloatArray, model: ErrorModel = MODEL) -> FloatArray:
    """Covariance ``[6, 6]`` of how far a pose recorded where the query is would be off what the images show.

    `images` ``[6, 6]`` is what these leave open; with it the sum is that of the answer.
    """
    placed = min(errors.position_m / model.off_from_m, 1.0) ** 4
    turned = min(errors.rotation_rad / model.off_from_rad, 1.0) ** 4
    more = np.repeat([1.0 + placed * (model.place_images - 1.0), 1.0 + turned * (model.turn_images - 1.0)], 3) ** 0.5
    found: FloatArray = images * (np.outer(more, more) - 1.0)
    place = (model.between * errors.position_m * _growth(at, PLACE, model)) ** 2
    turn = (model.between * errors.rotation_rad * _growth(at, TURN, model)) ** 2
    found[PLACE, PLACE] += place * (at.axes * np.array(model.axes)) @ at.axes.T
    found[TURN, TURN] += turn * np.eye(3) + turned * _of_clock(at, TURN, model)
    return found


def at_query(
    nearest: tuple[float, float], turns: FloatArray, pairs: Sequence[int], world_from_camera: FloatArray
) -> AtQuery:
    """Of a pose ``[4, 4]``: `turns` ``[c, 3]`` (rad) are those of the images in their own frames, the query first;
    `pairs` with each of the ``c - 1`` keyframes.
    """
    shares = np.maximum(pairs, 1e-3) / np.maximum(pairs, 1e-3).sum()
    more: FloatArray = world_from_camera[:3, :3] @ (turns[0] - shares @ turns[1:])
    return AtQuery(nearest, more, float(shares @ shares), world_from_camera[:3, :3])
