"""Which object a keypoint lies on, and where an object is in space."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from semdb.geometry import back_project
from semdb.types import BoolArray, Camera, Detection, Features, Float32Array, IntArray, ObjectGeometry

_MAX_POINTS = 1000  # per object: percentiles of more are no better and cost time
_BORDER = 2  # pixels at the rim of a mask whose depth is often that of the background
_MIN_POINTS = 10


def assign_to_objects(xy: Float32Array, masks: Sequence[BoolArray]) -> IntArray:
    """The ordinal of the mask that each pixel position `xy` ``[n, 2]`` lies in, -1 in none, int32 ``[n]``.

    Where masks overlap the smallest wins (a cup on a table belongs to the cup), of equal ones the first.
    Positions are rounded to the nearest pixel and clipped to the image.
    """
    owner = np.full(len(xy), -1, dtype=np.int32)
    if not masks or not len(xy):
        return owner
    height, width = masks[0].shape
    u = np.clip(np.rint(xy[:, 0]), 0, width - 1).astype(np.intp)
    v = np.clip(np.rint(xy[:, 1]), 0, height - 1).astype(np.intp)
    areas = [int(np.count_nonzero(mask)) for mask in masks]
    for ordinal in sorted(range(len(masks)), key=lambda k: (-areas[k], -k)):
        owner[masks[ordinal][v, u]] = ordinal
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
    camera: Camera, depth: Float32Array | None, detection: Detection, depth_gap: float = 0.0
) -> ObjectGeometry:
    """Where the object of `detection` is, from `depth` ``[H, W]`` metres under its mask less the mask's rim.

    The centroid is the median of the points and the extent goes from their 5th to their 95th percentile, so a
    mask that takes in some background does little harm; with a `depth_gap` the background goes first
    (`at_one_depth`). NaN with fewer than 10 points with depth.
    """
    area = int(np.count_nonzero(detection.mask))
    nowhere = ObjectGeometry(area, np.full(3, np.nan), np.full(3, np.nan))
    if depth is None or area == 0:
        return nowhere
    x, y, w, h = cv2.boundingRect(detection.mask.view(np.uint8))
    part = depth[y : y + h, x : x + w]
    inside = np.ascontiguousarray(detection.mask[y : y + h, x : x + w])
    if depth_gap > 0:
        inside = np.ascontiguousarray(at_one_depth(inside, part, depth_gap))
    kernel = np.ones((2 * _BORDER + 1, 2 * _BORDER + 1), dtype=np.uint8)
    eroded = cv2.erode(inside.view(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0).view(np.bool_)
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(part) & (part > 0)
    chosen = eroded & usable
    if np.count_nonzero(chosen) < _MIN_POINTS:  # a thin object has nothing but rim
        chosen = inside & usable
    v, u = np.nonzero(chosen)
    if len(u) < _MIN_POINTS:
        return nowhere
    if len(u) > _MAX_POINTS:  # evenly, but with no whole step that would fall in with the width of the mask
        rows = np.linspace(0, len(u) - 1, _MAX_POINTS).astype(np.intp)
        v, u = v[rows], u[rows]
    points = back_project(camera, np.column_stack([u + x, v + y]), part[v, u])
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _MIN_POINTS:
        return nowhere
    low, middle, high = np.percentile(points, [5, 50, 95], axis=0)
    return ObjectGeometry(area, middle, high - low)


def at_one_depth(mask: BoolArray, depth: Float32Array, gap: float) -> BoolArray:
    """`mask` ``[H, W]`` without pixels much before or behind its largest part without a jump of `depth` (metres).

    Much is the share `gap`. Pixels without depth stay: nothing speaks against them; so does a mask with little depth
    as a whole.
    """
    with np.errstate(invalid="ignore"):
        known = mask & np.isfinite(depth) & (depth > 0)
    if np.count_nonzero(known) < 0.2 * np.count_nonzero(mask):
        return mask
    log = np.log(np.where(known, depth, 1.0)).astype(np.float32)
    smooth = known & ~_jumps(log, known)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(smooth.view(np.uint8), connectivity=4)
    if count < 2:
        return mask
    main = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    low, high = np.percentile(log[labels == main], [2, 98])
    far = known & ((log < low - gap) | (log > high + gap))
    result: BoolArray = mask & ~far
    return result


def _jumps(log: Float32Array, known: BoolArray) -> npt.NDArray[np.bool_]:
    """Pixels whose right or lower neighbour is nearer or farther by more than 5 percent."""
    jumps = np.zeros(known.shape, dtype=np.bool_)
    across = known[:, 1:] & known[:, :-1] & (np.abs(np.diff(log, axis=1)) > 0.05)
    down = known[1:] & known[:-1] & (np.abs(np.diff(log, axis=0)) > 0.05)
    jumps[:, :-1] |= across
    jumps[:-1] |= down
    return jumps
