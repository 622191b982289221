"""What the landmarks of a map are, when all are put together: of the names of all of them and of how large each is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semdb.landmarks.assembly import SeenKeyframe
from semdb.landmarks.evidence import Named, settled, support
from semdb.landmarks.options import LandmarkOptions
from semdb.landmarks.sizes import Sizes
from semdb.landmarks.values import Landmark, LandmarkState
from semdb.types import BoolArray, FloatArray


def settle(
    landmarks: Sequence[Landmark],
    keyframes: Sequence[SeenKeyframe],
    confusion: FloatArray | None,
    sizes: Sizes,
    options: LandmarkOptions,
) -> list[Landmark]:
    """Landmarks with their classes, and tentative where too little is said for these.

    What is given is of classes by the names of each alone, and confirmed where enough keyframes show it. `confusion`
    ``[classes, classes]``: see `evidence.name_probabilities`.
    """
    if not landmarks:
        return []
    things = []
    for thing in landmarks:
        category = [keyframes[m.keyframe].category[m.ordinal] for m in thing.members]
        score = [keyframes[m.keyframe].score[m.ordinal] for m in thing.members]
        things.append((np.array(category, np.int64), np.array(score, np.float64)))
    boxes = np.array([thing.box.size for thing in landmarks])
    barred = sizes.too_large(boxes)
    found = []
    for thing, named, bars, evidence in zip(
        landmarks, things, barred, settled(things, sizes.fits(boxes), confusion, barred), strict=True
    ):
        best = int(np.argmax(np.round(evidence, 9)))
        unsure = thing.state is LandmarkState.CONFIRMED and not _is_sure(thing, best, named, bars, options)
        state = LandmarkState.TENTATIVE if unsure else thing.state
        found.append(replace(thing, category=best, probability=float(evidence[best]), evidence=evidence, state=state))
    return found


def _is_sure(thing: Landmark, best: int, named: Named, barred: BoolArray, options: LandmarkOptions) -> bool:
    """Whether enough is said for a thing being of a class; what it is by its names alone is the thing's.

    The others settle which of its names it has, not whether it is there: what it mostly goes by speaks for it as well.
    """
    enough, (category, score) = options.sure_score * options.least(thing.keyframes, thing.missed), named
    keyframe = np.array([member.keyframe for member in thing.members], np.int64)
    if barred[thing.category]:  # what mostly goes by a name for which it is too large is of no known class
        enough = max(enough, support(keyframe, category, score).get(thing.category, 0.0))
    else:
        category = np.where(category == thing.category, best, category)
    return not barred[best] and support(keyframe, category, score).get(best, 0.0) >= enough
