"""Which object a keypoint lies on, and where an object is in space."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semdb.geometry import back_project
from semdb.perception._depth import count_labels, mark_known, of_label, smooth_surface, within
from semdb.perception._masks import Window, bounding_box
from semdb.types import BoolArray, Camera, Detection, Features, Float32Array, FloatArray, IntArray, ObjectGeometry

_MAX_POINTS = 1000  # per object: percentiles of more are no better and cost time
_BORDER = 2  # pixels at the rim of a mask whose depth is often that of the background
_MIN_POINTS = 10
_JUMP = 1.0513  # exp(0.05): a neighbour nearer or farther by this factor is another surface


def assign_to_objects(xy: Float32Array, masks: Sequence[BoolArray], areas: Sequence[int] | None = None) -> IntArray:
    """The ordinal of the mask that each pixel position `xy` ``[n, 2]`` lies in, -1 in none, int32 ``[n]``.

    Where masks overlap the smallest wins (a cup on a table belongs to the cup), of equal ones the first; `areas` are
    their numbers of pixels, where known.
    Positions are rounded to the nearest pixel and clipped to the image.
    """
    owner = np.full(len(xy), -1, dtype=np.int32)
    if not masks or not len(xy):
        return owner
    height, width = masks[0].shape
    u = np.clip(np.rint(xy[:, 0]), 0, width - 1).astype(np.intp)
    v = np.clip(np.rint(xy[:, 1]), 0, height - 1).astype(np.intp)
    pixels = v * width + u
    if areas is None:
        areas = [int(np.count_nonzero(mask)) for mask in masks]
    for ordinal in sorted(range(len(masks)), key=lambda k: (-areas[k], -k)):
        owner[masks[ordinal].take(pixels)] = ordinal
    return owner


def sort_by_object(features: Features, object_index: IntArray) -> tuple[Features, IntArray]:
    """`features` and their `object_index` with objects in ascending order and the background last, stable."""
    last = np.iinfo(np.int32).max
    order = np.argsort(np.where(object_index < 0, last, object_index), kind="stable")
    return take_features(features, order), object_index[order]


def take_features(features: Features, rows: npt.NDArray[np.intp]) -> Features:
    """The given `rows` of `features`, in that order."""
    return Features(
        xy=features.xy[rows],
        size=features.size[rows],
        angle=features.angle[rows],
        response=features.response[rows],
        laplacian=features.laplacian[rows],
        descriptors=features.descriptors[rows],
    )


def object_geometry(
    camera: Camera,
    depth: Float32Array | None,
    detection: Detection,
    depth_gap: float = 0.0,
    window: Window | None = None,
) -> ObjectGeometry:
    """Where the object of `detection` is, from `depth` ``[H, W]`` metres under its mask less the mask's rim.

    The centroid is the median of the points and the extent goes from their 5th to their 95th percentile, so a
    mask that takes in some background does little harm; with a `depth_gap` the background goes first
    (`at_one_depth`). NaN with fewer than 10 points with depth. `window` is about the mask's pixels, where known.
    """
    x, y, w, h = bounding_box(detection.mask) if window is None else window
    inside = np.ascontiguousarray(detection.mask[y : y + h, x : x + w])
    area = int(np.count_nonzero(inside))
    nowhere = ObjectGeometry(area, np.full(3, np.nan), np.full(3, np.nan))
    if depth is None or area == 0:
        return nowhere
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    if depth_gap > 0:
        inside = at_one_depth(inside, depth, depth_gap, (y, x))
    kernel = np.ones((2 * _BORDER + 1, 2 * _BORDER + 1), dtype=np.uint8)
    eroded = cv2.erode(inside.view(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0).view(np.bool_)
    places = _known_pixels(eroded, depth, y, x)
    if len(places) < _MIN_POINTS:  # a thin object has nothing but rim
        places = _known_pixels(inside, depth, y, x)
    if len(places) < _MIN_POINTS:
        return nowhere
    if len(places) > _MAX_POINTS:  # evenly, but with no whole step that would fall in with the width of the mask
        places = places[np.linspace(0, len(places) - 1, _MAX_POINTS).astype(np.intp)]
    pixels = np.empty((len(places), 2), dtype=np.intp)
    pixels[:, 0], pixels[:, 1] = places % w + x, places // w + y
    points = back_project(camera, pixels, depth[pixels[:, 1], pixels[:, 0]])
    finite = np.isfinite(points)
    if not finite.all():
        points = points[finite.all(axis=1)]
        if len(points) < _MIN_POINTS:
            return nowhere
    low, middle, high = _percentiles(points, (5, 50, 95))
    return ObjectGeometry(area, middle, high - low)


def _known_pixels(mask: BoolArray, depth: Float32Array, top: int, left: int) -> npt.NDArray[np.intp]:
    """The flat indexes, in `mask`, of its pixels with depth."""
    known = np.empty(mask.shape, dtype=np.bool_)
    mark_known(mask, depth, top, left, known)
    return np.flatnonzero(known)


def at_one_depth(mask: BoolArray, depth: Float32Array, gap: float, corner: tuple[int, int] = (0, 0)) -> BoolArray:
    """`mask` ``[h, w]`` without pixels much before or behind its largest part without a jump of `depth` (metres).

    `depth` ``[H, W]`` is float32; the mask begins at its row and column `corner`. Much is the share `gap`, in the
    logarithm. Pixels without depth stay: nothing speaks against them; so does a mask with little depth as a whole.
    """
    smooth = np.empty(mask.shape, dtype=np.uint8)
    known = smooth_surface(mask, depth, *corner, np.float32(_JUMP), smooth)
    if known < 0.2 * np.count_nonzero(mask):
        return mask
    count, labels = cv2.connectedComponents(smooth, connectivity=4)
    if count < 2:
        return mask
    areas = np.zeros(count, dtype=np.int64)
    count_labels(labels, areas)  # OpenCV's own statistics take three times as long as its labels
    main = 1 + int(np.argmax(areas[1:]))
    depths = np.empty(areas[main], dtype=np.float32)
    of_label(labels, depth, *corner, main, depths)
    low, high = _percentiles(depths, (2, 98))
    result = np.empty(mask.shape, dtype=np.bool_)
    within(mask, depth, *corner, np.float32(low * np.exp(-gap)), np.float32(high * np.exp(gap)), result)
    return result


def _percentiles(values: npt.NDArray[np.floating[Any]], percent: Sequence[float]) -> list[FloatArray]:
    """As ``np.percentile(values, percent, axis=0)``, float64, faster for so few numbers.

    NumPy sorts with vector instructions, which its partition about several ranks has not: the sort is no slower.
    """
    ordered = np.sort(values, axis=0)
    found = []
    for each in percent:
        rank = (len(values) - 1) * (each / 100)
        below = int(rank)
        above = min(below + 1, len(values) - 1)
        share = rank - below
        low, high = ordered[below].astype(np.float64), ordered[above].astype(np.float64)
        found.append(low + (high - low) * share if share < 0.5 else high - (high - low) * (1 - share))
    return found
