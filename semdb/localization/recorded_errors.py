"""How far recorded poses are off what images show, and what of it an answer must count with.

The true poses of a recording, and so the frame of its map, have errors of their own: a depth tracker drifts, motion
capture has another clock. How much, the images of the keyframes show: each localized among its neighbours says by how
much these are off (`bundle`), and all of a recording together say it better than one query can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.types import FloatArray, PoseErrors

USUAL = PoseErrors(0.007, 0.006, 8.0, 8.0)  # of a recording of which nothing is known, as good as so many numbers
PLACE, TURN = slice(0, 3), slice(3, 6)
LEAST_M, LEAST_RAD = 1e-5, 1e-5  # below, it is nothing
OWN_SHARE = 0.5  # of what a query itself shows, beside what its keyframes' recordings do: few keyframes err alike


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """What errors of recorded poses make of an answer; fitted on the recordings of docs/localization.md.

    A place is off by `place` metres at 1 of `pose_distances` from the nearest keyframe where the recording's errors are
    `unit_m` and images alone leave `unit_image_m`; it grows with powers of all three, and `near` is not fallen below.
    A turn likewise, in shares of the recording's own. `clock` is what the turn during a readout adds, where clocks of
    poses and images differ: metres and radians for a radian.
    """

    unit_m: float = 0.008
    greatest_m: float = 0.016  # beyond, a place is off in proportion: recordings that it was fitted on have less
    unit_image_m: float = 0.008
    place: float = 0.0066
    place_errors: float = 3.0
    place_image: float = 0.87
    place_distance: float = 0.6
    place_near: float = 0.22
    unit_image_rad: float = 0.004
    turn: float = 1.5
    turn_image: float = 0.8
    turn_distance: float = 0.71
    turn_near: float = 0.02
    clock_m: float = 0.038
    clock_rad: float = 0.16
    clock_of_m: float = 0.004  # of the recording's errors, from which on its clock is believed to differ
    clock_of_rad: float = 0.003


@dataclass(frozen=True, slots=True)
class AtQuery:
    """What the errors of recorded poses count by at one query. Standard deviations are along an axis."""

    nearest: tuple[float, float]  # distances of the nearest keyframe (`pose_distances`) for its place and its turn
    position_m: float  # standard deviation that images alone leave
    rotation_rad: float
    turn_rad: float  # by which the camera turned while the image was read out


def pooled(found: Sequence[PoseErrors]) -> PoseErrors:
    """What several say together: the mean of squares, each as often as it has numbers. Nothing known of none."""
    place = np.array([[one.position_freedom, one.position_m**2] for one in found]).reshape(-1, 2)
    turn = np.array([[one.rotation_freedom, one.rotation_rad**2] for one in found]).reshape(-1, 2)
    metres, radians = (float(np.sqrt((of[:, 0] * of[:, 1]).sum() / max(of[:, 0].sum(), 1e-9))) for of in (place, turn))
    return PoseErrors(metres, radians, float(place[:, 0].sum()), float(turn[:, 0].sum()), len(found))


def shrunk(own: PoseErrors | None, known: Sequence[PoseErrors]) -> PoseErrors:
    """The weighted mean of logarithms of what a query itself shows, of what is known, and of what is usual.

    Of logarithms, since errors of recordings differ by factors.
    """
    less = [] if own is None else [_scaled(own, OWN_SHARE)]
    of = (USUAL, *less, *known)
    place, turn = np.array([one.position_freedom for one in of]), np.array([one.rotation_freedom for one in of])
    metres = np.log([max(one.position_m, LEAST_M) for one in of])
    radians = np.log([max(one.rotation_rad, LEAST_RAD) for one in of])
    return PoseErrors(
        float(np.exp((place * metres).sum() / place.sum())),
        float(np.exp((turn * radians).sum() / turn.sum())),
        float(place.sum()),
        float(turn.sum()),
    )


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


def recorded_sigma(errors: PoseErrors, query: AtQuery, model: ErrorModel | None = None) -> tuple[float, float]:
    """How far (m, rad; along an axis) a pose recorded where the query is would be off what the images show."""
    of = model or ErrorModel()
    place = np.hypot(query.nearest[0] ** of.place_distance, of.place_near) * of.place
    place *= (min(errors.position_m, of.greatest_m) / of.unit_m) ** of.place_errors
    place *= max(errors.position_m / of.greatest_m, 1.0) * (query.position_m / of.unit_image_m) ** of.place_image
    turn = np.hypot(query.nearest[1] ** of.turn_distance, of.turn_near) * of.turn * errors.rotation_rad
    turn *= (query.rotation_rad / of.unit_image_rad) ** of.turn_image
    metres = of.clock_m * query.turn_rad * min(errors.position_m / of.clock_of_m, 1.0) ** 2
    radians = of.clock_rad * query.turn_rad * min(errors.rotation_rad / of.clock_of_rad, 1.0) ** 2
    return float(np.hypot(place, metres)), float(np.hypot(turn, radians))


def at_query(covariance: FloatArray, nearest: tuple[float, float], turn: FloatArray) -> AtQuery:
    """Of a pose with the `covariance` ``[6, 6]`` that images alone leave, and `turn` ``[3]`` (rad) in its readout."""
    place, rotation = (float(np.sqrt(max(np.trace(covariance[of, of]) / 3, 0.0))) for of in (PLACE, TURN))
    return AtQuery(nearest, place, rotation, float(np.linalg.norm(turn)))
