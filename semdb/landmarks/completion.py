"""What keyframes should have seen: confirmed landmarks in their view that the detector missed in them.

A query sees what a keyframe beside it missed, and misses what that saw: then the two look less alike than they are.
So a landmark that a keyframe sees, and has no object of, counts for its class there as a detection would.
"""

from __future__ import annotations

from collections.abc import Sequence

from semdb.class_score import strengths
from semdb.landmarks.values import Landmark, LandmarkState

SCORE = 0.7  # of a detection that was missed, of a thing that is wholly in view
Seen = tuple[str, float, float]  # class, score, and where the middle of its box is: 0 top, 1 bottom


def completed(
    seen: Sequence[Sequence[Seen]], landmarks: Sequence[Landmark], classes: Sequence[str]
) -> list[dict[str, tuple[int, int]]]:
    """Of each keyframe the strengths (upper, lower) of the classes that landmarks add to.

    `seen` are its objects. A landmark that was missed adds to its class `SCORE` times the share of it that is in view.
    Weak detections, which are in what is stored of a keyframe beside its objects, may be of the same things: the
    greater of the two is what it shows.
    """
    missed: list[list[Seen]] = [[] for _ in seen]
    for thing in landmarks:
        if thing.state is not LandmarkState.CONFIRMED:
            continue
        for view in thing.expected:
            missed[view.keyframe].append((classes[thing.category], SCORE * view.share, view.height))
    return [
        {name: pair for name, pair in strengths([*own, *more]).items() if name in {item[0] for item in more}}
        for own, more in zip(seen, missed, strict=True)
    ]
