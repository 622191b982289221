"""How much two RGB-D views have in common: the share of each one's points that the other sees at the same depth.

Depth is sampled on a coarse grid once per view; after that a pair costs some microseconds, so that thousands of
views can be compared with hundreds of keyframes.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.compiled import kernel
from semdb.geometry import back_project, invert_pose, pixels_to_normalized
from semdb.types import BoolArray, Camera, Float32Array, FloatArray

GRID_COLUMNS = 32  # samples across an image
DEPTH_TOLERANCE = 0.1  # share of the depth; neighbours on the grid differ by this much on a surface seen at 15 degrees
MOST_RATIO = 2.5  # of distances: what one view sees from so much farther away has hardly a keypoint in common
MIN_KNOWN_SHARE = 0.05  # below this share of valid samples a view says too little to be compared


@dataclass(frozen=True, slots=True, eq=False)
class ViewGrid:
    """Depth of one view on a coarse grid: `depth` ``[rows, columns]`` metres (NaN invalid), sampled every `step` px."""

    camera: Camera
    step: int
    depth: Float32Array

    @property
    def known(self) -> bool:
        """Whether enough samples are valid to compare this view with others."""
        return bool(np.isfinite(self.depth).mean() >= MIN_KNOWN_SHARE)


def view_grid(camera: Camera, depth: Float32Array) -> ViewGrid:
    """Samples `depth` ``[H, W]`` metres at the centres of square cells, about 32 across the image."""
    step = max(1, round(camera.width / GRID_COLUMNS))
    return ViewGrid(camera, step, np.ascontiguousarray(depth[step // 2 :: step, step // 2 :: step], dtype=np.float32))


def view_overlap(first: ViewGrid, first_pose: FloatArray, second: ViewGrid, second_pose: FloatArray) -> float:
    """Common view of two views of one camera, 0 to 1: the lesser of the two shares of seen points.

    A point of one view is seen by the other when it lies inside its image and within 10 % of a depth sample next
    to it, so what is hidden there does not count; points without valid samples around them do not count at all. Nor is
    one seen from more than 2.5 times as far away, or as near: along a corridor each view would hold all before it.
    Poses are ``world_from_camera`` ``[4, 4]``.
    """
    views = ViewStack([first, second], [first_pose, second_pose])
    return float(views.overlap_with(0)[1])


class ViewStack:
    """Many views of one camera, ready to be compared with each other."""

    def __init__(self, grids: list[ViewGrid], poses: list[FloatArray]) -> None:
        camera, step = grids[0].camera, grids[0].step
        rows, columns = grids[0].depth.shape
        v, u = np.mgrid[:rows, :columns]
        pixels = np.column_stack([u.ravel(), v.ravel()]) * step + step // 2
        rays = back_project(camera, pixels, np.ones(len(pixels))).astype(np.float32)
        self._depth = np.stack([grid.depth for grid in grids])  # [n, rows, columns]
        self._rays = rays  # [rows * columns, 3]
        self._world_from_camera = np.stack(poses)
        self._camera_from_world = np.stack([invert_pose(pose) for pose in poses])
        self._camera = _camera_vector(camera, step)
        self.known: BoolArray = np.array([grid.known for grid in grids])

    def __len__(self) -> int:
        return len(self._depth)

    def overlap_with(self, index: int, floor: FloatArray | None = None) -> FloatArray:
        """Common view ``[n]`` of every view with view `index`.

        Values that are certain not to exceed `floor` ``[n]`` may be returned as 0 (they cost half).
        """
        floor = np.full(len(self), -1.0) if floor is None else floor
        overlap = np.empty(len(self))
        to_other = self._camera_from_world @ self._world_from_camera[index]
        from_other = self._camera_from_world[index] @ self._world_from_camera
        _overlaps(self._depth, self._rays, index, to_other, from_other, self._camera, floor, overlap)
        return overlap


def _camera_vector(camera: Camera, step: int) -> FloatArray:
    """Numbers for the kernel: size, intrinsics, distortion, step, and the squared radius where the lens model ends."""
    corners = [(x, y) for x in (0, camera.width - 1) for y in (0, camera.height - 1)]
    radius = np.nanmax(np.hypot(*pixels_to_normalized(camera, corners).T), initial=0.0)
    limit = (1.1 * radius) ** 2 if radius > 0 else np.inf
    distortion = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return np.array([*intrinsics, *distortion, step, limit], dtype=np.float64)


@kernel
def _overlaps(depth, rays, index, to_other, from_other, camera, floor, overlap):  # type: ignore[no-untyped-def]  # pragma: no cover
    for other in range(depth.shape[0]):
        share = _seen_share(depth[index], rays, to_other[other], depth[other], camera)
        if share > floor[other]:
            share = min(share, _seen_share(depth[other], rays, from_other[other], depth[index], camera))
        else:
            share = 0.0
        overlap[other] = share


@kernel
def _seen_share(depth, rays, pose, target, camera):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Share of the points of `depth`, moved by `pose`, that the view `target` sees; 0 where too few can be told."""
    width, height, fx, fy, cx, cy, k1, k2, p1, p2, k3, step, limit = camera
    rows, columns = depth.shape
    points, told, seen = 0, 0, 0
    for row in range(rows):
        for column in range(columns):
            d = depth[row, column]
            if not d > 0:
                continue
            points += 1
            told += 1
            ray = rays[row * columns + column]
            px, py, pz = ray[0] * d, ray[1] * d, ray[2] * d
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            if z <= 0.01 or z > MOST_RATIO * d or d > MOST_RATIO * z:
                continue
            x = (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]) / z
            y = (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]) / z
            r2 = x * x + y * y
            if r2 > limit:
                continue
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
            v = fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
            if u < -0.5 or v < -0.5 or u >= width - 0.5 or v >= height - 0.5:
                continue
            answer = _compare(target, (u - step // 2) / step, (v - step // 2) / step, z)
            if answer < 0:
                told -= 1
            else:
                seen += answer
    if told == 0 or told < 0.25 * points:
        return 0.0
    return seen / told


@kernel(inline="always")
def _compare(target, u, v, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """1 when one of the four samples around (u, v) has depth z, 0 when none, -1 when none is valid."""
    rows, columns = target.shape
    answer = -1
    for row in range(int(np.floor(v)), int(np.floor(v)) + 2):
        for column in range(int(np.floor(u)), int(np.floor(u)) + 2):
            if row < 0 or column < 0 or row >= rows or column >= columns:
                continue
            d = target[row, column]
            if d > 0:
                if abs(d - z) <= DEPTH_TOLERANCE * z:
                    return 1
                answer = 0
    return answer
