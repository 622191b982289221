"""Where a camera may stand: poses at which two objects of an image lie where two landmarks of a map are, and keyframes
that look a little aside.
"""

from __future__ import annotations

import numpy as np

from semdb.geometry import so3_exp
from semdb.types import FloatArray, Int64Array

LEAST_APART_M = 0.15  # two landmarks nearer to each other do not tell a direction
LEAST_TURN_DEG = 6.0  # between two ways to hold the camera

# degrees about up and about the camera's x, the likeliest first: of two dozen books in a shelf pairs tell nothing, and
# a keyframe's pose puts each on its neighbour
TURNS = tuple(
    sorted(
        ((yaw, tilt) for yaw in (-15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0) for tilt in (-5.0, 0.0, 5.0) if yaw or tilt),
        key=lambda turn: (turn[0] ** 2 + 4 * turn[1] ** 2, turn),
    )
)


def turned_cameras(cameras: FloatArray, level: FloatArray, most: int) -> FloatArray:
    """`cameras` ``[k, 4, 4]`` (camera_from_world) that look elsewhere from where they are, at most `most` of them.

    Each is turned in as many of `TURNS` as all can be; `level` as in `poses_from_pairs`.
    """
    place = -np.einsum("nji,nj->ni", cameras[:, :3, :3], cameras[:, :3, 3])
    found = [np.empty((0, 4, 4))]
    for yaw, tilt in TURNS[: most // max(len(cameras), 1)]:
        turned = np.zeros_like(cameras)
        about_x, about_up = so3_exp(np.array([np.radians(tilt), 0.0, 0.0])), so3_exp(level[:, 2] * np.radians(yaw))
        turned[:, :3, :3] = about_x @ cameras[:, :3, :3] @ about_up
        turned[:, :3, 3] = -np.einsum("nij,nj->ni", turned[:, :3, :3], place)
        turned[:, 3, 3] = 1
        found.append(turned)
    return np.concatenate(found)


def poses_from_pairs(
    boxes: FloatArray,
    points: FloatArray,
    scores: FloatArray,
    names: FloatArray,
    centres: FloatArray,
    sizes: FloatArray,
    cameras: FloatArray,
    level: FloatArray,
    *,
    ways_to_hold: int,
    slack: float,
    most: int,
) -> FloatArray:
    """Poses ``[n, 4, 4]`` (camera_from_world) from two pairs each: four unknowns, as the camera is held in known ways.

    `boxes` ``[d, 4]`` at unit distance, `points` ``[d, 3]`` (NaN without depth), `scores` ``[d]``; `names` ``[l, d]``
    as in `MapLandmarks`, `centres`, `sizes` ``[l, 3]``; `cameras` ``[k, 4, 4]`` are held in the known ways, `level`
    ``[3, 3]`` has up as its third column. Distances that are judged by size may be wrong by the share `slack`. Of all
    couples of pairs whose distances agree the `most` likely are taken.
    """
    thing, landmark = np.nonzero(np.log(0.5) < names.T)
    own, loose = _places_in_camera(boxes, points, sizes, thing, landmark, slack)
    place = centres[landmark]
    i, j = np.triu_indices(len(thing), 1)
    other = (thing[i] != thing[j]) & (landmark[i] != landmark[j])
    i, j = i[other], j[other]
    apart = np.linalg.norm(place[i] - place[j], axis=1)
    off = np.abs(apart - np.linalg.norm(own[i] - own[j], axis=1)) / np.hypot(loose[i], loose[j])
    fits = (off < 1.5) & (apart > LEAST_APART_M)
    i, j, off = i[fits], j[fits], off[fits]
    likely = names[landmark, thing] + np.log(scores[thing])
    best = np.argsort(off - likely[i] - likely[j], kind="stable")[:most]
    i, j = i[best], j[best]
    found = [_upright(own[i], own[j], place[i], place[j], held, level) for held in _held(cameras, level, ways_to_hold)]
    return np.concatenate([np.empty((0, 4, 4)), *found])


def _places_in_camera(
    boxes: FloatArray, points: FloatArray, sizes: FloatArray, thing: Int64Array, landmark: Int64Array, slack: float
) -> tuple[FloatArray, FloatArray]:
    """Where things ``[p, 3]`` are if they are these landmarks, and how far that may be off ``[p]``, metres."""
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    rays = np.concatenate([middle, np.ones((len(middle), 1))], axis=1)
    extent = np.sqrt(np.maximum(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1), 1e-6))
    size = np.cbrt(np.prod(np.maximum(sizes, 0.03), axis=1))[landmark]
    judged, measured = size / extent[thing], points[thing, 2]
    known = measured > 0
    z = np.where(known, measured + 0.25 * size, judged)
    return rays[thing] * z[:, None], np.where(known, 0.1 + 0.3 * size, 0.1 + slack * judged)


def _held(cameras: FloatArray, level: FloatArray, count: int) -> list[FloatArray]:
    """The ways ``[3, 3]`` (level from camera, the third axis up, turned about it somehow) in which cameras are held."""
    ups = cameras[:, :3, :3] @ level[:, 2]
    mean = ups.mean(axis=0)
    chosen = [mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 0.1 else ups[0]]
    while len(chosen) < count:
        nearest = (ups @ np.array(chosen).T).max(axis=1)
        farthest = int(np.argmin(nearest))
        if nearest[farthest] > np.cos(np.radians(LEAST_TURN_DEG)):
            break
        chosen.append(ups[farthest])
    ways = []
    for up in chosen:
        helper = np.eye(3)[int(np.argmin(np.abs(up)))]
        first = helper - (helper @ up) * up
        first /= np.linalg.norm(first)
        ways.append(np.stack([first, np.cross(up, first), up]))
    return ways


def _upright(
    one: FloatArray, other: FloatArray, at: FloatArray, there: FloatArray, held: FloatArray, level: FloatArray
) -> FloatArray:
    """Cameras ``[n, 4, 4]`` that see points `one` and `other` ``[n, 3]`` of theirs `at` and `there` in the world."""
    seen = ((other - one) @ held.T)[:, :2]
    lies = ((there - at) @ level)[:, :2]
    yaw = np.arctan2(lies[:, 1], lies[:, 0]) - np.arctan2(seen[:, 1], seen[:, 0])
    turn = np.zeros((len(yaw), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(yaw)
    turn[:, 1, 0] = np.sin(yaw)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1
    world = level @ turn @ held
    position = (at + there) / 2 - np.einsum("nij,nj->ni", world, (one + other) / 2)
    camera = np.zeros((len(yaw), 4, 4))
    camera[:, :3, :3] = world.transpose(0, 2, 1)
    camera[:, :3, 3] = -np.einsum("nij,nj->ni", camera[:, :3, :3], position)
    camera[:, 3, 3] = 1
    return np.asarray(camera[np.linalg.norm(lies, axis=1) > LEAST_APART_M / 2], np.float64)
