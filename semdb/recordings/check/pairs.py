"""Pairs of neighbouring frames: keypoints that match, where they are in both images and how far away in depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from semdb.geometry import pixels_to_normalized
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

KEYPOINTS = 600
RATIO = 0.8
EPIPOLAR_PX = 1.5  # of an image of WIDTH
WIDTH = 640  # of the image for which errors in pixels are given
LOOKED_AT = 400  # pixels of width to which images are made smaller: a third of the time, and still a pixel exact
MIN_MATCHES = 25


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Keypoints of one frame: pixels of its camera ``[n, 2]``, descriptors ``[n, d]``, depth at each (NaN unknown)."""

    index: int  # in the list of frames
    camera: Camera
    xy: FloatArray
    descriptors: Float32Array
    depth: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Matches between the frames `first` and `second`: undistorted normalised coordinates ``[n, 2]`` and depth ``[n]``.

    `focal` is that of the camera in pixels of an image of `WIDTH`, so that errors mean the same in all recordings.
    """

    first: int
    second: int
    xy_first: FloatArray
    xy_second: FloatArray
    depth_first: FloatArray  # metres as read, NaN unknown
    depth_second: FloatArray
    focal: float

    @property
    def flow_px(self) -> FloatArray:
        """How far the matches move, ``[n, 2]`` pixels of an image of `WIDTH`."""
        return np.asarray((self.xy_second - self.xy_first) * self.focal)

    def both_ways(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normalised coordinates there and here and the depth there, of both directions one after the other."""
        there = np.concatenate([self.xy_first, self.xy_second])
        here = np.concatenate([self.xy_second, self.xy_first])
        return there, here, np.concatenate([self.depth_first, self.depth_second])


def look(index: int, image: ImageArray, depth: Float32Array | None, camera: Camera) -> View:
    """Keypoints of an image ``[H, W, 3]``, with `depth` ``[H, W]`` metres at each."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    factor = min(1.0, LOOKED_AT / camera.width)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = _detector().detectAndCompute(grey, None)
    if descriptors is None:
        return View(index, camera, np.empty((0, 2)), np.empty((0, 128), np.float32), np.empty(0))
    xy = (np.array([keypoint.pt for keypoint in keypoints]) + 0.5) / factor - 0.5
    return View(index, camera, xy, np.asarray(descriptors, np.float32), _depth_at(depth, xy))


def match(first: View, second: View) -> Pair | None:
    """The matches of two views that some motion explains; None where there are too few."""
    if len(first.xy) < MIN_MATCHES or len(second.xy) < MIN_MATCHES:
        return None
    a, b = first.descriptors, second.descriptors
    distance = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1) - 2 * a @ b.T
    nearest = np.argpartition(distance, 1, axis=1)[:, :2]
    two = np.take_along_axis(distance, nearest, axis=1)
    order = np.argsort(two, axis=1)
    best = np.take_along_axis(nearest, order[:, :1], axis=1)[:, 0]
    two = np.take_along_axis(two, order, axis=1)
    back = distance.argmin(axis=0)
    good = (two[:, 0] < RATIO**2 * two[:, 1]) & (back[best] == np.arange(len(a)))
    i, j = np.nonzero(good)[0], best[good]
    if len(i) < MIN_MATCHES:
        return None
    scale = WIDTH / first.camera.width
    try:
        _, mask = cv2.findFundamentalMat(
            first.xy[i] * scale, second.xy[j] * scale, cv2.USAC_MAGSAC, EPIPOLAR_PX, 0.999, 2000
        )
    except cv2.error:  # OpenCV 5.0 asserts where it finds no model
        return None
    if mask is None or int(mask.sum()) < MIN_MATCHES:
        return None
    kept = mask.ravel() > 0
    i, j = i[kept], j[kept]
    xy_first = pixels_to_normalized(first.camera, first.xy[i])
    xy_second = pixels_to_normalized(second.camera, second.xy[j])
    known = np.isfinite(xy_first).all(axis=1) & np.isfinite(xy_second).all(axis=1)
    if known.sum() < MIN_MATCHES:
        return None
    focal = (first.camera.fx + first.camera.fy) / 2 * scale
    return Pair(
        first.index,
        second.index,
        xy_first[known],
        xy_second[known],
        first.depth[i][known],
        second.depth[j][known],
        focal,
    )


def _detector() -> Any:
    found: Any = cv2.SIFT.create(KEYPOINTS, contrastThreshold=0.02)
    return found


def _depth_at(depth: Float32Array | None, xy: FloatArray) -> FloatArray:
    if depth is None:
        return np.full(len(xy), np.nan)
    columns = np.clip(np.rint(xy[:, 0]).astype(int), 0, depth.shape[1] - 1)
    rows = np.clip(np.rint(xy[:, 1]).astype(int), 0, depth.shape[0] - 1)
    return np.asarray(depth[rows, columns], dtype=np.float64)
