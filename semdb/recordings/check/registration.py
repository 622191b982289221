"""Whether edges of depth lie on those of colour, or would in another size or place, or at another time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.recordings.check.edges import EdgeFrame, misfit
from semdb.recordings.check.pairs import Pair
from semdb.types import FloatArray

ZOOMS = np.arange(0.8, 1.251, 0.05)
SHIFTS = np.arange(-15.0, 15.1, 5.0)  # pixels of an image of 320
LEAST_FRAMES, LEAST_POINTS = 5, 2000  # in all
BETTER = 0.8  # the misfit must fall to this share
LEAST_ZOOM, LEAST_SHIFT = 0.05, 7.0  # what is less is calibration
DELAYS_S = np.arange(-0.3, 0.301, 0.01)
LEAST_DELAY_S = 0.04
DELAY_BETTER = 0.88


@dataclass(frozen=True, slots=True)
class Misplaced:
    """How depth must be changed to lie on colour: stretched, moved (pixels of an image of 640), or `delay_s` alone."""

    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    delay_s: float = 0.0  # positive: depth is later than colour


def misplaced(pairs: Sequence[Pair], edges: Mapping[int, EdgeFrame], steps_s: FloatArray) -> Misplaced | None:
    """What would make depth fit colour far better; None where nothing does, or there is too little to tell."""
    frames = [edges[pair.first] for pair in pairs if pair.first in edges]
    if len(frames) < LEAST_FRAMES or sum(len(frame.points) for frame in frames) < LEAST_POINTS:
        return None
    nothing = np.zeros((len(frames), 2))
    as_is = misfit(frames, 1.0, nothing)
    late = _delay(pairs, edges, steps_s)
    if late is not None and late[1] < DELAY_BETTER * as_is:
        return Misplaced(delay_s=late[0])
    zoom, shift, least = _place(frames)
    far = abs(zoom - 1) >= LEAST_ZOOM or float(np.hypot(*shift)) >= LEAST_SHIFT
    if not far or least > BETTER * as_is:
        return None
    return Misplaced(zoom, (2 * shift[0], 2 * shift[1]))


def _place(frames: Sequence[EdgeFrame]) -> tuple[float, tuple[float, float], float]:
    """Zoom, shift (of 320) and misfit of the best place."""

    def tried(zooms: FloatArray, xs: FloatArray, ys: FloatArray) -> tuple[float, float, float, float]:
        return min(
            (misfit(frames, zoom, np.tile((x, y), (len(frames), 1))), zoom, x, y)
            for zoom in zooms.tolist()
            for x in xs.tolist()
            for y in ys.tolist()
        )

    _, zoom, x, y = tried(ZOOMS, SHIFTS, SHIFTS)
    near = np.array([-2.5, 0.0, 2.5])
    least, zoom, x, y = tried(zoom + 0.01 * near, x + near, y + near)
    return zoom, (x, y), least


def _delay(pairs: Sequence[Pair], edges: Mapping[int, EdgeFrame], steps_s: FloatArray) -> tuple[float, float] | None:
    """The delay at which depth edges, moved back by the flow of the images, fit best, and the misfit there."""
    used = [(pair, step) for pair, step in zip(pairs, steps_s, strict=True) if pair.first in edges and 0 < step < 0.5]
    if len(used) < LEAST_FRAMES:
        return None
    frames = [edges[pair.first] for pair, _ in used]
    speed = np.stack([np.median(pair.flow_px, axis=0) / step / 2 for pair, step in used])  # pixels of 320 a second
    if float(np.median(np.hypot(*speed.T))) < 20:
        return None
    scores = [misfit(frames, 1.0, -speed * delay) for delay in DELAYS_S]
    least = int(np.argmin(scores))
    return None if abs(DELAYS_S[least]) < LEAST_DELAY_S else (float(DELAYS_S[least]), float(scores[least]))
