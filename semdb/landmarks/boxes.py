"""Upright boxes about points, and how far two of them are the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """An upright box: `centre` ``[3]`` in the map, `size` ``[3]`` along its own axes, the third of which is up.

    `axes` ``[3, 3]``: columns are the box's axes in the map.
    """

    centre: FloatArray
    size: FloatArray
    axes: FloatArray

    @property
    def corners(self) -> FloatArray:
        """The corners ``[8, 3]`` in the map, the lower four first, each four counter-clockwise seen from above."""
        x = np.array([-1, 1, 1, -1, -1, 1, 1, -1]) * self.size[0] / 2
        y = np.array([-1, -1, 1, 1, -1, -1, 1, 1]) * self.size[1] / 2
        z = np.array([-1, -1, -1, -1, 1, 1, 1, 1]) * self.size[2] / 2
        return np.asarray(self.centre + np.stack([x, y, z], axis=1) @ self.axes.T, np.float64)


def upright_axes(up: FloatArray) -> FloatArray:
    """Axes ``[3, 3]`` (columns) of a frame with `up` ``[3]`` as third axis, the first near to the map's."""
    up = up / np.linalg.norm(up)
    helper = np.eye(3)[int(np.argmin(np.abs(up)))] if abs(up[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
    first = helper - (helper @ up) * up
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up], axis=1)


def turned_box(centre: FloatArray, size: FloatArray, yaw: float, up: FloatArray) -> Box:
    """The upright box with that `yaw` (radians) about `up`, from the first of `upright_axes`: as it is stored."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Box(np.asarray(centre, np.float64), np.asarray(size, np.float64), upright_axes(up) @ turn)


def upright_box(
    points: FloatArray, up: FloatArray, trim: float = 0.0, least: float = 0.005, noise: FloatArray | None = None
) -> Box:
    """The box of the least footprint about `points` ``[n, 3]``, without the share `trim` at each end of each axis.

    Of the directions of the footprint, every degree is tried; sizes are at least `least` metres. `noise` ``[3, 3]`` is
    the covariance of the points' own errors: by as much as their variance along an axis is of these, a side is shorter.
    """
    frame = upright_axes(up)
    local = points @ frame
    angles = np.radians(np.arange(90.0))
    u = local[:, :1] * np.cos(angles) + local[:, 1:2] * np.sin(angles)
    v = local[:, 1:2] * np.cos(angles) - local[:, :1] * np.sin(angles)
    low, high = trim, 1 - trim
    width, depth = (np.subtract(*np.quantile(values, (high, low), axis=0)) for values in (u, v))
    if noise is not None:
        turned = frame.T @ noise @ frame
        own_u = turned[0, 0] * np.cos(angles) ** 2 + turned[1, 1] * np.sin(angles) ** 2
        mixed = 2 * turned[0, 1] * np.cos(angles) * np.sin(angles)
        width = width * _without_noise(u.var(axis=0), own_u + mixed)
        depth = depth * _without_noise(v.var(axis=0), turned[0, 0] + turned[1, 1] - own_u - mixed)
    area = np.maximum(width, least) * np.maximum(depth, least)
    # two faces of a box are a triangle seen from above, and as small a box about them lies across it: points that lie
    # at the sides of their box tell the two apart (Zhang and others, IV 2017)
    side = np.minimum(
        np.minimum(u - u.min(axis=0), u.max(axis=0) - u), np.minimum(v - v.min(axis=0), v.max(axis=0) - v)
    )
    best = int(np.argmin(np.round(area * (1 + 4 * side.mean(axis=0) / np.sqrt(area)), 9)))
    c, s = np.cos(angles[best]), np.sin(angles[best])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    axes = frame @ turn
    own = points @ axes
    first, last = np.quantile(own, (low, high), axis=0)
    size = last - first
    if noise is not None:
        size = size * _without_noise(own.var(axis=0), np.diag(axes.T @ noise @ axes))
    return Box(axes @ ((first + last) / 2), np.maximum(size, least), axes)


def _without_noise(variance: FloatArray, noise: FloatArray) -> FloatArray:
    """How much shorter a side is than points of that `variance` are spread, of which `noise` is errors."""
    return np.asarray(np.sqrt(np.clip(1 - noise / np.maximum(variance, 1e-12), 0.0, 1.0)), np.float64)


def intersection_over_union(one: Box, other: Box) -> float:
    """Of two upright boxes with the same up: shared volume over joint volume."""
    shared = shared_volume(one, other)
    return float(shared / (np.prod(one.size) + np.prod(other.size) - shared))


def shared_volume(one: Box, other: Box) -> float:
    """Of two upright boxes with the same up, cubic metres."""
    up = one.axes[:, 2]
    a, b = one.centre @ up, other.centre @ up
    height = min(a + one.size[2] / 2, b + other.size[2] / 2) - max(a - one.size[2] / 2, b - other.size[2] / 2)
    if height <= 0:
        return 0.0
    return float(height * shared_area(footprint(one, one.axes), footprint(other, one.axes)))


def footprint(box: Box, axes: FloatArray) -> FloatArray:
    """The four corners ``[4, 2]`` of the base, counter-clockwise, along the first two of `axes` (columns)."""
    return np.asarray(box.corners[:4] @ axes[:, :2], np.float64)


def shared_area(one: FloatArray, other: FloatArray) -> float:
    """Area that two convex polygons ``[n, 2]``, counter-clockwise, have in common (Sutherland and Hodgman)."""
    found = [(float(x), float(y)) for x, y in one]
    for k in range(len(other)):
        (ax, ay), (bx, by) = other[k], other[(k + 1) % len(other)]
        inside = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x, y in found]
        kept: list[tuple[float, float]] = []
        for i in range(len(found)):
            j = (i + 1) % len(found)
            if inside[i] >= 0:
                kept.append(found[i])
            if (inside[i] > 0) != (inside[j] > 0) and inside[i] != inside[j]:
                t = inside[i] / (inside[i] - inside[j])
                kept.append(
                    (found[i][0] + t * (found[j][0] - found[i][0]), found[i][1] + t * (found[j][1] - found[i][1]))
                )
        found = kept
        if len(found) < 3:
            return 0.0
    x, y = np.array(found).T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
