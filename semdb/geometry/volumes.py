"""Which keyframes of a map see the same things: the few that have most in common with each, by their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from semdb.geometry import back_project, invert_pose, normalized_to_pixels, transform_points
from semdb.types import Camera, Float32Array, FloatArray

SAMPLES = 64
LEAST_DEPTH_M = 0.1  # nearer is not seen
UNKNOWN_DEPTH_M = 2.0  # where a keyframe without depth is taken to look


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """What a keyframe sees, in short: some of its points ``[s, 3]`` in the map."""

    camera: Camera
    world_from_camera: FloatArray
    points: FloatArray

    @property
    def centre(self) -> FloatArray:
        return np.asarray(np.median(self.points, axis=0))

    def share_of(self, points: FloatArray) -> float:
        """Share of world `points` ``[n, 3]`` that fall into its image."""
        local = transform_points(invert_pose(self.world_from_camera), points)
        front = local[local[:, 2] > LEAST_DEPTH_M]
        xy = normalized_to_pixels(self.camera, front[:, :2] / front[:, 2:])
        inside = (xy > 0).all(axis=1) & (xy < [self.camera.width - 1, self.camera.height - 1]).all(axis=1)
        return float(inside.sum()) / len(points)


def volume_of(camera: Camera, world_from_camera: FloatArray, xy: Float32Array, points: Float32Array) -> Volume:
    """The volume of a keyframe with keypoints `xy` ``[n, 2]`` and `points` ``[n, 3]`` in the camera frame."""
    known = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    if len(known) < SAMPLES // 4:
        corners = np.array([(u, v) for u in (0.2, 0.5, 0.8) for v in (0.2, 0.5, 0.8)]) * [camera.width, camera.height]
        pixels = corners if not len(xy) else xy.astype(np.float64)
        placed = back_project(camera, pixels, np.full(len(pixels), UNKNOWN_DEPTH_M))
        known = np.concatenate([known, placed[np.isfinite(placed).all(axis=1)]])
    chosen = known[np.linspace(0, len(known) - 1, SAMPLES).astype(int)]
    return Volume(camera, world_from_camera, transform_points(world_from_camera, chosen))


def neighbour_pairs(
    volumes: list[Volume], neighbours: int, least_share: float, candidates: int
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, ascending, in which one is among the `neighbours` that have most in common with the other.

    In common is the lesser share of the points of one that fall into the other's image, at least `least_share`. Only
    the `candidates` whose centres are nearest are compared.
    """
    centres = np.stack([volume.centre for volume in volumes])
    _, near = cKDTree(centres).query(centres, k=min(candidates + 1, len(volumes)))
    shares: dict[tuple[int, int], float] = {}
    found: set[tuple[int, int]] = set()
    for i, row in enumerate(np.atleast_2d(near.reshape(len(volumes), -1))):
        ranked = []
        for j in sorted({int(j) for j in row} - {i}):
            pair = min(i, j), max(i, j)
            if pair not in shares:
                one, two = volumes[pair[0]], volumes[pair[1]]
                shares[pair] = min(one.share_of(two.points), two.share_of(one.points))
            if shares[pair] >= least_share:
                ranked.append((-shares[pair], pair))
        found.update(pair for _, pair in sorted(ranked)[:neighbours])
    return sorted(found)
