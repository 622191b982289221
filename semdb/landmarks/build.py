"""All of it: keyframes with masks and depth to landmarks.

A function of the keyframes in their order (recording's name, frame) and of nothing else. Objects are compared by that
order, so the result does not depend on when, or by whom, they were stored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from semdb.landmarks.assembly import Assembly, SeenKeyframe
from semdb.landmarks.clustering import UNIT, clusters
from semdb.landmarks.evidence import name_probabilities
from semdb.landmarks.gravity import estimate_gravity
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.links import find_links, sighting_table, weights
from semdb.landmarks.memo import Forgetful, Memo
from semdb.landmarks.options import LandmarkOptions
from semdb.landmarks.places import agreed
from semdb.landmarks.settling import settle
from semdb.landmarks.sizes import Sizes, unknown_sizes
from semdb.landmarks.values import Landmarks
from semdb.landmarks.visibility import Sightings, Views, collect, look
from semdb.types import FloatArray, Int64Array

__all__ = ["SeenKeyframe", "associate", "find_landmarks"]

Progress = Callable[[int, int], None]
UNKNOWN_APART_M = 0.01  # of a keyframe that no other one sees a surface of


def find_landmarks(
    keyframes: Sequence[SeenKeyframe],
    classes: int,
    confusion: FloatArray | None = None,
    up: FloatArray | None = None,
    options: LandmarkOptions | None = None,
    progress: Progress | None = None,
    memo: Memo | None = None,
    sizes: Sizes | None = None,
) -> Landmarks:
    """The landmarks of a map, of its keyframes by recording's name and frame.

    `confusion` ``[classes, classes]``: shares of what goes by another name (see `evidence.name_probabilities`). `up`
    ``[3]``: which way is up, where that is known. `memo`: what was found before, of keyframes that have names.
    `sizes`: what is known of those of classes (`sizes_of`).
    """
    options, memo = options or LandmarkOptions(), memo or Forgetful()
    lifted = [frame.lifted for frame in keyframes]
    before, lifted = lifted, agreed(lifted, options.register, memo, UNKNOWN_APART_M)
    moved = [
        float(np.linalg.norm(frame.world_from_camera[:3, 3] - was.world_from_camera[:3, 3]))
        for frame, was in zip(lifted, before, strict=True)
    ]
    gravity = estimate_gravity(lifted, up, memo)
    sightings = collect(lifted)
    views = look(lifted, sightings, options.see, progress, memo)
    names = name_probabilities(classes, confusion)
    cluster = associate(keyframes, lifted, sightings, views, names, options)
    found = Assembly(keyframes, lifted, sightings, views, cluster, names, gravity, options, memo)
    landmarks = settle(
        sorted(found.all(), key=lambda thing: thing.key),
        keyframes,
        confusion,
        unknown_sizes(classes) if sizes is None else sizes,
        options,
    )
    objects = sum(len(frame.category) for frame in keyframes)
    placed = sum(len(thing.members) for thing in landmarks)
    return Landmarks(
        tuple(landmarks),
        gravity,
        float(np.median(moved)) if moved else 0.0,
        objects - placed,
    )


def associate(
    keyframes: Sequence[SeenKeyframe],
    lifted: Sequence[LiftedKeyframe],
    sightings: Sightings,
    views: Views,
    names: FloatArray,
    options: LandmarkOptions,
) -> Int64Array:
    """The thing of each sighting, int64 ``[n]``: the number of its first sighting."""
    links = find_links(lifted, sightings, views)
    # of the names of one sighting the first
    called = [frame.category[np.unique(frame.lifted.sighting_of, return_index=True)[1]] for frame in keyframes]
    offset, number = sighting_table(lifted, sightings)
    category = np.concatenate([np.empty(0, np.int64), *called])[offset[sightings.keyframe] + sightings.label - 1]
    weight = weights(links, category, names, options.link)
    a, b, w = [links.a], [links.b], [weight]
    for k, frame in enumerate(lifted):
        one, other = np.nonzero(np.triu(frame.beside, 1))
        one, other = number[offset[k] + one], number[offset[k] + other]
        there = (one >= 0) & (other >= 0)
        a.append(one[there])
        b.append(other[there])
        w.append(np.full(np.count_nonzero(there), round(options.link.apart * UNIT), np.int64))
    return clusters(len(sightings), np.concatenate(a), np.concatenate(b), np.concatenate(w))
