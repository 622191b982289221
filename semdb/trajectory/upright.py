"""Which way is up: the direction that floors, tables and ceilings face, and that walls stand along.

Nothing measures gravity. But of what a camera indoors sees much is level or plumb, and people hold a camera upright
within some tens of degrees. So the direction is looked for near to the cameras' mean up, which most surfaces are level
or plumb to; where two directions fit about as well, or too little does, it is not told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import back_project
from semdb.trajectory.depth_views import EVERY, DepthView
from semdb.types import FloatArray

STRIDE = 3  # cells of a thinned depth between the points that a normal is of
NORMALS = 400  # of each keyframe
SEARCHED = 1500  # of all, while directions are tried
BEND = 0.97  # cosine that the normals of neighbouring cells of a plane have at least
FARTHEST_DEG = 40.0  # of up from the cameras' mean up
WIDTH_DEG = 3.0  # to which surfaces are level or plumb
GRID_DEG = 2.0  # between the directions that are tried
RIVAL_DEG = 10.0  # a direction so far from the best is another one,
RIVAL_SHARE = 0.85  # and with so much of its support makes both doubtful
LEAST_SHARE = 0.3  # of normals that are level or plumb
LEAST_LEVEL = 0.02  # of normals that are level
GROUPS = 8  # of keyframes, by which it is seen how sure it is
FLOOR_DEG = 0.5  # no up is surer


@dataclass(frozen=True, slots=True, eq=False)
class Up:
    """Up: a direction ``[3]``, its standard deviation (each of two angles), the share of surfaces that agree."""

    direction: FloatArray
    sigma_deg: float
    share: float


def find_up(depths: Sequence[DepthView | None], world_from_camera: FloatArray) -> Up | None:
    """Up in the world of poses ``[n, 4, 4]`` of keyframes with `depths`; None where it cannot be told."""
    held = -world_from_camera[:, :3, 1].mean(axis=0)
    if np.linalg.norm(held) < 0.3:
        return None  # they were held all ways
    held = held / np.linalg.norm(held)
    normals = [
        np.zeros((0, 3)) if depth is None else normals_of(depth) @ pose[:3, :3].T
        for depth, pose in zip(depths, world_from_camera, strict=True)
    ]
    every = np.concatenate(normals)
    if len(every) < NORMALS:
        return None
    directions = _around(held, FARTHEST_DEG, GRID_DEG)
    some = every[:: max(1, len(every) // SEARCHED)]
    support = np.concatenate([_support(some, part) for part in np.array_split(directions, 16)])
    best = int(np.argmax(support))
    up = _settled(every, directions[best])
    apart = directions @ up < np.cos(np.radians(RIVAL_DEG))
    if up @ held < np.cos(np.radians(FARTHEST_DEG)) or (support[apart] > RIVAL_SHARE * support[best]).any():
        return None
    along = np.abs(every @ up)
    level, plumb = along > np.cos(np.radians(2 * WIDTH_DEG)), along < np.sin(np.radians(2 * WIDTH_DEG))
    share = float((level | plumb).mean())
    if share < LEAST_SHARE or level.mean() < LEAST_LEVEL:
        return None
    return Up(up, _sigma_deg(normals, up), share)


def normals_of(view: DepthView) -> FloatArray:
    """Unit normals ``[m, 3]`` of even surfaces that a frame sees, in its camera frame, towards the camera."""
    height, width = view.depth.shape
    v, u = np.mgrid[0:height, 0:width]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64) * EVERY
    points = back_project(view.camera, pixels, view.depth.ravel().astype(np.float64)).reshape(height, width, 3)
    across = points[STRIDE:-STRIDE, 2 * STRIDE :] - points[STRIDE:-STRIDE, : -2 * STRIDE]
    down = points[2 * STRIDE :, STRIDE:-STRIDE] - points[: -2 * STRIDE, STRIDE:-STRIDE]
    normal = np.cross(down, across)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=2, keepdims=True)
        middle = normal[STRIDE:-STRIDE, STRIDE:-STRIDE]
        even = np.ones(middle.shape[:2], np.bool_)
        for shifted in (
            normal[: -2 * STRIDE, STRIDE:-STRIDE],
            normal[2 * STRIDE :, STRIDE:-STRIDE],
            normal[STRIDE:-STRIDE, : -2 * STRIDE],
            normal[STRIDE:-STRIDE, 2 * STRIDE :],
        ):
            even &= (shifted * middle).sum(axis=2) > BEND  # False for NaN
    found = middle[even]
    if not len(found):
        return np.zeros((0, 3))
    chosen = np.unique(np.linspace(0, len(found) - 1, min(NORMALS, len(found))).astype(int))
    return np.asarray(found[chosen], np.float64)


def _around(direction: FloatArray, radius_deg: float, step_deg: float) -> FloatArray:
    """Unit vectors ``[n, 3]`` within an angle of `direction`, about evenly spaced."""
    one, two = _across(direction)
    steps = np.radians(np.arange(-radius_deg, radius_deg + step_deg / 2, step_deg))
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    angle = np.hypot(a, b)
    a, b, angle = (values[angle <= np.radians(radius_deg)] for values in (a, b, angle))
    scale = np.sinc(angle / np.pi)
    return np.asarray(
        np.cos(angle)[:, None] * direction + scale[:, None] * (a[:, None] * one + b[:, None] * two), np.float64
    )


def _across(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors that make a frame with `direction`."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    one = np.cross(direction, helper)
    one /= np.linalg.norm(one)
    return one, np.cross(direction, one)


def _support(normals: FloatArray, directions: FloatArray) -> FloatArray:
    """How many of `normals` are level or plumb to each of `directions` ``[n]``."""
    along = np.abs(normals @ directions.T)
    width = np.radians(WIDTH_DEG)
    off_plumb = np.arcsin(np.minimum(along, 1.0))
    off_level = np.pi / 2 - off_plumb
    off = np.minimum(off_plumb, off_level) / width  # of both, the other is nothing
    return np.asarray(np.exp(-0.5 * off * off).sum(axis=0))


def _settled(normals: FloatArray, up: FloatArray) -> FloatArray:
    """The direction near `up` that surfaces which are level or plumb to it agree on, least squares with weights."""
    for _ in range(6):
        along = normals @ up
        width = np.sin(np.radians(WIDTH_DEG))
        level = np.exp(-0.5 * np.maximum(1 - along**2, 0) / width**2)
        plumb = np.exp(-0.5 * along**2 / width**2)
        spread = np.einsum("ni,n,nj->ij", normals, plumb - level, normals)  # not of BLAS: the same on any threads
        _, vectors = np.linalg.eigh(spread)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    return np.asarray(up, np.float64)


def _sigma_deg(normals: Sequence[FloatArray], up: FloatArray) -> float:
    """By how much `up` would change without one of some groups of keyframes that follow each other (a jackknife)."""
    groups = [group for group in np.array_split(np.arange(len(normals)), GROUPS) if len(group)]
    if len(groups) < 2:
        return WIDTH_DEG
    total = 0.0
    for group in groups:
        rest = [rows for n, rows in enumerate(normals) if n not in set(group.tolist())]
        left = np.concatenate(rest)
        moved = _settled(left, up) if len(left) else up
        total += float(np.linalg.norm(np.cross(moved, up)) ** 2)
    spread = np.sqrt(total * (len(groups) - 1) / len(groups) / 2)
    return max(FLOOR_DEG, float(np.degrees(spread)))


def level_world(first_from_camera: FloatArray, up: FloatArray) -> FloatArray:
    """The pose ``[4, 4]`` that turns a world about its origin so that `up` is z and the camera looks along x.

    `first_from_camera` ``[4, 4]`` is the camera at the origin; where it looks straight up or down its own up is x. Axes
    are those of robots: x forward, y left, z up.
    """
    forward = first_from_camera[:3, 2]
    if np.linalg.norm(np.cross(forward, up)) < 0.1:
        forward = -first_from_camera[:3, 1]
    left = np.cross(up, forward)
    left /= np.linalg.norm(left)
    turned = np.eye(4)
    turned[:3, :3] = np.stack([np.cross(left, up), left, up])
    return turned
