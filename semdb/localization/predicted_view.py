"""What a query should show at a pose, from images and depth of keyframes, and how far it does.

Keypoints and edges agree at a place and at one like it. What is different there - a plate with a name, where a door
stands - is a small part of the image, and everything else agrees in both. So what keyframes show is looked at from the
pose (Taira et al., InLoc, CVPR 2018), and poses are compared where they predict different things.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semdb.geometry import invert_pose, pose_distances, transform_points
from semdb.localization.edges import without_distortion
from semdb.perception.quality import motion_kernel
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, ImageArray

ACROSS = 213  # pixels
BLUR = 0.7  # of both: the noise of a sensor is not what they show
WINDOW = 11
REACH = (-1, 0, 1)  # pixels that a window may lie beside, in each direction
LEAST_CONTRAST = 10.0  # variance of a window, in grey values squared, of either image; less of one of little contrast
WHOLE = (0.0, 255.0)
ALIKE = 0.7
MOST_GAIN = 8.0
LEAST_GAINED = 100  # windows of one shape, by which it is told
LEAST_WINDOWS = 150
SAMPLED = 12  # pixels from one point of a keyframe, by which it is chosen, to the next
LEAST_M = 0.1
USUAL_DISTANCE = 3.0  # of `pose_distances`: what is seen from farther away or more aslant is known less well


@dataclass(frozen=True, slots=True, eq=False)
class SmallView:
    """An image without distortion: `intrinsics` fx, fy, cx, cy; `depth` metres, NaN where unknown, None without any."""

    intrinsics: FloatArray
    grey: Float32Array  # [h, w]
    depth: Float32Array | None  # [h, w]
    samples: FloatArray  # [n, 3] some of its points, camera frame
    span: tuple[float, float] = WHOLE  # grey values; what is darker or brighter is not told apart
    blur: tuple[float, float] | None = None  # pixels and degrees, where motion has blurred it


@dataclass(frozen=True, slots=True, eq=False)
class PlacedView:
    """That of a keyframe, in the world."""

    keyframe_id: int
    world_from_camera: FloatArray
    view: SmallView


def small_view(
    camera: Camera,
    grey: ImageArray,
    depth: Float32Array | None = None,
    stretch: tuple[float, float] | None = None,
    blur: tuple[float, float] | None = None,
) -> SmallView:
    """Of an image ``[H, W]`` with `depth` ``[H, W]`` metres, as it was seen before its contrast was stretched so.

    `blur`: length (pixels) and direction (degrees) of the motion that has blurred the image.
    """
    low, high = span = stretch or WHOLE
    seen, small = without_distortion(camera, grey.astype(np.float32), cv2.INTER_LINEAR, ACROSS)
    if stretch is not None:
        small = np.asarray(low + small * ((high - low) / 255), np.float32)
    small = np.asarray(cv2.GaussianBlur(small, (0, 0), BLUR), np.float32)
    if depth is not None:
        _, depth = without_distortion(camera, depth, cv2.INTER_NEAREST, ACROSS)
    if blur is not None:
        blur = blur[0] * small.shape[1] / grey.shape[1], blur[1]
    return SmallView(np.array([seen.fx, seen.fy, seen.cx, seen.cy]), small, depth, _samples(seen, depth), span, blur)


def _samples(camera: Camera, depth: Float32Array | None) -> FloatArray:
    """Points ``[n, 3]`` of every so many pixels that have a depth."""
    if depth is None:
        return np.zeros((0, 3))
    v, u = np.mgrid[SAMPLED // 2 : depth.shape[0] : SAMPLED, SAMPLED // 2 : depth.shape[1] : SAMPLED]
    z = depth[v, u].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    return np.asarray(points[z > 0])


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """How like each window ``[h, w]`` of a query is to what was predicted (-1 to 1), and which can be compared."""

    likeness: Float32Array
    compared: BoolArray  # known, and something is to be seen in either
    known: float  # share of the image of which anything is known

    @property
    def alike(self) -> float:
        """Share of what can be compared that looks alike; 0 where that is too little."""
        count = np.count_nonzero(self.compared)
        return float(np.count_nonzero(self.likeness[self.compared] > ALIKE) / count) if count > LEAST_WINDOWS else 0.0


def best_seen(keyframes: Sequence[PlacedView], pose: FloatArray, query: SmallView, count: int) -> list[PlacedView]:
    """The `count` of `keyframes` that show most of what `query` sees from `pose` ``[4, 4]``, the most first."""
    camera_from_world, shares = invert_pose(pose), []
    fx, fy, cx, cy = query.intrinsics
    height, width = query.grey.shape
    for keyframe in keyframes:
        points = transform_points(camera_from_world @ keyframe.world_from_camera, keyframe.view.samples)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy
            far = keyframe.view.samples[:, 2] / points[:, 2]  # seen from farther away a keyframe shows less of it
        inside = (points[:, 2] > LEAST_M) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        share = float((np.minimum(1.0, 1 / np.maximum(far[inside], 1e-3))).sum()) / max(len(points), 1)
        away = float(pose_distances(pose, keyframe.world_from_camera[None])[0])
        shares.append(share / (1 + (away / USUAL_DISTANCE) ** 2))
    order = sorted(range(len(keyframes)), key=lambda n: -shares[n])
    return [keyframes[n] for n in order[:count] if shares[n] > 0]


def compare_view(
    query: SmallView, pose: FloatArray, keyframes: Sequence[PlacedView], reach: Sequence[int] = REACH
) -> Windows:
    """How the query looks like what `keyframes` show from `pose` ``[4, 4]``, the best of them for each window.

    They are the best first. A window may lie aside by as many pixels as `reach` names, in each direction.
    """
    from semdb.localization.view_kernels import fill, sample, splat

    height, width = query.grey.shape
    nearest, filled = np.full((2, height, width), np.inf, np.float32)
    with_depth = [(keyframe, keyframe.view.depth) for keyframe in keyframes if keyframe.view.depth is not None]
    for keyframe, depth in with_depth:  # the best first: one that is far off knows it less exactly
        own = np.full((height, width), np.inf, np.float32)
        splat(depth, keyframe.view.intrinsics, keyframe.world_from_camera, query.intrinsics, pose, own)
        fill(own, filled)
        np.copyto(nearest, filled, where=np.isinf(nearest))
    best = np.full((height, width), -2.0, np.float32)
    compared = np.zeros((height, width), np.bool_)
    known = np.zeros((height, width), np.bool_)
    mean, variance = _moments(query.grey)
    least = LEAST_CONTRAST * (query.span[1] - query.span[0]) / 255  # its noise has been made little, too
    seen = np.empty((height, width), np.float32)
    for keyframe, depth in with_depth:
        place = keyframe.view
        sample(
            nearest, query.intrinsics, pose, place.grey, depth, place.intrinsics, keyframe.world_from_camera, seen
        )  # fmt: skip
        there = np.isfinite(seen)
        known |= there
        whole = cv2.erode(there.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8), borderValue=0) > 0
        if not whole.any():
            continue
        shown = np.where(there, seen, np.float32(0))
        if query.blur is not None:
            shown = _blurred(shown, there, query.blur)
        shown = np.clip(shown, *_span_of(shown[there], query.span))
        like, contrast = _likeness(query.grey, mean, variance, shown, whole, least, reach)
        whole &= contrast
        np.maximum(best, like, out=best, where=whole)
        compared |= whole
    return Windows(best, compared, float(known.mean()))


def _blurred(shown: Float32Array, there: BoolArray, blur: tuple[float, float]) -> Float32Array:
    """What is `there` of an image ``[h, w]``, blurred as motion has blurred another one; the rest is 0."""
    kernel = motion_kernel(*blur)
    weight = cv2.filter2D(there.astype(np.float32), -1, kernel, borderType=cv2.BORDER_CONSTANT)
    smeared = cv2.filter2D(shown, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.where(there, smeared / np.maximum(weight, np.float32(1e-3)), np.float32(0)).astype(np.float32)


def _span_of(shown: Float32Array, span: tuple[float, float]) -> tuple[float, float]:
    """Where grey values end that a keyframe has `shown`: as those of an image of `span`, but for one of other light."""
    if span == WHOLE:
        return span
    low, high = np.percentile(shown, (1, 99))  # of an image whose contrast is stretched as much lies beyond its span
    return min(span[0], float(low)), max(span[1], float(high))


def _likeness(
    grey: Float32Array,
    mean: Float32Array,
    variance: Float32Array,
    predicted: Float32Array,
    whole: BoolArray,
    least: float,
    reach: Sequence[int],
) -> tuple[Float32Array, BoolArray]:
    """The greatest likeness of windows of two images ``[h, w]``, one moved a pixel at most, and where either shows any.

    It is twice the covariance over the sum of variances: contrast that one has and the other has not counts too, once
    they are of one exposure.
    """
    its_mean, its_variance = _moments(predicted)
    gain = _gain(_box(grey * predicted) - mean * its_mean, variance, its_variance, whole, least)
    its_variance = gain * gain * its_variance
    total = variance + its_variance
    best = np.full(grey.shape, -1.0, np.float32)
    for dy in reach:
        for dx in reach:
            moved = np.roll(grey, (dy, dx), axis=(0, 1))
            m, v = np.roll(mean, (dy, dx), axis=(0, 1)), np.roll(variance, (dy, dx), axis=(0, 1))
            both = gain * (_box(moved * predicted) - m * its_mean)
            np.maximum(best, 2 * both / np.maximum(v + its_variance, 1e-2), out=best)
    return best, total > 2 * least


def _gain(
    both: Float32Array, variance: Float32Array, its_variance: Float32Array, whole: BoolArray, least: float
) -> np.float32:
    """By how much an image is brighter than what is predicted: the median of `whole` windows of one shape in both.

    `both` is their covariance. 1 where hardly any is, as at a wrong pose.
    """
    shape = whole & (variance + its_variance > 2 * least)
    shape &= both > ALIKE * np.sqrt(np.maximum(variance * its_variance, 1e-4))
    if np.count_nonzero(shape) < LEAST_GAINED:
        return np.float32(1)
    ratio = np.median(variance[shape] / np.maximum(its_variance[shape], 1e-4))
    return np.float32(np.sqrt(np.clip(ratio, MOST_GAIN**-2, MOST_GAIN**2)))


def _box(image: Float32Array) -> Float32Array:
    return np.asarray(cv2.boxFilter(image, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT), np.float32)


def _moments(image: Float32Array) -> tuple[Float32Array, Float32Array]:
    mean = _box(image)
    return mean, _box(image * image) - mean * mean
