"""Do the depths of two frames fit a pose between them? Surfaces tell where pixels are few, or things are twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.geometry import back_project, invert_pose, normalized_to_pixels, transform_points
from semdb.types import Camera, Float32Array, FloatArray

SAMPLES_ACROSS = 40  # points of a frame that are looked at in the other
EVERY = 4  # pixels of its depth that a frame keeps, in each direction
LEAST_COMPARED = 60  # fewer say nothing
TOLERANCE_M, TOLERANCE_SHARE = 0.01, 0.02  # of depth


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """Depth of one frame, thinned: `points` ``[s, 3]`` (camera frame), and depth at every fourth pixel."""

    camera: Camera
    points: FloatArray
    depth: Float32Array  # [h, w] metres, NaN without


def depth_view(camera: Camera, depth: Float32Array | None) -> DepthView | None:
    """The thinned depth of a frame with `depth` ``[H, W]`` metres (NaN invalid); None without."""
    if depth is None:
        return None
    step = max(1, round(camera.width / SAMPLES_ACROSS))
    v, u = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    found = depth[v, u].ravel().astype(np.float64)
    known = np.isfinite(found)
    pixels = np.column_stack([u.ravel(), v.ravel()])[known]
    points = back_project(camera, pixels, found[known])
    usable = np.isfinite(points).all(axis=1)
    return DepthView(camera, points[usable], np.ascontiguousarray(depth[::EVERY, ::EVERY], np.float32))


def depth_agreement(one: DepthView | None, two: DepthView | None, one_from_two: FloatArray) -> float | None:
    """Share 0..1 of the points of each that the other has a depth for, and that lie at that depth; the lesser of both.

    At a depth is within 1 cm and 2 %. What is hidden counts against it, so that even a right pose has less than 1.
    None where there is too little to compare.
    """
    if one is None or two is None:
        return None
    shares = [_share(two, one, one_from_two), _share(one, two, invert_pose(one_from_two))]
    known = [share for share in shares if share is not None]
    return min(known) if known else None


def _share(source: DepthView, target: DepthView, target_from_source: FloatArray) -> float | None:
    moved = transform_points(target_from_source, source.points)
    moved = moved[moved[:, 2] > 0.1]
    pixels = normalized_to_pixels(target.camera, moved[:, :2] / moved[:, 2:])
    cells = np.rint(pixels / EVERY)
    height, width = target.depth.shape
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < width) & (cells[:, 1] < height)
    column, row = cells[inside].astype(np.int64).T
    there, expected = target.depth[row, column].astype(np.float64), moved[inside, 2]
    known = np.isfinite(there)
    if np.count_nonzero(known) < LEAST_COMPARED:
        return None
    off = np.abs(there[known] - expected[known])
    return float(np.mean(off < TOLERANCE_M + TOLERANCE_SHARE * there[known]))
