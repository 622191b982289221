"""Where keyframes are: whether a map can be expected to know a place, before anybody asks it with an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semdb.types import FloatArray, Int64Array

NEAR_M = 2.0
SECTORS = 8


@dataclass(frozen=True, slots=True)
class Coverage:
    """What a map's keyframes cover, of the whole map or within `radius_m` of `position`.

    `low` and `high` are the corners of the box around the keyframes' positions, `nearest_m` how far the nearest one is
    from `position`, and `directions` how many of the near ones look into each of eight sectors about the map's z,
    the first one around its x axis, counter-clockwise. `available`: at least one keyframe is near.
    """

    map: str
    keyframes: int
    position: tuple[float, float, float] | None
    radius_m: float
    near: int
    nearest_m: float | None
    nearest_keyframe: int | None
    low: tuple[float, float, float] | None
    high: tuple[float, float, float] | None
    directions: tuple[int, ...]

    @property
    def available(self) -> bool:
        """Whether a keyframe is near the place, or anywhere where no place was named."""
        return self.near > 0

    def as_dict(self) -> dict[str, Any]:
        """What JSON has."""
        found = {name: getattr(self, name) for name in self.__slots__}
        return {"available": self.available, **found}


def coverage_of(
    map_name: str,
    ids: Int64Array,
    poses: FloatArray,
    position: tuple[float, float, float] | None = None,
    radius_m: float = NEAR_M,
) -> Coverage:
    """The coverage by keyframes `ids` ``[n]`` with `poses` ``[n, 4, 4]`` (world from camera, metres)."""
    places = poses[:, :3, 3].reshape(-1, 3)
    near = np.ones(len(places), np.bool_)
    nearest_m, nearest = None, None
    if position is not None and len(places):
        away = np.linalg.norm(places - np.array(position), axis=1)
        near = away <= radius_m
        best = int(away.argmin())
        nearest_m, nearest = float(away[best]), int(ids[best])
    looks = poses[near, :3, 2].reshape(-1, 3)  # the camera's z looks ahead
    angles = np.arctan2(looks[:, 1], looks[:, 0])
    sectors = np.round(angles / (2 * np.pi / SECTORS)).astype(np.int64) % SECTORS
    counts = np.bincount(sectors, minlength=SECTORS)
    return Coverage(
        map=map_name,
        keyframes=len(places),
        position=position,
        radius_m=radius_m,
        near=int(near.sum()) if len(places) else 0,
        nearest_m=nearest_m,
        nearest_keyframe=nearest,
        low=_corner(places.min(axis=0)) if len(places) else None,
        high=_corner(places.max(axis=0)) if len(places) else None,
        directions=tuple(int(count) for count in counts),
    )


def _corner(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
