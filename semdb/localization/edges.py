"""Edges of an image: where grey values jump, to a fraction of a pixel; and of one with depth, as lines in space."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semdb.geometry import normalized_to_pixels, transform_points
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, ImageArray

ACROSS = 640  # pixels of the image that edges are looked for in
BLUR = 1.2  # pixels
LEAST_STEP = 2.5  # grey values per pixel
CLEAR_STEP = 5.0  # one pixel of an edge must have so many
LEAST_PIXELS = 12  # of an edge
MOST_POINTS = 1500  # of a keyframe
APART = 3  # pixels
ABOUT = 9  # pixels, in which the depth of an edge is read
JUMP, SAME_SIDE = 0.06, 0.03  # of depth: more is an edge of a thing before others, whose own side is within this
REACHES = (8, 7, 6, 5, 4)  # pixels along an edge, from which its direction in space is read
COVER_ACROSS = 160  # points of a keyframe's surfaces side by side, which hide edges behind them


@dataclass(frozen=True, slots=True, eq=False)
class ImageEdges:
    """Edges of an image without distortion, ``[h, w]``. `strength` is 0 where there is none.

    `offset` is how far (pixels) the edge lies from the middle of the pixel along its gradient (`along_x`, `along_y`),
    which points from dark to bright.
    """

    intrinsics: FloatArray  # fx, fy, cx, cy
    strength: Float32Array
    offset: Float32Array
    along_x: Float32Array
    along_y: Float32Array

    @property
    def clear(self) -> BoolArray:
        """Which pixels ``[h, w]`` hold a clear edge."""
        return np.asarray(self.strength > CLEAR_STEP)


@dataclass(frozen=True, slots=True, eq=False)
class SpaceEdges:
    """Edges of a keyframe: `points` and unit `tangents` ``[n, 3]``, the bright side to the left of a tangent as seen.

    `cover` ``[m, 3]`` are points of the surfaces that it saw. All in one frame: the camera's, or the world.
    """

    points: FloatArray
    tangents: FloatArray
    cover: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PlacedEdges:
    """Edges of a keyframe in the world."""

    keyframe_id: int
    world_from_camera: FloatArray
    edges: SpaceEdges

    @classmethod
    def at(cls, keyframe_id: int, local: SpaceEdges, world_from_camera: FloatArray) -> PlacedEdges:
        """`local` ones, of the camera frame, moved to the world."""
        edges = SpaceEdges(
            transform_points(world_from_camera, local.points),
            local.tangents @ world_from_camera[:3, :3].T,
            transform_points(world_from_camera, local.cover),
        )
        return cls(keyframe_id, world_from_camera, edges)


def image_edges(camera: Camera, grey: ImageArray) -> ImageEdges:
    """Those of a `grey` image ``[H, W]``."""
    from semdb.localization.edge_kernels import thin

    seen, image = without_distortion(camera, grey.astype(np.float32), cv2.INTER_LINEAR)
    soft = cv2.GaussianBlur(image, (0, 0), BLUR)
    gx, gy = (np.asarray(cv2.Sobel(soft, cv2.CV_32F, dx, 1 - dx, ksize=1) / 2, np.float32) for dx in (1, 0))
    step = np.asarray(np.hypot(gx, gy), np.float32)
    strength, offset = np.zeros_like(step), np.zeros_like(step)
    thin(step, gx, gy, LEAST_STEP, strength, offset)
    count, label, stats, _ = cv2.connectedComponentsWithStats((strength > 0).astype(np.uint8), connectivity=8)
    kept = np.zeros(count, np.bool_)
    kept[np.unique(label[strength > CLEAR_STEP])] = True
    kept &= stats[:, cv2.CC_STAT_AREA] >= LEAST_PIXELS
    kept[0] = False
    strength[~kept[label]] = 0
    safe = np.maximum(step, 1e-6, dtype=np.float32)
    intrinsics = np.array([seen.fx, seen.fy, seen.cx, seen.cy])
    along_x, along_y = (np.asarray(part / safe, np.float32) for part in (gx, gy))
    return ImageEdges(intrinsics, strength, offset, along_x, along_y)


def space_edges(camera: Camera, depth: Float32Array, grey: ImageArray) -> SpaceEdges | None:
    """Edges of an image with `depth` ``[H, W]`` metres, in the camera frame; None where none has a depth."""
    found = image_edges(camera, grey)
    seen, depth = without_distortion(camera, depth, cv2.INTER_NEAREST)
    at_edges = _depth_at_edges(depth)
    v, u = np.nonzero((found.strength > 0) & np.isfinite(at_edges))
    if not len(u):
        return None
    gx, gy = found.along_x[v, u].astype(float), found.along_y[v, u].astype(float)
    x, y = u + found.offset[v, u] * gx, v + found.offset[v, u] * gy
    points = _lifted(seen, x, y, at_edges[v, u].astype(float))
    row_of = np.full(depth.shape, -1)
    row_of[v, u] = np.arange(len(u))
    ahead, behind = (_along(row_of, points[:, 2], x, y, sign * gx, sign * gy) for sign in (1.0, -1.0))
    tangents = points[ahead] - points[behind]
    length = np.linalg.norm(tangents, axis=1)
    rows = _thinned(x, y, found.strength[v, u], length > 1e-6)
    if not len(rows):
        return None
    grid = max(1, seen.width // COVER_ACROSS)
    b, a = np.mgrid[grid // 2 : seen.height : grid, grid // 2 : seen.width : grid]
    far = depth[b, a].ravel().astype(float)
    known = far > 0
    cover = _lifted(seen, a.ravel()[known].astype(float), b.ravel()[known].astype(float), far[known])
    return SpaceEdges(points[rows], tangents[rows] / length[rows, None], cover)


def without_distortion(
    camera: Camera, image: Float32Array, interpolation: int, across: int = ACROSS
) -> tuple[Camera, Float32Array]:
    """`image` ``[H, W]`` at about `across` pixels as a lens without distortion shows it, and that camera."""
    step = max(1, round(camera.width / across))
    width, height = max(camera.width // step, 1), max(camera.height // step, 1)
    middle = (step - 1) / 2
    seen = Camera(
        width, height, camera.fx / step, camera.fy / step,
        (camera.cx - middle) / step, (camera.cy - middle) / step, camera.distortion,
    )  # fmt: skip
    if step > 1:
        part = np.ascontiguousarray(image[: height * step, : width * step])
        area = cv2.INTER_NEAREST if interpolation == cv2.INTER_NEAREST else cv2.INTER_AREA
        image = np.asarray(cv2.resize(part, (width, height), interpolation=area), np.float32)
    if any(camera.distortion):
        v, u = np.mgrid[:height, :width].astype(np.float64)
        rays = np.column_stack([((u - seen.cx) / seen.fx).ravel(), ((v - seen.cy) / seen.fy).ravel()])
        at = np.nan_to_num(normalized_to_pixels(seen, rays).reshape(height, width, 2), nan=-1e4).astype(np.float32)
        border = cv2.BORDER_REPLICATE if interpolation == cv2.INTER_LINEAR else cv2.BORDER_CONSTANT
        image = np.asarray(
            cv2.remap(image, at, None, interpolation, borderMode=border, borderValue=float("nan")), np.float32
        )
    return seen, np.ascontiguousarray(image, np.float32)


def _depth_at_edges(depth: Float32Array) -> Float32Array:
    """The depth ``[h, w]`` that an edge in each pixel has: where depth jumps, that of what lies before."""
    far = np.float32(1e3)
    known = depth > 0
    filled = np.where(known, depth, far)
    side = np.ones((ABOUT, ABOUT), np.uint8)
    least, most = cv2.erode(filled, side), cv2.dilate(np.where(known, depth, np.float32(0)), side)
    own = filled < least * (1 + SAME_SIDE)
    total, count = (
        cv2.boxFilter(part, -1, (ABOUT, ABOUT), normalize=False)
        for part in (np.where(own, filled, np.float32(0)), own.astype(np.float32))
    )
    front = total / np.maximum(count, 1)
    found = np.where((most > least * (1 + JUMP)) | ~known, front, depth)
    return np.where(least < far, found, np.float32(np.nan)).astype(np.float32)


def _lifted(camera: Camera, x: FloatArray, y: FloatArray, depth: FloatArray) -> FloatArray:
    """Points ``[n, 3]`` at pixels without distortion."""
    return np.column_stack([(x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth])


def _along(
    row_of: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    depth: FloatArray,
    x: FloatArray,
    y: FloatArray,
    gx: FloatArray,
    gy: FloatArray,
) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """For each edge point the row of one some pixels along its edge, at about its depth; itself where there is none."""
    height, width = row_of.shape
    found = np.arange(len(x))
    open_ = np.ones(len(x), np.bool_)
    for reach in REACHES:
        for beside in (0, 1, -1):
            u = np.clip(np.rint(x - reach * gy + beside * gx).astype(int), 0, width - 1)
            v = np.clip(np.rint(y + reach * gx + beside * gy).astype(int), 0, height - 1)
            row = row_of[v, u]
            good = open_ & (row >= 0)
            good[good] = np.abs(depth[row[good]] - depth[good]) < 0.05 * depth[good]
            found[good] = row[good]
            open_ &= ~good
    return found


def _thinned(
    x: FloatArray, y: FloatArray, strength: Float32Array, usable: BoolArray
) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Rows of the strongest edge point of each cell of some pixels, at most so many, strong and weak ones alike."""
    order = np.flatnonzero(usable)
    order = order[np.argsort(-strength[order], kind="stable")]
    cell = np.floor(y[order] / APART).astype(int) * 100_000 + np.floor(x[order] / APART).astype(int)
    _, first = np.unique(cell, return_index=True)
    rows = order[np.sort(first)]
    if len(rows) > MOST_POINTS:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_POINTS).astype(int)]
    return rows
