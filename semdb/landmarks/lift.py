"""Masks and depth of one keyframe to sightings: points in the map, and a small picture of who stands where."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from semdb.geometry import pixels_to_normalized
from semdb.geometry.sensor import depth_noise
from semdb.landmarks.options import LiftOptions, SeeOptions
from semdb.perception.lifting import lift as lift_points
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, Int64Array

Labels = npt.NDArray[np.int16]
_MOST_LABELS = 32_000
EXACT = 0.25  # noise of less than this: depth is as good as exact
EXPLAINED = 4.0  # deviations of its noise by which a depth may lie off the plane around it


@dataclass(frozen=True, slots=True, eq=False)
class SeenObject:
    """An object of a keyframe as the detector gave it."""

    category: int  # number of the class
    score: float
    mask: BoolArray  # [H, W]


@dataclass(frozen=True, slots=True, eq=False)
class Grids:
    """What is large of a lifted keyframe."""

    outline: tuple[Float32Array, ...]  # of each sighting [j, 3] camera frame: all of the mask, its rim at inner depth
    depth: Float32Array  # [h, w] metres, 0 where unknown
    owner: Labels  # [h, w]


@dataclass(frozen=True, slots=True, eq=False)
class LiftedKeyframe:
    """What one keyframe says: its sightings, and its depth and masks reduced to a grid.

    A sighting is one mask, or several masks of one keyframe that are the same but for their names. Label 0 of the grid
    is the background, label k + 1 sighting k; where masks overlap the smallest one is seen. What is large is loaded
    when it is first asked for, where it is remembered.
    """

    camera: Camera
    world_from_camera: FloatArray  # [4, 4]
    sighting_of: Int64Array  # [objects] sighting of each object, by ordinal
    points: tuple[Float32Array, ...]  # of each sighting [k, 3] camera frame, away from edges; empty: it has no place
    areas: Int64Array  # [sightings] pixels
    beside: BoolArray  # [sightings, sightings] both seen, and apart: they are two things
    cut: BoolArray  # [sightings] touches the rim of the image
    grids: Callable[[], Grids]
    step: int  # pixels from one cell of the grid to the next; the first is at pixel ``step // 2``
    noise: float  # of its depth, as a multiple of `depth_noise`
    single: (
        FloatArray  # [sightings] share of the outline whose depth is that of one pixel, and of no plane through some
    )
    farthest: float  # metres: the largest depth of the grid; what lies beyond is hidden
    apart: float = 0.0  # metres, a deviation: how far its surfaces lie off those of its neighbours
    name: str = ""  # of all that it was made from, but for its pose (see `memo`)
    key: str = ""  # of that, the pose and `apart`

    @property
    def outline(self) -> tuple[Float32Array, ...]:
        """As `Grids.outline`."""
        return self.grids().outline

    @property
    def grid_depth(self) -> Float32Array:
        """As `Grids.depth`."""
        return self.grids().depth

    @property
    def grid_owner(self) -> Labels:
        """As `Grids.owner`."""
        return self.grids().owner


def lift_keyframe(
    camera: Camera,
    world_from_camera: FloatArray,
    depth: Float32Array | None,
    objects: Sequence[SeenObject],
    lift: LiftOptions | None = None,
    see: SeeOptions | None = None,
) -> LiftedKeyframe:
    """Lifts the `objects` of one keyframe, by ordinal; `depth` ``[H, W]`` metres, not finite or not positive: none.

    Without depth nothing has a place.
    """
    from semdb.landmarks.kernels import inner_pixels, joined_pixels, rim_pixels

    lift, see = lift or LiftOptions(), see or SeeOptions()
    shape = (camera.height, camera.width)
    known = np.zeros(shape, np.float32) if depth is None else np.where(np.isfinite(depth) & (depth > 0), depth, 0)
    known = np.ascontiguousarray(known, np.float32)
    sighting_of, first = same_masks([thing.mask for thing in objects[:_MOST_LABELS]], lift.same_mask)
    masks = [objects[k].mask for k in first]
    areas = np.array([np.count_nonzero(mask) for mask in masks], np.int64)
    owner = np.zeros(shape, np.int16)
    for k in sorted(range(len(masks)), key=lambda k: (-areas[k], -k)):
        owner[masks[k]] = k + 1
    buffers = (np.empty(owner.size, np.int64), np.empty(owner.size, np.int64), np.empty(owner.size, np.float32))
    state = np.zeros(owner.size, np.uint8)
    noise = measured_noise(camera, known)
    points, outline, cut = [], [], np.zeros(len(masks), np.bool_)
    single = np.ones(len(masks))
    for k, mask in enumerate(masks):
        box = bounds(mask)
        cut[k] = box[0] <= 1 or box[1] <= 1 or box[2] >= shape[1] - 1 or box[3] >= shape[0] - 1
        border = lift.border if areas[k] >= lift.thin_area else lift.thin_border
        limits = (lift.jump_m, lift.jump_share)
        number: int = inner_pixels(known, owner, k + 1, border, *limits, box, buffers[0])
        while border > 0 and number < 4 * lift.fewest:
            border -= 1
            number = inner_pixels(known, owner, k + 1, border, *limits, box, buffers[0])
        if number < lift.fewest:
            points.append(np.empty((0, 3), np.float32))
            outline.append(np.empty((0, 3), np.float32))
            continue
        inner = buffers[0][:number]
        inner = inner[at_one_depth(known.ravel()[inner], lift)]
        number, values = len(inner), known.ravel()[inner]
        points.append(_points(camera, inner, values, lift.samples)[0])
        if noise < EXACT:  # edges of its depth are those of things: surfaces are followed to the last pixel
            number = joined_pixels(known, owner, k + 1, inner, number, *limits, buffers[1])
            inner = np.sort(buffers[1][:number])
            values = known.ravel()[inner]
        rest = rim_pixels(known, owner, k + 1, border + 2, inner, number, box, state, buffers[1], buffers[2])
        seen = (slice(box[1], box[3]), slice(box[0], box[2]))
        own = (np.where(owner[seen] == k + 1, known[seen], np.float32(np.nan)), int(box[0]), int(box[1]))
        edge, fitted = _points(camera, buffers[1][:rest], buffers[2][:rest], lift.outline // 2, own, noise)
        body, fitted_too = _points(camera, inner, values, lift.outline // 2, own, noise)
        outline.append(np.concatenate([body, edge]))
        planes = np.concatenate([fitted, fitted_too])
        if len(planes):  # a mask may lie where the lens model says nothing
            single[k] = 1 - np.mean(planes)
    step = max(1, shape[1] // see.grid)
    half = step // 2
    cells = (slice(half, None, step), slice(half, None, step))
    grids = Grids(tuple(outline), np.ascontiguousarray(known[cells]), np.ascontiguousarray(owner[cells]))
    return LiftedKeyframe(
        camera=camera,
        world_from_camera=np.asarray(world_from_camera, np.float64),
        sighting_of=sighting_of,
        points=tuple(points),
        areas=areas,
        beside=apart(masks, areas),
        cut=cut,
        grids=lambda: grids,
        step=step,
        noise=noise,
        single=single,
        farthest=float(grids.depth.max(initial=0.0)),
    )


def measured_noise(camera: Camera, depth: Float32Array, apart: int = 24) -> float:
    """How far `depth` ``[H, W]`` (metres, 0 unknown) scatters about the planes through it, in units of `depth_noise`.

    The median over a grid of pixels `apart` pixels from each other, 0 (depth without noise) to 2.
    """
    v, u = (
        values.ravel() for values in np.mgrid[apart // 2 : camera.height : apart, apart // 2 : camera.width : apart]
    )
    z = depth[v, u].astype(np.float64)
    fitted = lift_points(camera, depth, np.column_stack([u, v]).astype(np.float32))[:, 2]
    good = (z > 0) & np.isfinite(fitted)
    if np.count_nonzero(good) < 30:
        return 1.0
    off = np.abs(fitted[good] - z[good]) / depth_noise(z[good])
    # half of the values of a normal distribution lie within 0.6745 of its deviation
    return float(np.clip(np.median(off) / 0.6745, 0.0, 2.0))


def at_one_depth(depth: Float32Array, lift: LiftOptions) -> BoolArray:
    """Which of the pixels of a mask are the thing's, by their depth ``[n]``: bool ``[n]``.

    A mask takes in what is seen through a chair's back, or beside it. Depths with a gap between them are of several
    things: the one with most pixels stays, and those that are about as large.
    """
    order = np.argsort(depth, kind="stable")
    ranked = depth[order]
    gaps = np.diff(ranked) > lift.gap_m + lift.gap_share * ranked[:-1]
    group = np.concatenate([[0], np.cumsum(gaps)])
    counts = np.bincount(group)
    kept = np.zeros(len(depth), np.bool_)
    kept[order] = (counts >= lift.gap_kept * counts.max())[group]
    return kept


def _points(
    camera: Camera,
    pixels: Int64Array,
    inner: Float32Array,
    most: int,
    own: tuple[Float32Array, int, int] | None = None,
    noise: float = 1.0,
) -> tuple[Float32Array, BoolArray]:
    """Camera-frame points ``[k, 3]`` of flat `pixels` ``[n]``, at most `most`, evenly taken, and which lie on planes.

    Their depth is that of an inner pixel nearby, `inner` ``[n]``; or, with `own`, depth ``[h, w]`` about the mask, NaN
    outside of it, and its first column and row, their own, where that is as near as the thing is wide, or that of a
    plane fitted to the mask's pixels around, where `noise` (see `measured_noise`) explains the difference: what is
    measured well enough has edges.
    """
    wanted = min(len(pixels), most)
    taken = (np.arange(wanted) * len(pixels) + len(pixels) // 2) // max(wanted, 1)
    v, u = np.divmod(pixels[taken], camera.width)
    z = inner[taken].astype(np.float64)
    fitted = np.zeros(wanted, np.bool_)
    if own is not None and wanted:
        depth, left, top = own
        measured = depth[v - top, u - left].astype(np.float64)
        reach = 0.05 + max(np.ptp(u) / camera.fx, np.ptp(v) / camera.fy) * np.median(z)
        z = np.where((measured > 0) & (np.abs(measured - z) < reach), measured, z)
        part = replace(camera, cx=camera.cx - left, cy=camera.cy - top)
        plane = lift_points(part, depth, np.column_stack([u - left, v - top]).astype(np.float32))[:, 2]
        fitted = np.isfinite(plane) & (np.abs(plane - z) < EXPLAINED * noise * depth_noise(z))
        z = np.where(fitted, plane, z)
    rays = pixels_to_normalized(camera, np.column_stack([u, v]))
    found = np.column_stack([rays * z[:, None], z])
    good = np.isfinite(found).all(axis=1)
    return found[good].astype(np.float32), fitted[good]


def bounds(mask: BoolArray) -> Int64Array:
    """u0, v0, u1, v1 (ends beyond) of a mask; zeros of an empty one."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return np.zeros(4, np.int64)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.int64)


def same_masks(masks: Sequence[BoolArray], least: float) -> tuple[Int64Array, list[int]]:
    """The sighting of each mask, int64 ``[n]``, and the first mask of each sighting.

    Masks whose intersection over union is at least `least` are one sighting.
    """
    boxes = [bounds(mask) for mask in masks]
    areas = [int(np.count_nonzero(mask)) for mask in masks]
    first: list[int] = []
    sighting = np.zeros(len(masks), np.int64)
    for k in range(len(masks)):
        for number, other in enumerate(first):
            if min(areas[k], areas[other]) < least * max(areas[k], areas[other]):
                continue
            both = _common(masks[k], masks[other], boxes[k], boxes[other])
            if both > 0 and both >= least * (areas[k] + areas[other] - both):
                sighting[k] = number
                break
        else:
            sighting[k] = len(first)
            first.append(k)
    return sighting, first


def apart(masks: Sequence[BoolArray], areas: Int64Array, most: float = 0.1) -> BoolArray:
    """Which masks of one keyframe do not overlap by more than the share `most` of the smaller: bool ``[n, n]``."""
    boxes = [bounds(mask) for mask in masks]
    found = ~np.eye(len(masks), dtype=np.bool_)
    for a in range(len(masks)):
        for b in range(a):
            both = _common(masks[a], masks[b], boxes[a], boxes[b])
            found[a, b] = found[b, a] = both <= most * min(areas[a], areas[b])
    return found


def _common(one: BoolArray, other: BoolArray, a: Int64Array, b: Int64Array) -> int:
    u0, v0, u1, v1 = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    if u0 >= u1 or v0 >= v1:
        return 0
    return int(np.count_nonzero(one[v0:v1, u0:u1] & other[v0:v1, u0:u1]))
