"""The points of a thing, from all its sightings, and the box about them."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree

from semdb.geometry import invert_pose, transform_points
from semdb.geometry.sensor import depth_noise
from semdb.landmarks.boxes import Box, upright_box
from semdb.landmarks.lift import EXACT, LiftedKeyframe
from semdb.landmarks.memo import Arrays, Memo, name_of, remembered
from semdb.landmarks.options import ShapeOptions
from semdb.types import FloatArray

POINTS, NOISE, BOX = "points", "noise", "box"  # kinds of what is remembered
MOST_VIEWS = 48  # that vote on the points of a thing


def thing_points(
    lifted: Sequence[LiftedKeyframe],
    members: Mapping[int, Sequence[int]],
    shape: ShapeOptions,
    memo: Memo | None = None,
) -> FloatArray:
    """Points ``[n, 3]`` (map) of a thing whose sightings are `members`: numbers of sightings by keyframe, ascending.

    A point stays when enough of the keyframes that have a sighting of the thing, and see the point, see it in there:
    what a mask took of the wall behind is gone. Where next to nothing stays, all points do.
    """
    found = _remembered(memo, POINTS, lifted, members, shape, lambda: _points(lifted, members, shape))
    return np.asarray(found, np.float64)


def _remembered(
    memo: Memo | None,
    kind: str,
    lifted: Sequence[LiftedKeyframe],
    members: Mapping[int, Sequence[int]],
    shape: ShapeOptions,
    compute: Callable[[], FloatArray],
) -> FloatArray:
    """What is made of the sightings of a thing alone."""
    if memo is None or not all(lifted[k].key for k in members):
        return compute()
    name = name_of(shape, [(lifted[k].key, sorted(numbers)) for k, numbers in sorted(members.items())])
    return np.asarray(remembered(memo, kind, name, lambda: {kind: compute()})[kind], np.float64)


def _points(lifted: Sequence[LiftedKeyframe], members: Mapping[int, Sequence[int]], shape: ShapeOptions) -> FloatArray:
    found = [
        transform_points(lifted[k].world_from_camera, lifted[k].outline[s])
        for k, numbers in sorted(members.items())
        for s in sorted(numbers)
    ]
    points = thinned(np.concatenate(found), shape.voxel, shape.most_points)
    visible, inside = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    keys = sorted(members)
    if len(keys) > MOST_VIEWS:
        keys = [keys[k * len(keys) // MOST_VIEWS] for k in range(MOST_VIEWS)]
    for key in keys:
        _vote(lifted[key], members[key], points, shape, visible, inside)
    fewest = min(shape.fewest_views, len(keys)) if _noise(lifted, members) < EXACT else 1
    kept = inside >= np.maximum(shape.kept_share * visible, fewest)
    if np.count_nonzero(kept) < max(8, 0.1 * len(points)):
        return points
    return crowded(points[kept])


def thing_box(
    lifted: Sequence[LiftedKeyframe],
    members: Mapping[int, Sequence[int]],
    points: FloatArray,
    up: FloatArray,
    shape: ShapeOptions,
    memo: Memo | None = None,
) -> Box:
    """The upright box about the `points` ``[n, 3]`` of a thing, without what the noise of depth adds to it."""
    trim = shape.trim if _noise(lifted, members) < EXACT else shape.noisy_trim
    noise = _remembered(memo, NOISE, lifted, members, shape, lambda: thing_noise(lifted, members, shape))
    if memo is None:
        return upright_box(points, up, trim, noise=noise)
    found = remembered(
        memo, BOX, name_of(points, up, trim, noise), lambda: _arrays(upright_box(points, up, trim, noise=noise))
    )
    return Box(found["centre"], found["size"], found["axes"])


def _arrays(box: Box) -> Arrays:
    return {"centre": box.centre, "size": box.size, "axes": box.axes}


def _noise(lifted: Sequence[LiftedKeyframe], members: Mapping[int, Sequence[int]]) -> float:
    """The median noise of the keyframes that show a thing, as a multiple of `depth_noise`."""
    return float(np.median([lifted[key].noise for key in sorted(members)]))


def thing_noise(
    lifted: Sequence[LiftedKeyframe], members: Mapping[int, Sequence[int]], shape: ShapeOptions
) -> FloatArray:
    """The mean covariance ``[3, 3]`` (map, square metres) of the points of a thing: noise of depth along their rays."""
    total, number = np.zeros((3, 3)), 0
    for k, numbers in sorted(members.items()):
        frame = lifted[k]
        for s in sorted(numbers):
            points = frame.outline[s].astype(np.float64)
            z = points[:, 2]
            deviation = frame.noise * depth_noise(z) / np.maximum(z, 0.05)  # along z; as a share of the whole ray
            rays = (points * deviation[:, None]) @ frame.world_from_camera[:3, :3].T
            single = frame.single[s]
            total += np.einsum("ni,nj->ij", rays, rays) * (single + (1 - single) * shape.fitted_share**2)
            number += len(points)
    return np.asarray(total * shape.noise_share**2 / max(number, 1), np.float64)


def crowded(points: FloatArray, reach: float = 0.03, fewest: int = 2) -> FloatArray:
    """`points` ``[n, 3]`` without those that have fewer than `fewest` others within `reach` metres."""
    tree = cKDTree(points)
    near = np.asarray(tree.query(points, k=min(fewest + 1, len(points)), distance_upper_bound=reach)[0])
    kept = np.isfinite(near.reshape(len(points), -1)[:, -1])
    return points[kept] if np.count_nonzero(kept) >= 0.5 * len(points) else points


def _vote(
    frame: LiftedKeyframe,
    numbers: Sequence[int],
    points: FloatArray,
    shape: ShapeOptions,
    visible: object,
    inside: object,
) -> None:
    from semdb.landmarks.kernels import vote

    camera = frame.camera
    mine = np.zeros(len(frame.points) + 1, np.bool_)
    mine[np.asarray(numbers) + 1] = True
    distortion = np.array((*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5], np.float64)
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], np.float64)
    noise = max(frame.noise, shape.least_noise)
    limits = np.array([shape.near_m + shape.near_deviations * frame.apart, shape.near_deviations * noise])
    step = float(frame.step)
    pose = invert_pose(frame.world_from_camera)
    vote(points, pose, lens, distortion, frame.grid_depth, frame.grid_owner, step, limits, mine, visible, inside)


def thinned(points: FloatArray, voxel: float, most: int) -> FloatArray:
    """One point, the mean, for each cube of side `voxel` that has any, at most `most` of them, evenly taken."""
    cells = np.floor(points / voxel).astype(np.int64)
    _, inverse, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.ravel()
    means = np.stack([np.bincount(inverse, points[:, k]) for k in range(3)], axis=1) / counts[:, None]
    if len(means) > most:
        means = means[np.arange(most, dtype=np.int64) * len(means) // most]
    return np.asarray(means, np.float64)
