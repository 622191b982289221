"""Which keyframes of a map see the same things: the few that have most in common with each, by their points."""

from __future__ import annotations

from collections.abc import Sequence
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


def common_view(one: Volume, two: Volume) -> float:
    """The lesser share of the points of one that fall into the other's image."""
    if not len(one.points) or not len(two.points):
        return 0.0
    return min(one.share_of(two.points), two.share_of(one.points))


def common_views(one: Volume, others: Sequence[Volume]) -> FloatArray:
    """`common_view` of one with each of others ``[n]``: all at once where their cameras are the same."""
    alike = all(other.camera == one.camera and len(other.points) == len(one.points) > 0 for other in others)
    if len(others) < 2 or not alike:
        return np.array([common_view(one, other) for other in others], np.float64)
    poses = np.stack([other.world_from_camera for other in others])
    theirs = np.stack([other.points for other in others])
    here = (theirs - one.world_from_camera[:3, 3]) @ one.world_from_camera[:3, :3]
    there = (one.points[None] - poses[:, None, :3, 3]) @ poses[:, :3, :3]
    local = np.concatenate([here, there]).reshape(-1, 3)
    front = local[:, 2] > LEAST_DEPTH_M
    depth = np.where(front, local[:, 2], 1.0)
    xy = normalized_to_pixels(one.camera, local[:, :2] / depth[:, None])
    inside = front & (xy > 0).all(axis=1) & (xy < [one.camera.width - 1, one.camera.height - 1]).all(axis=1)
    shares = inside.reshape(2, len(others), -1).mean(axis=2)
    return np.asarray(shares.min(axis=0), np.float64)


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
        pairs = {j: (min(i, j), max(i, j)) for j in sorted({int(j) for j in row} - {i})}
        new = [j for j, pair in pairs.items() if pair not in shares]
        found_shares = common_views(volumes[i], [volumes[j] for j in new]).tolist()
        shares |= {pairs[j]: share for j, share in zip(new, found_shares, strict=True)}
        ranked = [(-shares[pair], pair) for pair in pairs.values() if shares[pair] >= least_share]
        found.update(pair for _, pair in sorted(ranked)[:neighbours])
    return sorted(found)
