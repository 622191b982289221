"""Does the query show what a keyframe shows? What lies about the keypoints that agree, compared as it looks.

Keypoints that agree say that shapes agree. Of a room of the same shapes, or where a thing stands that stands elsewhere
too, a pose has many; but what lies between them looks otherwise. So the query is looked at from where the keyframe
stood: each pixel of the keyframe, at a third of its size, has a depth from the keypoints around it, and with it a place
in the query. (Taira et al., InLoc, CVPR 2018, verify poses so, with depth measured everywhere; keypoints know it well
enough at this size, and slanted surfaces are seen as they are.) The pairs that agree say how far each place is off by
errors of the poses, which are many pixels where recorded poses disagree, and of the depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from semdb.geometry import invert_pose, normalized_to_pixels, pixels_to_normalized
from semdb.localization.views import KeyframeView, View
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, ImageArray, IntArray

SMALL_WIDTH = 213  # pixels; what follows is in pixels of images of about this width: a third of the usual 640
WINDOW = 11  # side of what is compared
ABOUT = 8.0  # windows farther than this from every inlier say nothing of the pose: things may have moved
REACH = 1.0  # the query may show it so far beside, in each direction
BLUR = 0.7  # of both images: the noise of a sensor is not what they show
DEPTH_BLUR = 4.0  # sigma within which keypoints tell the depth of a pixel
LEAST_DEPTH_WEIGHT = 1e-3
OFFSET_BLUR = 6.0  # sigma within which inliers tell how far a place is off
OFFSET_FLOOR = 1e-4  # weight of the median offset beside theirs
MOST_OFFSET = 6.0  # more is no error of poses
LEAST_OFFSETS = 5
LEAST_CONTRAST = 10.0  # variance of a window, in grey values squared: less shows nothing
ALIKE = 0.9  # correlation
LEAST_WINDOWS = 40  # fewer say nothing
ALIKE_BY_DEPTH = 0.7  # correlation, where depth is measured: of what is there nearly all is above, of copies much below
MOST_STEP = 0.2  # of the inverse depth, within a window
LEAST_DEPTH_M = 0.05
LEAST_KNOWN, LEAST_ABOUT = 0.5, 0.1  # shares of a small pixel, and of what is about it, that have depth
HOLE_BLUR = 2.0


def likeness_about(
    query: View, keyframe: KeyframeView, world_from_camera: FloatArray, rows: IntArray, keypoints: IntArray
) -> float | None:
    """Of the windows of the keyframe about its inliers, the share (0..1) that look alike in the query.

    The inliers are pairs of the query's keypoint ``rows[n]`` with the keyframe's ``keypoints[n]``, which agree with
    `world_from_camera` ``[4, 4]``. Alike is a correlation of 0.9 within a pixel of the small images.
    None where an image is not at hand, or too little can be compared.
    """
    if query.grey is None or keyframe.view.grey is None or not len(rows):
        return None
    grid = _grid(keyframe.view.camera)
    inliers, seen = keyframe.view.seen_xy[keypoints], query.seen_xy[rows]
    inverse = _inverse_depth(keyframe.view, grid)
    x, y, known = _places(query.camera, keyframe.world_from_camera, world_from_camera, inverse, grid)
    off_x, off_y = _offsets(x, y, grid, inliers, _grid(query.camera).small(seen))
    x, y = x + off_x, y + off_y
    own, other = _small(keyframe.view.grey, grid.shape), _small(query.grey, _grid(query.camera).shape)
    compared = _whole_windows(known & (x >= 1) & (y >= 1) & (x < other.shape[1] - 2) & (y < other.shape[0] - 2))
    compared &= _near(grid.cells_of(inliers), grid.shape)
    best, _ = _correlations(own, other, x, y, compared)
    return None if len(best) < LEAST_WINDOWS else float(np.mean(best > ALIKE))


def small_inverse_depth(camera: Camera, depth: Float32Array) -> Float32Array:
    """One over `depth` ``[H, W]`` (m, NaN or 0 where missing) at the pixels ``[h, w]`` of the small image; else NaN.

    Small holes are filled from what is about them.
    """
    shape = _grid(camera).shape
    with np.errstate(divide="ignore", invalid="ignore"):
        known = np.isfinite(depth) & (depth > LEAST_DEPTH_M)
        inverse = np.where(known, 1 / depth, 0).astype(np.float32)
    parts = [
        cv2.resize(part, shape[::-1], interpolation=cv2.INTER_AREA) for part in (inverse, known.astype(np.float32))
    ]
    about = [cv2.GaussianBlur(part, (0, 0), HOLE_BLUR) for part in parts]
    filled = np.where(about[1] > LEAST_ABOUT, about[0] / np.maximum(about[1], LEAST_ABOUT), np.float32(np.nan))
    found = np.where(parts[1] > LEAST_KNOWN, parts[0] / np.maximum(parts[1], LEAST_KNOWN), filled)
    return np.asarray(found, np.float32)


def likeness_by_depth(
    query: View, keyframe: KeyframeView, world_from_camera: FloatArray, seen: Float32Array, inliers: Float32Array
) -> tuple[float, float] | None:
    """The shares (0..1) that look alike of what is about inliers, and of all that the query should see.

    As `likeness_about`, with measured depth: `keyframe` has its `inverse_depth`. So that places are known wherever the
    depth is smooth, windows on edges of depth are left out, and alike is a correlation of 0.7. Inliers are pixels
    ``seen[n]`` of the query and ``inliers[n]`` of the keyframe. None as there, and where there is no depth.
    """
    inverse = keyframe.view.inverse_depth
    if query.grey is None or keyframe.view.grey is None or inverse is None or not len(seen):
        return None
    grid = _grid(keyframe.view.camera)
    x, y, known = _places(query.camera, keyframe.world_from_camera, world_from_camera, inverse, grid)
    off_x, off_y = _offsets(x, y, grid, inliers, _grid(query.camera).small(seen))
    x, y = x + off_x, y + off_y
    own, other = _small(keyframe.view.grey, grid.shape), _small(query.grey, _grid(query.camera).shape)
    compared = _whole_windows(known & (x >= 1) & (y >= 1) & (x < other.shape[1] - 2) & (y < other.shape[0] - 2))
    best, at = _correlations(own, other, x, y, compared & _is_smooth(inverse))
    about = _near(grid.cells_of(inliers), grid.shape).ravel()[at]
    if np.count_nonzero(about) < LEAST_WINDOWS:
        return None
    return float(np.mean(best[about] > ALIKE_BY_DEPTH)), float(np.mean(best > ALIKE_BY_DEPTH))


def _is_smooth(inverse: Float32Array) -> BoolArray:
    """Of which pixels the window lies on no edge of depth."""
    side, known = np.ones((WINDOW, WINDOW), np.uint8), np.nan_to_num(inverse)
    step = cv2.dilate(known, side) - cv2.erode(known, side)
    return np.asarray(step < MOST_STEP * np.maximum(known, LEAST_ABOUT))


def _correlations(
    own: Float32Array, other: Float32Array, x: Float32Array, y: Float32Array, compared: BoolArray
) -> tuple[Float32Array, IntArray]:
    """The best correlation ``[n]`` of each window of `own` that is `compared` and shows something, and where it is.

    `x`, `y` ``[h, w]`` are its places in `other`.
    """
    mean, variance = _moments(own)
    at = np.flatnonzero(compared & (variance > LEAST_CONTRAST)).astype(np.int32)
    mean, variance, best = mean.take(at), variance.take(at), np.full(len(at), -1.0, np.float32)
    if len(at) < LEAST_WINDOWS:
        return best, at
    for dy in (-REACH, 0.0, REACH):
        for dx in (-REACH, 0.0, REACH):
            seen = np.asarray(
                cv2.remap(other, x + dx, y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
            )
            its_mean, its_square, product = (_box(v).take(at) for v in (seen, seen * seen, own * seen))
            variances = variance * (its_square - its_mean * its_mean)
            correlation = (product - mean * its_mean) / np.sqrt(np.maximum(variances, 1e-2))
            np.maximum(best, correlation, out=best)
    return best, at


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """The pixels of a small image: `shape` (h, w), and the rays ``[h * w, 3]`` that they see, z = 1."""

    shape: tuple[int, int]
    size_of_pixel: FloatArray  # [2] x, y, in pixels of the camera's image
    rays: Float32Array

    def small(self, pixels: FloatArray | Float32Array) -> FloatArray:
        """Where in the small image `pixels` ``[n, 2]`` of the camera's are."""
        return np.asarray((pixels + 0.5) / self.size_of_pixel - 0.5, np.float64)

    def cells_of(self, pixels: Float32Array) -> tuple[IntArray, IntArray]:
        """Columns and rows ``[n]`` of the small image that hold `pixels` ``[n, 2]`` of the camera's."""
        cells = np.clip(np.rint(self.small(pixels)).astype(np.int32), 0, [self.shape[1] - 1, self.shape[0] - 1])
        return cells[:, 0], cells[:, 1]


@lru_cache(maxsize=8)
def _grid(camera: Camera) -> _Grid:
    """Of a camera's image, made as small as `SMALL_WIDTH` says; small images stay as they are."""
    scale = max(1, round(camera.width / SMALL_WIDTH))
    width, height = max(camera.width // scale, 1), max(camera.height // scale, 1)
    size = np.array([camera.width / width, camera.height / height])
    row, column = np.mgrid[:height, :width]
    pixels = (np.stack([column.ravel(), row.ravel()], axis=1) + 0.5) * size - 0.5
    rays = np.column_stack([pixels_to_normalized(camera, pixels), np.ones(len(pixels))])
    return _Grid((height, width), size, rays.astype(np.float32))


def _small(image: ImageArray, shape: tuple[int, int]) -> Float32Array:
    small = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), BLUR), np.float32)


def _places(
    camera: Camera, of_keyframe: FloatArray, world_from_camera: FloatArray, inverse: Float32Array, grid: _Grid
) -> tuple[Float32Array, Float32Array, BoolArray]:
    """Where the query's small image shows each pixel of the keyframe's: x, y ``[h, w]``, and whether that is known.

    `inverse` ``[h, w]`` is one over its depth, `of_keyframe` ``[4, 4]`` the keyframe's pose.
    """
    query_from_keyframe = (invert_pose(world_from_camera) @ of_keyframe).astype(np.float32)
    # points times their inverse depth: projections are the same
    seen = grid.rays @ query_from_keyframe[:3, :3].T
    seen += inverse.reshape(-1, 1) * query_from_keyframe[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = normalized_to_pixels(camera, seen[:, :2] / seen[:, 2:])
    x, y = _grid(camera).small(pixels).astype(np.float32).T.reshape(2, *grid.shape)
    known = (seen[:, 2].reshape(grid.shape) > 0) & np.isfinite(x) & np.isfinite(y)
    return np.where(known, x, np.float32(-2)), np.where(known, y, np.float32(-2)), known


def _offsets(
    x: Float32Array, y: Float32Array, grid: _Grid, inliers: Float32Array, seen: FloatArray
) -> tuple[Float32Array, Float32Array]:
    """How far the places `x`, `y` ``[h, w]`` are off, smoothly from the `inliers` ``[n, 2]`` (pixels of the keyframe).

    `seen` ``[n, 2]`` is where the query's small image shows these.
    """
    at_x, at_y = grid.small(inliers).astype(np.float32).T[:, None]
    there = [cv2.remap(place, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0] for place in (x, y)]
    offset = seen - np.stack(there, axis=1)
    near = np.hypot(offset[:, 0], offset[:, 1]) < MOST_OFFSET
    if np.count_nonzero(near) < LEAST_OFFSETS:
        return np.zeros_like(x), np.zeros_like(y)
    columns, rows = grid.cells_of(inliers[near])
    weight = _spread(columns, rows, np.ones(len(columns)), grid.shape, OFFSET_BLUR) + OFFSET_FLOOR
    middle = np.median(offset[near], axis=0)
    sums = [_spread(columns, rows, offset[near, axis], grid.shape, OFFSET_BLUR) for axis in (0, 1)]
    along_x, along_y = ((sums[axis] + np.float32(OFFSET_FLOOR * middle[axis])) / weight for axis in (0, 1))
    return along_x, along_y


def _inverse_depth(view: View, grid: _Grid) -> Float32Array:
    """One over the depth of each pixel of the small image ``[h, w]``, smoothly from that of keypoints; else NaN."""
    columns, rows = grid.cells_of(view.seen_xy)
    weight = _spread(columns, rows, np.ones(len(columns)), grid.shape, DEPTH_BLUR)
    total = _spread(columns, rows, 1 / view.points[:, 2].astype(np.float64), grid.shape, DEPTH_BLUR)
    return np.where(weight > LEAST_DEPTH_WEIGHT, total / np.maximum(weight, LEAST_DEPTH_WEIGHT), np.float32(np.nan))


def _spread(
    columns: IntArray, rows: IntArray, values: FloatArray, shape: tuple[int, int], sigma: float
) -> Float32Array:
    """An image ``[h, w]`` of `values` ``[n]`` at their pixels, blurred."""
    cells = np.bincount(rows * shape[1] + columns, values, shape[0] * shape[1])
    return np.asarray(cv2.GaussianBlur(cells.astype(np.float32).reshape(shape), (0, 0), sigma), np.float32)


def _box(image: Float32Array) -> Float32Array:
    """The mean of the window about each pixel."""
    return np.asarray(cv2.boxFilter(image, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT), np.float32)


def _moments(image: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Mean and variance of the window about each pixel."""
    mean = _box(image)
    return mean, _box(image * image) - mean * mean


def _whole_windows(known: BoolArray) -> BoolArray:
    """Of which pixels all of the window is known."""
    side = np.ones((WINDOW, WINDOW), np.uint8)
    whole = cv2.erode(known.astype(np.uint8), side, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(whole, np.uint8) > 0


def _near(cells: tuple[IntArray, IntArray], shape: tuple[int, int]) -> BoolArray:
    """Which pixels are within `ABOUT` of one of `cells` (columns, rows)."""
    elsewhere = np.ones(shape, np.uint8)
    elsewhere[cells[1], cells[0]] = 0
    return np.asarray(cv2.distanceTransform(elsewhere, cv2.DIST_L2, 3), np.float32) < ABOUT
