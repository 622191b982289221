"""Which way is up in a map, and how high its floor lies: from the tilt of its cameras and the planes in its depth."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.memo import Arrays, Forgetful, Memo, remembered
from semdb.landmarks.options import RegisterOptions
from semdb.landmarks.register import surface_of
from semdb.types import FloatArray

SURFACE = "surface"  # kind of what is remembered
UPRIGHT = 0.3  # length of the mean of the cameras' up: less, and they were rolled all ways
WITHIN = 0.6  # cosine: so far from the cameras' mean up that up may be, 53 degrees
LEVEL = 0.97  # cosine: a surface that is level, 14 degrees
FLOOR_SHARE = 0.1  # of the level surface below the cameras that a floor has at least
_BIN = 0.02
_CANDIDATES, _TRIED = 300, 4  # directions of surfaces that are looked at, and of the best ones made exact
_MOST_POINTS, _MOST_OF_MAP = 400, 60_000  # of a keyframe, of all
_FINEST = 2.0**-9  # a tenth of a degree


@dataclass(frozen=True, slots=True, eq=False)
class Gravity:
    """`up` ``[3]`` is a unit vector of the map; the floor is where ``up @ x == floor``, None where none was seen.

    Certainties are from 0 to 1: what share of the walls, floors and tables agrees with `up` to five degrees, and what
    share of the level surface below the cameras the floor is.
    """

    up: FloatArray
    up_certainty: float
    floor: float | None
    floor_certainty: float
    given: bool = False  # told, not estimated


def estimate_gravity(
    lifted: Sequence[LiftedKeyframe], up: FloatArray | None = None, memo: Memo | None = None
) -> Gravity:
    """Up and floor of the map; `up` where it is known. Without depth up is that of the cameras, of certainty 0."""
    poses = np.array([frame.world_from_camera for frame in lifted], np.float64).reshape(-1, 4, 4)
    points, normals = _surfaces(lifted, poses, memo or Forgetful())
    if up is not None:
        direction, certainty = np.asarray(up, np.float64) / np.linalg.norm(up), 1.0
    else:
        direction, certainty = _direction(poses, normals)
        direction = on_lattice(direction)
    floor, share = _floor(poses, points, normals, direction)
    return Gravity(direction, certainty, floor, share, up is not None)


def _surfaces(lifted: Sequence[LiftedKeyframe], poses: FloatArray, memo: Memo) -> tuple[FloatArray, FloatArray]:
    """Points and normals ``[n, 3]`` in the map; as many of each square metre, whatever its distance."""
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    for frame, pose in zip(lifted, poses, strict=True):
        own = functools.partial(_surface, frame)
        found = remembered(memo, SURFACE, frame.name, own) if frame.name else own()
        count = len(found["points"])
        wanted = min(count, max(1, _MOST_OF_MAP // len(lifted)))
        taken = np.arange(wanted) * count // max(wanted, 1)
        points.append(found["points"][taken] @ pose[:3, :3].T + pose[:3, 3])
        normals.append(found["normals"][taken] @ pose[:3, :3].T)
    return np.concatenate(points), np.concatenate(normals)


def on_lattice(direction: FloatArray) -> FloatArray:
    """The direction nearby whose parts are multiples of `_FINEST` but for its length.

    More keyframes find another one by less than it is good for: boxes that stand upright by it stay as they are.
    """
    whole = np.round(direction / _FINEST)
    return np.asarray(whole / np.linalg.norm(whole), np.float64)


def _surface(frame: LiftedKeyframe) -> Arrays:
    """Points and normals ``[n, 3]`` of one keyframe, in its camera frame."""
    surface = surface_of(frame, RegisterOptions())
    if not len(surface.points):
        return {"points": np.empty((0, 3)), "normals": np.empty((0, 3))}
    area = surface.points[:, 2] ** 2 / np.maximum(np.abs(surface.normals[:, 2]), 0.2)
    ends = np.cumsum(area)
    wanted = min(_MOST_POINTS, len(area))
    taken = np.unique(np.searchsorted(ends, (np.arange(wanted) + 0.5) / wanted * ends[-1]).clip(0, len(area) - 1))
    return {"points": surface.points[taken], "normals": surface.normals[taken]}


def _direction(poses: FloatArray, normals: FloatArray) -> tuple[FloatArray, float]:
    mean = -poses[:, :3, 1].mean(axis=0) if len(poses) else np.array([0.0, 0.0, 1.0])
    length = float(np.linalg.norm(mean))
    starts = [mean / length] if length > UPRIGHT else []
    if len(normals) < 50:
        return starts[0] if starts else np.array([0.0, 0.0, 1.0]), 0.0
    # cameras that look down on a desk are tilted by more than surfaces can mend: those are asked for directions, too
    some = normals[:: max(1, len(normals) // _CANDIDATES)]
    worth = np.array([_agreement(direction, normals) for direction in some])
    for k in np.argsort(-np.round(worth, 6), kind="stable")[:_TRIED].tolist():
        starts += [some[k], -some[k]]
    starts += [*np.eye(3), *-np.eye(3)]
    found = [_refined(start, normals) for start in starts]
    if length > UPRIGHT:  # a room lies as well on its side, but nobody holds a camera so
        found = [direction for direction in found if direction @ mean >= WITHIN * length] or found
    shares = [_agreement(direction, normals) for direction in found]
    # a room lies as well on its side: up is where floors and tables look to, and near to the cameras' tilt
    facing = [float(np.mean(normals @ direction > np.cos(np.radians(5)))) for direction in found]
    tilt = [float(direction @ mean) / max(length, UPRIGHT) for direction in found]
    scores = [share + seen + 0.3 * near for share, seen, near in zip(shares, facing, tilt, strict=True)]
    best = int(np.argmax(np.round(scores, 6)))
    return found[best], shares[best] * (1.0 if length > UPRIGHT else 0.5)


def _refined(start: FloatArray, normals: FloatArray) -> FloatArray:
    """The direction that level surfaces are nearest across to, and walls nearest along."""
    up = start
    for degrees in (30.0, 20.0, 12.0, 8.0, 5.0, 5.0):
        along = np.abs(normals @ up)
        level = normals[along > np.cos(np.radians(degrees))]
        upright = normals[along < np.sin(np.radians(degrees))]
        if len(level) + len(upright) < 20:
            return up
        matrix = upright.T @ upright - level.T @ level
        _, vectors = np.linalg.eigh(matrix)
        up = vectors[:, 0] if vectors[:, 0] @ up >= 0 else -vectors[:, 0]
    return np.asarray(up / np.linalg.norm(up), np.float64)


def _agreement(up: FloatArray, normals: FloatArray) -> float:
    """Share of the surfaces that are level or upright to five degrees."""
    along = np.abs(normals @ up)
    return float(np.mean((along > np.cos(np.radians(5))) | (along < np.sin(np.radians(5)))))


def _floor(poses: FloatArray, points: FloatArray, normals: FloatArray, up: FloatArray) -> tuple[float | None, float]:
    """Height of the lowest large level surface below the cameras, and its share of all of those."""
    if not len(poses) or not len(points):
        return None, 0.0
    heights = points @ up
    below = (normals @ up > LEVEL) & (heights < np.min(poses[:, :3, 3] @ up) - 0.2)
    if np.count_nonzero(below) < 30:
        return None, 0.0
    level = heights[below]
    lowest = float(np.quantile(level, 0.005))
    counts = np.bincount(np.floor((level - lowest) / _BIN).astype(int).clip(0)).astype(np.float64)
    three = np.convolve(counts, np.ones(3), mode="same")
    large = np.flatnonzero(three >= max(FLOOR_SHARE * len(level), 20))
    if not len(large):
        return None, 0.0
    first = int(large[0])
    peak = first + int(np.argmax(three[first : first + 4]))
    near = level[np.abs(level - lowest - (peak + 0.5) * _BIN) < 2 * _BIN]
    return float(np.median(near)), float(len(near) / len(level))
